"""The iterated update: linearised again about its result, with the prediction's covariance as the prior.

Iterated extended Kalman filter, or Gauss-Newton for the most probable state given the prediction and the
samples of one instant,

    |local(x_predicted, x)|^2 / P + sum |local(h(x), z)|^2 / R

`jaxekf.filtering._step.update` calls it where `relinearise` is above 0.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf.filtering._covariance_update import UpdateAccumulator
from jaxekf.filtering._gating import LinearisedRows
from jaxekf.filtering._lowered_model import BoundModel, LoweredModel
from jaxekf.filtering._step import any_used, apply_sensor, mask_rows
from jaxekf.filtering.lowering.batched_products import congruence, multiply_vector
from jaxekf.filtering.lowering.lanes import materialise
from jaxekf.filtering.model import Belief


class IteratedUpdate:
    """Further linearisations of an update, each about the result of the one before.

    Parameters
    ----------
    lowered
        The model, linearised about a path (`ABOUT_PATH`).
    times
        Number of further linearisations.
    """

    def __init__(self, lowered: LoweredModel, times: int) -> None:
        self.lowered, self._times = lowered, times

    def __call__(
        self,
        bound: BoundModel,
        prior: Belief,
        posterior: Belief,
        u: Any,
        samples: Any,
        linear: dict[str, LinearisedRows],
    ) -> tuple[Belief, Array]:
        """The posterior after all linearisations, and the smallest pivot (lanes,).

        Parameters
        ----------
        bound
            `lowered` with the parameters.
        prior, posterior
            The prediction, and the result of the first update.
        u, samples
            The inputs of the update.
        linear
            The first linearisation: its masks and its noise, after gates and weights, hold throughout.
        """
        lanes, dtype = prior.cov.shape[-1], prior.cov.dtype
        first, smallest = posterior, jnp.ones(lanes, dtype)
        for _ in range(self._times):
            x = posterior.mean
            error, jacobian = bound.prior(prior.mean, x)
            accumulator = UpdateAccumulator(
                congruence(jacobian, prior.cov),
                -materialise(multiply_vector(jacobian, error)),
                jnp.zeros(lanes, dtype),
            )
            for one in self._linearise(bound, x, u, samples, linear):
                accumulator, pivot = apply_sensor(one, accumulator, adjoint=bound.adjoint)
                smallest = jnp.minimum(smallest, pivot)
            mean, reset = bound.retraction(x, accumulator.delta)
            posterior = Belief(mean, congruence(reset, accumulator.cov))
        used = any_used(linear)
        return _where(used, posterior, first), jnp.where(used, smallest, 1.0)

    def _linearise(
        self, bound: BoundModel, x: Any, u: Any, samples: Any, linear: dict[str, LinearisedRows]
    ) -> list[LinearisedRows]:
        """Residuals and Jacobians at x, with the masks and the noise of the first linearisation."""
        found = []
        for name, sample in samples.items():
            residual, jacobian, _ = bound.sensor(name, x, u, sample)
            first, sensor = linear[name].rows, self.lowered.sensors[name]
            found.append(mask_rows(sensor, residual, jacobian, first.noise, first.mask))
        return found


@lru_cache(maxsize=64)
def with_iterated_update(
    lowered: LoweredModel, about_path: LoweredModel, times: int
) -> LoweredModel:
    """The model with `times` further linearisations of every update; the same object for the same
    arguments."""
    return replace(lowered, iterated_update=IteratedUpdate(about_path, times))


def _where(used: Array, a: Belief, b: Belief) -> Belief:
    """One belief or the other, by lane."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(used.reshape((1,) * (a.ndim - 1) + (-1,)), a, b)

    return Belief(jax.tree.map(choose, a.mean, b.mean), choose(a.cov, b.cov))
