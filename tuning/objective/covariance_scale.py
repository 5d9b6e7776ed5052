"""The scale of all covariances at which the NEES of the attitude matches its degrees of freedom."""

from collections.abc import Sequence
from functools import partial

import jax.numpy as jnp
from jax import Array

from jaxekf._support.compilation import jit
from jaxekf._support.errors import TuningError
from jaxekf.filtering.model import Model, Parameters
from tuning.objective.data import Data
from tuning.objective.objectives import Objective, error_and_covariance, run_batch
from tuning.parametrisation.free_vector import SCALED, Layout


@partial(jit, static_argnums=(0, 1))
def _nees(model: Model, smooth: bool, every: Parameters, data: Data) -> tuple[Array, Array]:
    """Sum of normalised squared attitude errors over all judged instants, and of degrees of freedom."""
    output = run_batch(model, every, data, "estimates", smooth=smooth)
    error, cov = error_and_covariance(model, every, output, data)
    judged = data.truth["attitude"].judged
    solved = jnp.linalg.solve(cov, error[..., None])[..., 0]
    squared = jnp.where(judged, jnp.sum(error * solved, axis=-1), 0.0)
    return jnp.sum(squared), error.shape[-1] * jnp.sum(judged)


def is_open(objective: Objective, groups: Sequence[Data], where: Layout) -> bool:
    """Whether the attitude errors must fix the common scale: noise or initial belief is free, and the
    objective has errors alone."""
    free = any(leaf.name.startswith(SCALED) for leaf in where.leaves)
    alone = not objective.likelihood and not objective.truth
    return free and alone and "attitude" in groups[0].truth


def scale(
    model: Model,
    params: Parameters,
    groups: Sequence[Data],
    where: Layout,
    *,
    smooth: bool = False,
) -> float:
    """Factor on Q, R and P0 at which the attitude errors match their covariances on average.

    It changes neither the gain nor, without a gate, the estimate. With `smooth` the errors are those of
    the smoothed estimate.
    """
    if not any("attitude" in d.truth and bool(jnp.any(d.truth["attitude"].judged)) for d in groups):
        raise TuningError(
            "got no scored encoder sample, expected some to compare covariances with; tune by"
            " likelihood without rescaling"
        )
    found = [_nees(model, smooth, where.of_runs(params, d.setup, d.place), d) for d in groups]
    factor = float(sum(squared for squared, _ in found) / sum(freedom for _, freedom in found))
    if not 0.0 < factor < float("inf"):
        raise TuningError(
            f"got a mean normalised error of {factor}, expected a positive one; look for exact data"
            " or a noise that is far off"
        )
    return factor
