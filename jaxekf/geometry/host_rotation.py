"""Rotations on the host: NumPy functions that SciPy's `Rotation` does not have, for the rooms above.

Products, inverses and rotation vectors are those of `scipy.spatial.transform.Rotation`; see
`jaxekf.recordings.types.to_scipy`. The same operations inside a traced program are in
`jaxekf.geometry.rotation`.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def nearest_rotation(matrix: Floats) -> Floats:
    """Rotation matrix nearest to a matrix: the solution of Wahba's problem by SVD.

    With ``matrix = sum(weight * a b')`` the result ``R`` minimises ``sum(weight * |a - R b|^2)``
    (Kabsch 1976; Arun, Huang, Blostein 1987). It is never a reflection. `Rotation.align_vectors` does
    the same for one set of vectors, but neither for many matrices at once nor without a warning where
    the vectors leave the rotation undetermined.

    Parameters
    ----------
    matrix
        (..., 3, 3).

    Returns
    -------
    Rotation matrices (..., 3, 3).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import host_rotation
    >>> quarter_turn_about_z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    >>> stretched = quarter_turn_about_z * [1.1, 0.9, 1.0]
    >>> np.allclose(host_rotation.nearest_rotation(stretched), quarter_turn_about_z)
    True
    """
    u, _, vt = np.linalg.svd(matrix)
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return u @ vt


def skew(vectors: Floats) -> Floats:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3): ``skew(a) @ b == cross(a, b)``.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import host_rotation
    >>> host_rotation.skew(np.array([1, 2, 3])).tolist()
    [[0, -3, 2], [3, 0, -1], [-2, 1, 0]]
    """
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def running_product(q: Floats) -> Floats:
    """Products of the first 0, 1, ..., N of N quaternions, in order.

    The products are formed in blocks of about ``sqrt(N)``, all blocks at once, and then each block is
    multiplied by the product of the blocks before it: two products for each quaternion.

    Parameters
    ----------
    q
        (N, 4) unit quaternions w, x, y, z.

    Returns
    -------
    (N + 1, 4) unit quaternions but for rounding; the first is the identity.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import host_rotation
    >>> quarter_turns_about_z = np.tile(np.sqrt([0.5, 0.0, 0.0, 0.5]), (4, 1))
    >>> w, _, _, z = host_rotation.running_product(quarter_turns_about_z).T
    >>> np.rad2deg(2.0 * np.arctan2(z, w)).round().tolist()
    [0.0, 90.0, 180.0, 270.0, 360.0]
    """
    count = len(q)
    width = max(1, int(np.sqrt(count)))
    blocks = -(-count // width)
    # Components first, each contiguous, so that NumPy's overhead is paid once for each block row.
    factors = np.zeros((4, blocks * width))
    factors[0] = 1.0
    factors[:, :count] = q.T
    factors = np.ascontiguousarray(factors.reshape(4, blocks, width).transpose(2, 0, 1))
    for i in range(1, width):
        factors[i] = _product(factors[i - 1], factors[i])
    start = np.zeros((4, blocks))
    start[0] = 1.0
    for i in range(1, blocks):
        start[:, i] = _product(start[:, i - 1], factors[-1, :, i - 1])
    whole = np.stack([_product(start, each) for each in factors])
    flat = whole.transpose(2, 0, 1).reshape(-1, 4)[:count]
    return np.concatenate([[[1.0, 0.0, 0.0, 0.0]], flat])


def _product(p: Floats, q: Floats) -> Floats:
    """Hamilton products of quaternions w, x, y, z on the first axis, (4, ...)."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return np.array(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ]
    )
