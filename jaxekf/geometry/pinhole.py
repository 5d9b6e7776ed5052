"""The pinhole camera with radial distortion: points of the scene to points of the image, and back."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

NEAREST = 1e-3
"""Metres: a point that is not so far in front of the camera is not seen."""
_BESIDE = 10.0
"""Focal lengths from the axis at which such a point is said to appear: in no image."""
_ITERATIONS = 8


class Lens(NamedTuple):
    """How a camera maps directions to pixels."""

    focal: Any
    """(2,) pixels."""
    centre: Any
    """(2,) pixels: where the optical axis meets the image."""
    radial: Any
    """(2,) a point r from the axis appears ``1 + radial[0] r^2 + radial[1] r^4`` times as far."""


def stretch(radial: Array, point: Array) -> Array:
    """How many times as far from the axis a point (2,), in focal lengths, appears; ()."""
    r2 = jnp.sum(point * point)
    return 1.0 + (radial[0] + radial[1] * r2) * r2


def project(lens: Lens, p_camera: Array) -> Array:
    """Image point (2,), pixels, of a point (3,) in the camera's frame (its z is the optical axis).

    Points beside and behind the camera, which no image shows, appear far outside, wherever they are: with
    derivatives 0, since slopes that mean nothing would let such a point through every gate.
    """
    in_front = p_camera[2] > NEAREST
    seen = jnp.where(in_front, p_camera, jnp.array([0.0, 0.0, 1.0]))
    point = seen[:2] / seen[2]
    there = lens.focal * point * stretch(lens.radial, point) + lens.centre
    return jnp.where(in_front, there, lens.focal * _BESIDE + lens.centre)


def ray(lens: Lens, pixel: Array) -> Array:
    """Direction (2,) of an image point: where it meets the plane at distance 1; `project` inverted.

    By fixed-point iteration, which converges for distortions that leave the image in order.
    """
    bent = (pixel - lens.centre) / lens.focal
    point = bent
    for _ in range(_ITERATIONS):
        point = bent / stretch(lens.radial, point)
    return point
