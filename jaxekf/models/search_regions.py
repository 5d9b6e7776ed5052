"""Search regions: predicted image points of landmarks with their covariances, for the model `visual`."""

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
    """(L, 2, 2) covariance, pixels squared, by the uncertainty of the pose and the noise of the point."""
    in_front: Any
    """(L,) whether the landmark is in front of the camera; otherwise the region is meaningless."""


def search_regions(params: Parameters, belief: Belief, p_ref_landmark: Array | Floats) -> Regions:
    """Predicted image points of landmarks at one instant; use `vmap` for several instants.

    With `belief` predicted to the time of an image (`FilterOutput.instants.predicted`) the regions do not
    depend on that image.

    Parameters
    ----------
    params
        Parameters of `visual`.
    belief
        State of `visual` with its covariance.
    p_ref_landmark
        (L, 3) landmarks, m, reference frame.
    """
    zero = jnp.zeros(belief.cov.shape[0], belief.cov.dtype)

    def one(place: Array) -> Regions:
        aux = visual.Point(place, jnp.zeros(()))

        def image_point(delta: Array) -> Array:
            x = manifold.retract(visual.SPACE, belief.mean, delta)
            return visual.predict_point(x, None, params, aux)

        slope = jax.jacfwd(image_point)(zero)
        cov = linalg.congruence(slope, belief.cov) + visual.point_noise(params, aux, zero[0])
        depth = visual.in_camera(belief.mean, params, place)[2]
        return Regions(image_point(zero), cov, depth > pinhole.NEAREST)

    return jax.vmap(one)(jnp.asarray(p_ref_landmark))


def ellipses(regions: Regions, share: float = 0.99) -> tuple[Floats, Floats]:
    """Confidence ellipses of the regions.

    Parameters
    ----------
    regions
        Regions (..., L).
    share
        Probability within an ellipse.

    Returns
    -------
    Half axes (..., L, 2), pixels, the longer first, and the angle (..., L), rad, of the longer from u to v.
    """
    values, vectors = np.linalg.eigh(np.asarray(regions.cov))
    half = np.sqrt(chi_square.ppf(share, 2) * np.maximum(values[..., ::-1], 0.0))
    return half, np.arctan2(vectors[..., 1, 1], vectors[..., 0, 1])


def inside(regions: Regions, pixel: Floats, share: float = 0.99) -> Flags:
    """(..., L) image points (..., L, 2) within the region that holds a `share` of true matches."""
    off = np.asarray(pixel) - np.asarray(regions.pixel)
    white = np.linalg.solve(np.asarray(regions.cov), off[..., None])[..., 0]
    return np.sum(off * white, axis=-1) <= chi_square.ppf(share, 2)
