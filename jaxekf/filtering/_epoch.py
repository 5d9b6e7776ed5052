"""One epoch of the filter: a scan over its substeps, and the inputs and outputs of the scan over epochs.

Fast sensors are sampled at every substep, slow ones at the last. Arrays carry the runs on the last axis
(lanes) inside `scan_epoch`. `jaxekf.filtering._recursion` scans it over time.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf.filtering._lowered_model import BoundModel
from jaxekf.filtering._step import FilterCarry, StepOutput, SubstepInput, predict, update
from jaxekf.filtering.model import Belief
from jaxekf.geometry import linalg

_LARGEST_UNROLLED_SUBSTEPS = 2


class ScanInputs(NamedTuple):
    """The inputs of the scan over epochs; leading axes (K, S), slow samples (K,)."""

    substeps: SubstepInput
    fast: Any
    """`Rows` by sensor."""
    slow: Any
    """`Rows` by sensor."""


class ScanInit(NamedTuple):
    """The start of a run."""

    belief: Belief
    rejecting_s: Array | None = None
    """Seconds of rejected samples before the start, as in `FilterCarry`."""


class ScanOutputs(NamedTuple):
    """The results of every substep that were kept, leading axes (K, S); None if not kept."""

    prior: Belief | None
    mean: Any
    cov: Array | None
    log_likelihood: Array
    healthy: Array
    used: Any
    """By sensor; (K, S, rows) for fast sensors, (K, rows) for slow ones."""
    gated: Any
    """Likewise."""
    recovered: Array | None
    """(K, S) where the gates were reset; None without gates."""
    rejecting_s: Array | None
    """(K, S) as in `FilterCarry`."""


class SaveSpec(NamedTuple):
    """Which results to keep besides means and log-likelihoods."""

    prior: bool
    cov: bool
    used: bool
    """Rows used and gated, and gate resets."""


def _select(save: SaveSpec, output: StepOutput) -> ScanOutputs:
    return ScanOutputs(
        output.prior if save.prior else None,
        output.carry.belief.mean,
        linalg.symmetrise(output.carry.belief.cov) if save.cov else None,
        output.log_likelihood,
        output.healthy,
        output.used if save.used else {},
        output.gated if save.used else {},
        output.recovered if save.used else None,
        output.carry.rejecting_s if save.used else None,
    )


def scan_epoch(
    bound: BoundModel, save: SaveSpec, carry: FilterCarry, inputs: ScanInputs
) -> tuple[FilterCarry, ScanOutputs]:
    """All substeps of one epoch; slow sensors are sampled at the last."""
    earlier_count = inputs.substeps.dt.shape[0] - 1

    def ahead(carry: FilterCarry, own: SubstepInput) -> FilterCarry:
        return carry._replace(belief=predict(bound, carry.belief, own))

    def correct(predicted: FilterCarry, u: Any, samples: Any) -> tuple[FilterCarry, ScanOutputs]:
        output = update(bound, predicted, u, samples)
        return output.carry, _select(save, output)

    def substep(carry: FilterCarry, substep_inputs: Any) -> tuple[FilterCarry, ScanOutputs]:
        own, samples = substep_inputs
        return correct(ahead(carry, own), own.u, samples)

    own_and_fast = (inputs.substeps, inputs.fast)
    own, fast = jax.tree.map(lambda a: a[-1], own_and_fast)
    if earlier_count and not inputs.fast:
        # One scan over all predictions: the transition is compiled once, not twice.
        predicted, outputs = lax.scan(substep, carry, own_and_fast)
        carry, last = correct(predicted, own.u, inputs.slow)
        earlier = jax.tree.map(lambda a: a[:-1], outputs)
        return carry, _with_last(earlier, last, inputs.slow)
    earlier = None
    if earlier_count:
        before = jax.tree.map(lambda a: a[:-1], own_and_fast)
        unroll = earlier_count <= _LARGEST_UNROLLED_SUBSTEPS
        carry, earlier = lax.scan(substep, carry, before, unroll=unroll)
    carry, last = correct(ahead(carry, own), own.u, fast | inputs.slow)
    return carry, _with_last(earlier, last, inputs.slow)


def _with_last(earlier: ScanOutputs | None, last: ScanOutputs, slow: Any) -> ScanOutputs:
    """The outputs of all substeps of an epoch; those of slow sensors have no substep axis."""
    both = (last.used, last.gated)
    of_slow = [{name: v for name, v in part.items() if name in slow} for part in both]
    of_fast = [{name: v for name, v in part.items() if name not in slow} for part in both]
    last = last._replace(used=of_fast[0], gated=of_fast[1])
    if earlier is None:
        whole = jax.tree.map(lambda a: a[None], last)
    else:
        whole = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), earlier, last)
    return whole._replace(used=whole.used | of_slow[0], gated=whole.gated | of_slow[1])
