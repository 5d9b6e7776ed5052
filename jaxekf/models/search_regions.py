"""Where each landmark will appear in an image, and how far from there it must be looked for."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support import chi_square
from jaxekf.filtering.model import Belief, Parameters
from jaxekf.geometry import linalg, manifold, pinhole
from jaxekf.models import visual
from jaxekf.recordings.types import Flags, Floats


class Regions(NamedTuple):
    """Predicted image points of L landmarks."""

    pixel: Any
    """(L, 2)."""
    cov: Any
    """(L, 2, 2) covariance, pixels squared, of where a point will be found: that of the pose and of the
    point's own noise."""
    in_front: Any
    """(L,) whether the landmark lies in front of the camera; of others nothing is known."""


def search_regions(params: Parameters, belief: Belief, p_ref_landmark: Array | Floats) -> Regions:
    """Regions of landmarks (L, 3), metres, in an image taken when the body is where `belief` of the model
    `visual` says; to be mapped over instants with `vmap`.

    With `belief` predicted to the time of an image (`FilterOutput.instants.predicted`) this is where to
    look before the image has told anything.
    """
    zero = jnp.zeros(belief.cov.shape[0], belief.cov.dtype)

    def one(place: Array) -> Regions:
        aux = visual.Point(place, jnp.zeros(()))

        def seen(delta: Array) -> Array:
            x = manifold.retract(visual.SPACE, belief.mean, delta)
            return visual.predict_point(x, None, params, aux)

        slope = jax.jacfwd(seen)(zero)
        cov = linalg.congruence(slope, belief.cov) + visual.point_noise(params, aux, zero[0])
        depth = visual.in_camera(belief.mean, params, place)[2]
        return Regions(seen(zero), cov, depth > pinhole.NEAREST)

    return jax.vmap(one)(jnp.asarray(p_ref_landmark))


def ellipses(regions: Regions, share: float = 0.99) -> tuple[Floats, Floats]:
    """Half axes (..., L, 2), pixels, the longer first, of ellipses that hold a `share` of points,
    and the angle (..., L), radians, of the longer from u towards v."""
    values, vectors = np.linalg.eigh(np.asarray(regions.cov))
    half = np.sqrt(chi_square.ppf(share, 2) * np.maximum(values[..., ::-1], 0.0))
    return half, np.arctan2(vectors[..., 1, 1], vectors[..., 0, 1])


def inside(regions: Regions, pixel: Floats, share: float = 0.99) -> Flags:
    """(..., L) which image points (..., L, 2) lie in the region that holds a `share` of honest ones."""
    off = np.asarray(pixel) - np.asarray(regions.pixel)
    white = np.linalg.solve(np.asarray(regions.cov), off[..., None])[..., 0]
    return np.sum(off * white, axis=-1) <= chi_square.ppf(share, 2)
