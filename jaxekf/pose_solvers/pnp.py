"""Camera pose from landmarks in a single image (PnP), on the host, without a filter.

A linear solution (DLT, or a homography for landmarks in one plane) comes first, from all points and, if it
does not fit, from random subsets, so that mismatches do not decide. The solution of least median error is
refined by Gauss-Newton on the manifold with Tukey's weights. `poses` solves all images, `as_optical`
returns them as a tracker's stream.
"""

import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support.deprecations import renamed
from jaxekf._support.errors import RecordingError
from jaxekf.geometry import pinhole
from jaxekf.geometry.host_rotation import nearest_rotation, skew
from jaxekf.recordings.types import Camera, Flags, Floats, Optical, from_scipy, to_scipy

FEWEST, _FEWEST_FLAT = 6, 4
"""Landmarks that determine a pose, in general position and in one plane."""
_SUBSETS = 24
_ITERATIONS = 12
_CONVERGED = 1e-10
"""Step length, metres and radians, that ends the iterations."""
_GOOD_START = 0.03
"""Median error, in focal lengths, from which Gauss-Newton converges."""
_WIDEST = 1e3
"""Largest distance from the axis at depth 1 of a ray that a lens can map."""
_FLAT = 1e-3
"""Ratio of thickness to width below which landmarks are coplanar."""
_FLAT_START = 0.02
"""The same for the landmarks of a linear start."""
_PLANES = 12
"""Planes through three landmarks that are tried."""
_CUTOFF = 4.685
"""Cutoff of Tukey's weight in robust standard deviations: 95 % efficiency without mismatches."""
_MAD = 1.4826
_LARGEST_ERROR = 0.05
"""Largest robust error of a valid pose, in focal lengths."""
_LEAST_SHARE = 0.5
"""Smallest share of points with positive weight in a valid pose."""


class Resection(NamedTuple):
    """Poses of the body, image by image."""

    q_ref_body: Floats
    """(N, 4) unit quaternions, body to reference."""
    position: Floats
    """(N, 3) metres, the body's origin in the reference frame."""
    cov: Floats
    """(N, 6, 6) covariance of position (reference frame) and attitude (body frame), for noise of size
    `error`."""
    error: Floats
    """(N,) pixels, robust standard deviation of the reprojection errors."""
    valid: Flags
    """(N,) False if too few landmarks are visible or no pose fits; the pose is then the identity."""
    fits: Flags
    """(N, L) inliers."""


def poses(camera: Camera, most: int | None = None) -> Resection:
    """The pose of every image with at least six landmarks, or four in one plane.

    The result is cached for as long as the camera exists, since gravity, the start and figures use it.

    Parameters
    ----------
    camera
        Image points and landmarks.
    most
        Solve only every n-th image, so that about this many are solved; the others are not valid.
    """
    if (found := cached_poses(camera)) is not None:
        return found
    every = 1 if most is None else max(1, -(-len(camera.time_ns) // most))
    key = id(camera), every
    if key not in _CACHE:
        shown = np.arange(len(camera.time_ns)) % every == 0
        found = _poses(replace(camera, visible=camera.visible & shown[:, None]))
        # The id of a deleted camera may be reused.
        _CACHE[key] = weakref.ref(camera, lambda _: _CACHE.pop(key, None)), found
    return _CACHE[key][1]


def cached_poses(camera: Camera) -> Resection | None:
    """The poses of all images if they are cached, else None."""
    kept = _CACHE.get((id(camera), 1))
    return None if kept is None else kept[1]


_CACHE: dict[tuple[int, int], tuple[weakref.ref[Camera], Resection]] = {}


def _poses(camera: Camera) -> Resection:
    images = np.flatnonzero(camera.usable.sum(axis=1) >= _FEWEST_FLAT)
    points, order = _points(camera, images)
    direction = _directions(points)
    # One point that no lens maps, or a huge one, would make the sums of its image infinite.
    usable = points.usable & np.asarray((np.abs(direction) < _WIDEST).all(axis=2))
    points = points._replace(usable=usable)
    count = len(images)
    rotation, position = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    valid = np.zeros(count, bool)
    rng = np.random.default_rng(0)
    for i in np.flatnonzero(usable.sum(axis=1) >= _FEWEST_FLAT):
        found = _linear_start(direction[i, usable[i]], points.place[i, usable[i]], rng)
        if found is not None:
            rotation[i], position[i], valid[i] = *found, True
    for _ in range(_ITERATIONS):
        residual, slope = _linearise(points, rotation, position)
        scale = _scale(residual, usable)
        weight = _weights(residual, scale, usable & valid[:, None])
        step, _ = _gauss_newton_step(residual, slope, weight)
        position = position + step[:, :3]
        rotation = rotation @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
        if np.abs(step[valid]).max(initial=0.0) < _CONVERGED:
            break
    residual, slope = _linearise(points, rotation, position)
    scale = _scale(residual, usable)
    weight = _weights(residual, scale, usable & valid[:, None])
    counted = (weight > 0.0).sum(axis=1)
    valid &= scale <= _LARGEST_ERROR * float(np.mean(camera.focal))
    valid &= counted >= np.maximum(_FEWEST_FLAT, _LEAST_SHARE * usable.sum(axis=1))
    valid &= np.isfinite(position).all(axis=1)
    # Correction for the six parameters of the pose.
    free = np.maximum(2 * counted - 6, 1)
    scale = scale * np.sqrt(np.maximum(2 * counted, 1) / free)
    _, information = _gauss_newton_step(residual, slope, weight)
    fits = np.zeros((count, len(camera.names)), bool)
    np.put_along_axis(fits, order, (weight > 0.0) & valid[:, None], axis=1)
    found = _body_poses(camera, rotation, position, information, scale, valid, fits)
    return _for_all_images(found, images, len(camera.time_ns))


def _for_all_images(found: Resection, images: Any, count: int) -> Resection:
    """The poses of some images, with invalid ones for all others."""
    nothing = (np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros((6, 6)), 0.0, False, False)
    every = []
    for value, missing in zip(found, nothing, strict=True):
        whole = np.empty((count, *value.shape[1:]), value.dtype)
        whole[:] = missing
        whole[images] = value
        every.append(whole)
    return Resection(*every)


def no_pose_error(place: Path | str, images: int) -> RecordingError:
    """Error for a camera without any valid pose, whose lens or landmarks are wrong."""
    return RecordingError(
        place,
        f"{images} images of {FEWEST} landmarks or more, none of which fits any pose",
        "points at the landmarks' images",
        "correcting the camera's focal, centre and radial (in pixels of these images), the landmarks'"
        " names, or their places",
    )


def as_optical(camera: Camera, most: int | None = None) -> Optical:
    """The pose of every image, or of about `most` images, as a tracker would report it; see `poses`."""
    found = poses(camera, most)
    late = camera.latency_ns
    return Optical(camera.time_ns, found.q_ref_body, found.valid, found.position, latency_ns=late)


class _Points(NamedTuple):
    """Image points of N images, at most M landmarks each, and the lens."""

    pixel: Floats
    """(N, M, 2), the centre of the image if not usable."""
    place: Floats
    """(N, M, 3) landmarks in the reference frame."""
    usable: Flags
    focal: Floats
    centre: Floats
    radial: Floats


def _points(camera: Camera, images: Any) -> tuple[_Points, Any]:
    """Visible points of some images, and the indices (N, M) of their landmarks.

    An image shows a few of a scene's many landmarks, so the others are left out.
    """
    visible = camera.usable[images]
    most = int(visible.sum(axis=1).max(initial=1))
    order = np.argsort(~visible, axis=1, kind="stable")[:, :most]
    usable = np.take_along_axis(visible, order, axis=1)
    pixel = np.take_along_axis(camera.pixel[images], order[..., None], axis=1)
    centre = np.asarray(camera.centre, float)
    pixel = np.where(usable[..., None], pixel, centre)
    lens = (np.asarray(camera.focal, float), centre, np.asarray(camera.radial, float))
    return _Points(pixel, camera.p_ref_landmark[order], usable, *lens), order


def _directions(points: _Points) -> Floats:
    """(N, M, 2) undistorted rays: intersections with the plane at depth 1."""
    distorted = (points.pixel - points.centre) / points.focal
    point = distorted
    with np.errstate(all="ignore"):
        for _ in range(8):
            point = distorted / pinhole.stretch(points.radial, point)[..., None]
    return point


# --- the linear start ---------------------------------------------------------------------------------


def _linear_start(
    direction: Floats, place: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats] | None:
    """Linear solution of least median error.

    Parameters
    ----------
    direction
        (M, 2) rays.
    place
        (M, 3) landmarks, reference frame.

    Returns
    -------
    Rotation matrix (3, 3), camera to reference, and the camera's position (3,); None if there is none.
    """
    everything = np.arange(len(place))
    axes = np.linalg.svd(place - place.mean(axis=0), full_matrices=False)
    if axes[1][1] <= _FLAT * axes[1][0]:
        return None
    ways: list[tuple[Any, Any, int]] = []
    if axes[1][2] > _FLAT * axes[1][0]:
        if len(place) < FEWEST:
            return None
        ways.append((_direct_linear_transform, everything, FEWEST))
        # A few landmarks off a plane that holds the others hardly determine the linear transform.
        plane = _largest_plane(place, rng)
        if len(plane) >= FEWEST:
            ways.append((_homography, plane, _FEWEST_FLAT))
    else:
        ways.append((_homography, everything, _FEWEST_FLAT))
    best, least = None, np.inf
    for number in range(1 + _SUBSETS):
        for solve, members, size in ways:
            if number and len(members) == size:
                continue
            subset = rng.permutation(members)[:size] if number else members
            found = solve(direction[subset], place[subset])
            if found is None:
                continue
            inside = (place - found[1]) @ found[0]
            depth = np.maximum(inside[:, 2:], pinhole.NEAREST)
            off = np.linalg.norm(inside[:, :2] / depth - direction, axis=1)
            off[inside[:, 2] <= pinhole.NEAREST] = np.inf
            if (middling := float(np.median(off))) < least:
                best, least = found, middling
            if least < _GOOD_START:
                return best
    return best


def _largest_plane(place: Floats, rng: np.random.Generator) -> Any:
    """Indices of the landmarks (M, 3) in the plane that holds most of them, of some random planes."""
    corners = place[rng.integers(len(place), size=(_PLANES, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    normal = normal / np.maximum(length, 1e-12)[:, None]
    off = np.abs(np.einsum("kmi,ki->km", place - corners[:, :1], normal))
    size = np.sqrt(np.mean((place - place.mean(axis=0)) ** 2))
    inside = (off <= _FLAT_START * size) & (length > _FLAT * size**2)[:, None]
    return np.flatnonzero(inside[np.argmax(inside.sum(axis=1))])


def _direct_linear_transform(direction: Floats, place: Floats) -> tuple[Floats, Floats] | None:
    """Solution by the direct linear transform: the matrix (3, 4) that takes landmarks to their rays."""
    middle = place.mean(axis=0)
    size = np.sqrt(np.mean((place - middle) ** 2)) + 1e-12
    scaled = np.concatenate([(place - middle) / size, np.ones((len(place), 1))], axis=1)
    matrix = _ray_matrix(scaled, direction)
    if np.linalg.det(matrix[:, :3]) <= 0.0:
        return None
    # A determinant that is 0 but for rounding, as of a subset in one plane, may hide a reflection.
    towards = nearest_rotation(matrix[:, :3])
    length = np.linalg.svd(matrix[:, :3], compute_uv=False).mean()
    return towards.T, middle - size * towards.T @ matrix[:, 3] / length


def _homography(direction: Floats, place: Floats) -> tuple[Floats, Floats] | None:
    """Solution from landmarks that are coplanar, or nearly so."""
    middle = place.mean(axis=0)
    axes = np.linalg.svd(place - middle, full_matrices=False)[2]
    inside = (place - middle) @ axes[:2].T
    size = np.sqrt(np.mean(inside**2)) + 1e-12
    scaled = np.concatenate([inside / size, np.ones((len(place), 1))], axis=1)
    matrix = _ray_matrix(scaled, direction)
    length = np.sqrt(np.linalg.norm(matrix[:, 0]) * np.linalg.norm(matrix[:, 1]))
    if length <= 1e-12:
        return None
    one, two = matrix[:, 0] / length, matrix[:, 1] / length
    rotation = nearest_rotation(np.stack([one, two, np.cross(one, two)], axis=1))
    whole = np.stack([axes[0], axes[1], np.cross(axes[0], axes[1])])
    towards = rotation @ whole
    return towards.T, middle - size * towards.T @ matrix[:, 2] / length


def _ray_matrix(places: Floats, direction: Floats) -> Floats:
    """The matrix (3, c) that takes homogeneous places (M, c) to their rays, by least squares."""
    zero = np.zeros_like(places)
    first = np.concatenate([places, zero, -direction[:, :1] * places], axis=1)
    second = np.concatenate([zero, places, -direction[:, 1:] * places], axis=1)
    system = np.concatenate([first, second])
    # The right singular vector of the smallest singular value.
    matrix = np.linalg.eigh(system.T @ system)[1][:, 0].reshape(3, -1)
    return matrix * np.sign(np.mean(places @ matrix[2]) or 1.0)


# --- Gauss-Newton --------------------------------------------------------------------------------------


def _linearise(points: _Points, rotation: Floats, position: Floats) -> tuple[Floats, Floats]:
    """Residuals (N, M, 2), pixels, and their derivatives (N, M, 2, 6) by the camera's pose.

    The pose consists of the position in the reference frame and a rotation in the camera frame, at the axes
    (N, 3, 3) and the position (N, 3).
    """
    inside = (points.place - position[:, None]) @ rotation
    depth = np.maximum(inside[..., 2], pinhole.NEAREST)
    point = inside[..., :2] / depth[..., None]
    r2, stretch = np.sum(point * point, axis=-1), pinhole.stretch(points.radial, point)
    projected = points.focal * point * stretch[..., None] + points.centre
    pixel = np.where(points.usable[..., None], points.pixel, projected)
    # Derivative of ``point * stretch`` by the point, then by the landmark in the camera frame.
    distorted = 2.0 * (points.radial[0] + 2.0 * points.radial[1] * r2)
    d_point = stretch[..., None, None] * np.eye(2)
    d_point = d_point + distorted[..., None, None] * point[..., :, None] * point[..., None, :]
    d_point = points.focal[:, None] * d_point
    d_camera = np.zeros((*depth.shape, 2, 3))
    d_camera[..., 0, 0] = d_camera[..., 1, 1] = 1.0 / depth
    d_camera[..., 2] = -point / depth[..., None]
    slope = d_point @ d_camera
    d_position = -slope @ np.swapaxes(rotation, 1, 2)[:, None]
    d_rotation = slope @ skew(inside)
    return pixel - projected, np.concatenate([d_position, d_rotation], axis=-1)


def _scale(residual: Floats, usable: Flags) -> Floats:
    """(N,) robust standard deviation of each coordinate, pixels."""
    size = np.where(usable[..., None], np.abs(residual), np.nan)
    size = size.reshape(len(residual), 2 * residual.shape[1])
    empty = ~usable.any(axis=1)
    size[empty] = 0.0
    return np.maximum(_MAD * np.nanmedian(size, axis=1), 1e-9)


def _weights(residual: Floats, scale: Floats, usable: Flags) -> Floats:
    """(N, M) Tukey's weights of the points."""
    off = np.linalg.norm(residual, axis=-1) / (_CUTOFF * scale)[:, None]
    return np.where(usable & (off < 1.0), (1.0 - np.minimum(off, 1.0) ** 2) ** 2, 0.0)


def _gauss_newton_step(residual: Floats, slope: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Steps (N, 6) of Gauss-Newton, and the information (N, 6, 6) at unit noise."""
    count, most = weight.shape
    flat = slope.reshape(count, 2 * most, 6)
    weighted = (slope * weight[..., None, None]).reshape(count, 2 * most, 6)
    information = np.swapaxes(weighted, 1, 2) @ flat
    pull = np.einsum("nri,nr->ni", weighted, residual.reshape(count, 2 * most))
    size = np.trace(information, axis1=1, axis2=2)
    some = np.maximum(size, 1.0)[:, None, None] * 1e-12 * np.eye(6)
    return np.linalg.solve(information + some, pull[..., None])[..., 0], information + some


def _body_poses(
    camera: Camera,
    rotation: Floats,
    position: Floats,
    information: Floats,
    scale: Floats,
    valid: Flags,
    fits: Flags,
) -> Resection:
    """Poses of the body from those of the camera."""
    mount = to_scipy(camera.q_body_camera)
    body = Rotation.from_matrix(rotation) * mount.inv()
    position = position - body.apply(camera.p_body_camera)
    cov = scale[:, None, None] ** 2 * np.linalg.inv(information)
    # Errors of the body's position, ``d position - d(R) p``, and of its attitude, rotated into the body.
    change = np.zeros((len(position), 6, 6))
    change[:, :3, :3] = np.eye(3)
    change[:, 3:, 3:] = mount.as_matrix()
    lever: Any = body.as_matrix() @ skew(camera.p_body_camera)
    change[:, :3, 3:] = lever @ mount.as_matrix()
    cov = change @ cov @ np.swapaxes(change, 1, 2)
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    q = np.where(valid[:, None], from_scipy(body), identity)
    where = np.where(valid[:, None], position, 0.0)
    return Resection(q, where, cov, scale, valid, fits)


__getattr__ = renamed(__name__, "no_pose>no_pose_error solved>cached_poses")
