"""The smoother's backward pass for a batch of runs, on the batch axis.

Modified Bryson-Frazier form: the samples after an instant are carried back as information on the error
there, so that no predicted covariance is inverted and the process noise may be singular. With the belief
(x, P) of the filter and the information (a, L) of later samples,

    x_smoothed = retract(x, P a),    P_smoothed = P - P L P,

in the tangent space at the smoothed mean. For a linear system both are those of Rauch, Tung and Striebel.
`jaxekf.filtering.smoother` and `iterated_smoother` call this file.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf.filtering import _covariance_prediction as covariance_prediction
from jaxekf.filtering import _covariance_update as covariance_update
from jaxekf.filtering import _repeated_groups as repeated_groups
from jaxekf.filtering import _substeps as substeps
from jaxekf.filtering._covariance_update import UpdateAccumulator
from jaxekf.filtering._epoch import ScanInit, ScanInputs
from jaxekf.filtering._lowered_model import BoundModel, LoweredModel
from jaxekf.filtering._step import (
    AppliedSensor,
    FilterCarry,
    SubstepInput,
    any_used,
    apply_sensor_saving,
    initial_carry,
    linearise_and_gate,
)
from jaxekf.filtering.lowering import structured_matrix
from jaxekf.filtering.lowering.batched_products import multiply, multiply_vector
from jaxekf.filtering.lowering.lanes import materialise
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern
from jaxekf.filtering.model import Belief
from jaxekf.geometry import linalg


class Information(NamedTuple):
    """Information of later samples on the error at an instant."""

    vector: Array
    """a, (n, lanes)."""
    matrix: Array
    """L, (n, n, lanes)."""


class FilteredBeliefs(NamedTuple):
    """The filter's results that the backward pass needs; leading axes (K, S)."""

    prior: Belief
    updated: Belief
    rejecting_s: Array | None
    """As in `FilterCarry`."""


class _SmootherInput(NamedTuple):
    """One substep of the backward pass."""

    substep: SubstepInput
    mean_before: Any
    """Filtered mean at the end of the substep before."""
    rejecting_before_s: Array | None
    """`FilterCarry.rejecting_s` at the end of the substep before."""
    filtered: FilteredBeliefs


def smooth_backward(
    lowered: LoweredModel,
    adjoint: bool,
    prepared: Any,
    first: ScanInit,
    inputs: ScanInputs,
    filtered: FilteredBeliefs,
) -> tuple[Belief, Belief]:
    """The smoothed beliefs at every substep, leading axes (K, S), and at the start of the run.

    Parameters
    ----------
    lowered, adjoint, prepared
        The model, and the arguments of `LoweredModel.bind`.
    first, inputs
        The arguments of the filter.
    filtered
        Its results.
    """
    bound = lowered.bind(prepared, adjoint=adjoint)
    size, lanes = first.belief.cov.shape[1:]
    dtype = first.belief.cov.dtype
    nothing = Information(jnp.zeros((size, lanes), dtype), jnp.zeros((size, size, lanes), dtype))
    start = initial_carry(lowered, *first)
    before = jax.tree.map(shift_by_one, start.belief.mean, filtered.updated.mean)
    rejecting_s = None
    if start.rejecting_s is not None and filtered.rejecting_s is not None:
        rejecting_s = shift_by_one(start.rejecting_s, filtered.rejecting_s)
    own = _SmootherInput(inputs.substeps, before, rejecting_s, filtered)
    epoch = partial(_epoch, bound)
    info, found = lax.scan(epoch, nothing, (own, inputs.fast, inputs.slow), reverse=True)
    return found, smoothed(bound, first.belief, info)


def shift_by_one(first: Array, values: Array) -> Array:
    """The values (K, S, ...) at the end of each substep before; `first` is the value at the start."""
    flat = values.reshape(-1, *values.shape[2:])
    return jnp.concatenate([first[None], flat[:-1]]).reshape(values.shape)


def _epoch(bound: BoundModel, info: Information, epoch_inputs: Any) -> tuple[Information, Belief]:
    """All substeps of one epoch, the last first; slow sensors are sampled at the last."""
    own, fast, slow = epoch_inputs

    def substep(info: Information, substep_inputs: Any) -> tuple[Information, Belief]:
        own, samples = substep_inputs
        belief = smoothed(bound, own.filtered.updated, info)
        info = _information_before_update(bound, info, own, samples)
        return _information_before_prediction(bound, info, own), belief

    return substeps.scan_substeps_backward(substep, info, (own, fast), slow)


def smoothed_covariance(cov: Array, matrix: Array) -> Array:
    """``P - P L P``, (n, n, lanes)."""
    gain = materialise(multiply(matrix, cov))
    return materialise(linalg.symmetrise(cov - materialise(multiply(cov, gain))))


def smoothed(bound: BoundModel, belief: Belief, info: Information) -> Belief:
    """The filter's belief with the information of later samples."""
    p = belief.cov
    delta = materialise(multiply_vector(p, info.vector))
    cov = smoothed_covariance(p, info.matrix)
    mean, reset, _ = bound.correction(belief.mean, delta, jnp.ones(p.shape[-1], bool))
    pattern = bound.lowered.reset_pattern
    if not pattern.is_identity:
        cov = linalg.symmetrise(covariance_prediction.congruence(pattern, reset, cov))
    return Belief(mean, cov)


def _information_before_prediction(
    bound: BoundModel, info: Information, own: _SmootherInput
) -> Information:
    """``F' a`` and ``F' L F``."""
    _, f, _ = bound.transition(own.mean_before, own.substep.u, own.substep.dt)
    return pull_back(bound.lowered.transition.f_pattern, f, info)


def pull_back(p: Pattern, bands: Bands, info: Information) -> Information:
    """``M' a`` and ``M' L M``: information on ``M x`` as information on ``x``."""
    back, transposed = p.transposed, structured_matrix.transpose_bands(bands)
    vector = materialise(structured_matrix.multiply(back, transposed, info.vector))
    matrix = covariance_prediction.congruence(back, transposed, info.matrix)
    return Information(vector, linalg.symmetrise(matrix))


def _information_before_update(
    bound: BoundModel, info: Information, own: _SmootherInput, samples: dict[str, Any]
) -> Information:
    """The information before the samples of an instant, which are applied again to get their gains."""
    if not samples:
        return info
    prior = own.filtered.prior
    predicted = FilterCarry(prior, own.rejecting_before_s)
    result, cov = linearise_and_gate(bound, predicted, own.substep.u, samples)
    linear = result.linear
    accumulator = UpdateAccumulator(cov, jnp.zeros_like(cov[0]), jnp.zeros_like(cov[0, 0]))
    applied = []
    for one in linear.values():
        accumulator, saved = apply_sensor_saving(one, accumulator)
        applied.append(saved)
    _, reset, shift = bound.correction(prior.mean, accumulator.delta, any_used(linear))
    if shift is not None:
        # The model's constraint moved the mean: the information refers to the mean before that.
        vector = info.vector + materialise(multiply_vector(info.matrix, shift))
        info = info._replace(vector=vector)
    pattern = bound.lowered.reset_pattern
    if not pattern.is_identity:
        info = pull_back(pattern, reset, info)
    for saved in reversed(applied):
        info = information_before_rows(saved, info)
    return info


def information_before_rows(applied: AppliedSensor, info: Information) -> Information:
    """The information before the rows of one sensor: ``A' a + H' s`` and ``A' L A + H' S^-1 H``, with
    ``A = I - K H`` and s the weighted innovation."""
    p, rows, blocks = applied
    if repeated_groups.has_group_axis(rows.mask):

        def one(info: Information, group: Any) -> tuple[Information, None]:
            return information_before_rows(AppliedSensor(p, *group), info), None

        return lax.scan(one, info, (rows, blocks), reverse=True)[0]
    vector, matrix = info
    pairs = list(zip(covariance_update.row_blocks(p, rows), blocks, strict=True))
    for block, (gain, inverse, weighted) in reversed(pairs):
        matrix, _ = covariance_update.information_before_block(block, gain, matrix, inverse, None)
        push = materialise(block.masked(weighted - multiply_vector(gain, vector)))
        vector = materialise(vector + block.transposed_multiply(push))
    return Information(vector, matrix)
