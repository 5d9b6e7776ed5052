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
    """Intrinsic parameters of a camera."""

    focal: Any
    """(2,) pixels."""
    centre: Any
    """(2,) pixels, principal point."""
    radial: Any
    """(2,) distortion coefficients of the factor ``1 + radial[0] r^2 + radial[1] r^4`` at radius r."""


def stretch(radial: Any, point: Any) -> Any:
    """Radial distortion factor (...) of points (..., 2) in focal lengths, in JAX or NumPy."""
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
    """
    bent = (pixel - lens.centre) / lens.focal
    point = bent
    for _ in range(_ITERATIONS):
        point = bent / stretch(lens.radial, point)
    return point
