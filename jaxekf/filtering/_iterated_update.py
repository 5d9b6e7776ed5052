"""The update linearised again about what it found, the prediction's covariance being the prior throughout.

Iterated extended Kalman filter: Gauss-Newton for the most probable state given the prediction and the
samples of one instant,

    |local(x_predicted, x)|^2 / P + sum |local(h(x), z)|^2 / R
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf.filtering import _covariance_algebra as covariance_algebra
from jaxekf.filtering._covariance_algebra import Gained
from jaxekf.filtering._gating import Linear
from jaxekf.filtering._lowered_model import System
from jaxekf.filtering._lowered_path import AboutSystem
from jaxekf.filtering._step import any_used, hide, take_block
from jaxekf.filtering.lowering.lanes import stage
from jaxekf.filtering.model import Belief
from jaxekf.geometry import linalg


class Again:
    """So many further linearisations, each about where the one before arrived."""

    def __init__(self, system: AboutSystem, times: int) -> None:
        self._system, self._times = system, times

    def prepare(self, params: Any) -> Any:
        """What it needs of the parameters, for one run."""
        return self._system.prepare(params)

    def __call__(
        self,
        prepared: Any,
        prior: Belief,
        found: Belief,
        u: Any,
        samples: Any,
        linear: dict[str, Linear],
        *,
        adjoint: bool,
    ) -> tuple[Belief, Array]:
        """The posterior, from the one `found` at first, and the smallest pivot; on lanes.

        `linear` tells which rows count and with what noise.
        """
        lanes, dtype = prior.cov.shape[-1], prior.cov.dtype
        posterior, smallest = found, jnp.ones(lanes, dtype)
        for _ in range(self._times):
            x = posterior.mean
            away, changed = self._system.start(prepared["start"], prior.mean, x, adjoint=adjoint)
            before = Gained(
                turned(changed, prior.cov),
                -stage(covariance_algebra.apply(changed, away)),
                jnp.zeros(lanes, dtype),
            )
            rows = self._looked(prepared, x, u, samples, linear, adjoint)
            for one in rows.values():
                before, pivot = take_block(one.slope, before, one.rows, adjoint)
                smallest = jnp.minimum(smallest, pivot)
            moved, reset = self._system.move(prepared["move"], x, before.delta, adjoint=adjoint)
            posterior = Belief(moved, turned(reset, before.cov))
        used = any_used(linear)
        return _where(used, posterior, found), jnp.where(used, smallest, 1.0)

    def _looked(
        self, prepared: Any, x: Any, u: Any, samples: Any, linear: dict[str, Linear], adjoint: bool
    ) -> dict[str, Linear]:
        """Residuals and slopes at x, with the masks and the noise of the first look."""
        rows = {}
        for name, sample in samples.items():
            measurement = self._system.measurements[name]
            constants = prepared[f"sensor {name}"]
            residual, slope, _ = measurement(constants, x, u, sample, adjoint=adjoint)
            first = linear[name].rows
            rows[name] = hide(measurement, residual, slope, first.noise, first.mask)
        return rows


@lru_cache(maxsize=64)
def again(system: AboutSystem, times: int) -> Again:
    """The same object for the same arguments."""
    return Again(system, times)


@lru_cache(maxsize=64)
def with_again(ready: System, more: Again) -> System:
    """The system that linearises again; the same object for the same arguments."""
    return replace(ready, again=more)


def _where(used: Array, a: Belief, b: Belief) -> Belief:
    """One belief or the other, lane by lane."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(used.reshape((1,) * (a.ndim - 1) + (-1,)), a, b)

    return Belief(jax.tree.map(choose, a.mean, b.mean), choose(a.cov, b.cov))


def turned(matrix: Array, cov: Array) -> Array:
    """``M P M'``."""
    half = stage(covariance_algebra.product(matrix, cov))
    return stage(linalg.symmetrise(covariance_algebra.product_transposed(half, matrix)))
