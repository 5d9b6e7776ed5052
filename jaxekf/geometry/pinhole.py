"""Pinhole camera with radial distortion: projection of scene points into the image, and its inverse."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

NEAREST = 1e-3
"""Smallest depth, m, of a visible point."""
_BESIDE = 10.0
"""Image point, in focal lengths from the axis, of a point that is not visible: outside any image."""
_ITERATIONS = 8


class Lens(NamedTuple):
    """Intrinsic parameters of a camera.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry.pinhole import Lens, project
    >>> lens = Lens(focal=np.full(2, 500.0), centre=np.array([320.0, 240.0]), radial=np.zeros(2))
    >>> pixel = jax.jit(project)(lens, np.array([0.2, 0.1, 1.0]))
    >>> np.asarray(pixel).round(2).tolist()
    [420.0, 290.0]
    """

    focal: Any
    """(2,) pixels."""
    centre: Any
    """(2,) pixels, principal point."""
    radial: Any
    """(2,) distortion coefficients of the factor ``1 + radial[0] r^2 + radial[1] r^4`` at radius r."""


def stretch(radial: Any, point: Any) -> Any:
    """Radial distortion factor (...) of points (..., 2) in focal lengths, in JAX or NumPy.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.geometry import pinhole
    >>> barrel = np.array([-0.1, 0.0])
    >>> float(pinhole.stretch(barrel, np.array([0.5, 0.0])))  # 1 - 0.1 0.5^2
    0.975
    """
    r2 = (point * point).sum(axis=-1)
    return 1.0 + (radial[0] + radial[1] * r2) * r2


def project(lens: Lens, p_camera: Array) -> Array:
    """Image point of a point in the camera frame.

    Points that are not visible map to a constant far outside the image, with zero derivatives; a
    meaningless slope would let such a point pass any gate.

    Parameters
    ----------
    lens
        Intrinsic parameters.
    p_camera
        (3,) metres, camera frame; z is the optical axis.

    Returns
    -------
    (2,) pixels.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import pinhole
    >>> lens = pinhole.Lens(np.full(2, 500.0), np.array([320.0, 240.0]), np.zeros(2))
    >>> pixel = jax.jit(pinhole.project)(lens, np.array([0.4, 0.0, 2.0]))
    >>> np.asarray(pixel).round(2).tolist()  # 320 + 500 * 0.4 / 2
    [420.0, 240.0]
    >>> behind = jax.jit(pinhole.project)(lens, np.array([0.4, 0.0, -2.0]))
    >>> np.asarray(behind).round(2).tolist()
    [5320.0, 5240.0]
    """
    in_front = p_camera[2] > NEAREST
    visible = jnp.where(in_front, p_camera, jnp.array([0.0, 0.0, 1.0]))
    point = visible[:2] / visible[2]
    there = lens.focal * point * stretch(lens.radial, point) + lens.centre
    return jnp.where(in_front, there, lens.focal * _BESIDE + lens.centre)


def ray(lens: Lens, pixel: Array) -> Array:
    """Direction (2,) of an image point: its intersection with the plane at depth 1.

    The inverse of `project` by a fixed-point iteration, which converges for distortions that keep the order
    of image points.

    Examples
    --------
    >>> import jax, numpy as np
    >>> from jaxekf.geometry import pinhole
    >>> lens = pinhole.Lens(np.full(2, 500.0), np.array([320.0, 240.0]), np.array([-0.1, 0.0]))
    >>> pixel = jax.jit(pinhole.project)(lens, np.array([0.4, -0.2, 2.0]))
    >>> np.allclose(jax.jit(pinhole.ray)(lens, pixel), [0.2, -0.1], atol=1e-5)
    True
    """
    bent = (pixel - lens.centre) / lens.focal
    point = bent
    for _ in range(_ITERATIONS):
        point = bent / stretch(lens.radial, point)
    return point
