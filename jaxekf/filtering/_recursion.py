"""The scan over time for many runs, and its reverse derivative by the adjoint.

Arguments and results carry the runs on their first axis. Inside, a batch of runs is on the last axis
(lanes) and one scan takes it through time. The derivative (section 5 of docs/mathematics.md) goes
backward segment by segment: the epochs of a segment are filtered again from the carry at its start, and
only such carries are kept. `jaxekf.filtering.ekf` calls this file.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from jaxekf.filtering._epoch import SaveSpec, ScanInit, ScanInputs, ScanOutputs, scan_epoch
from jaxekf.filtering._lowered_model import LoweredModel
from jaxekf.filtering._step import FilterCarry, initial_carry
from jaxekf.filtering.lowering.batched_vjp import cotangent_tree, merge_leaves
from jaxekf.filtering.lowering.batching import (
    BatchedArrays,
    Devices,
    batch_shape,
    map_batches,
    vmap_as_more_runs,
)
from jaxekf.filtering.lowering.packed import Packed, pack
from jaxekf.filtering.model import Belief

_CACHE_BYTES = 1 << 20
_MEMORY_BYTES = 1 << 32
_BELIEFS_PER_STEP = 8
_LONGEST_SEGMENT = 16


# --- one batch of runs, on the batch axis -------------------------------------------------------------


def _scan(
    lowered: LoweredModel,
    save: SaveSpec,
    segment: int | None,
    prepared: Any,
    first: ScanInit,
    inputs: ScanInputs,
) -> tuple[ScanOutputs, FilterCarry | None]:
    """All epochs; with `segment` also the carry at the start of every `segment` epochs.

    It is not differentiated itself: `_scan_adjoint` is its derivative.
    """
    carry = initial_carry(lowered, *first)
    bound = lowered.bind(prepared, adjoint=False)

    def epoch(carry: FilterCarry, inputs: Packed) -> tuple[FilterCarry, Packed]:
        carry, outputs = scan_epoch(bound, save, carry, inputs.unpack())
        return carry, pack(outputs)

    if segment is None:
        return lax.scan(epoch, carry, pack(inputs, 1))[1].unpack(), None

    def scan_segment(carry: FilterCarry, inputs: Packed) -> tuple[FilterCarry, Any]:
        after, outputs = lax.scan(epoch, carry, inputs)
        return after, (outputs, carry)

    epochs = inputs.substeps.dt.shape[0]
    segments = _split_segments(pack(_pad_epochs(inputs, segment), 1), segment)
    outputs, starts = lax.scan(scan_segment, carry, segments)[1]
    return _merge_segments(outputs, epochs).unpack(), starts


def _pad_epochs(inputs: ScanInputs, segment: int) -> ScanInputs:
    """`inputs` with inert epochs at the end, so that segments divide it: no time passes, no row is visible.

    Everything else is as at the last epoch, since a sampling period of zero, say, would divide the noise.
    """
    more = -inputs.substeps.dt.shape[0] % segment
    if not more:
        return inputs

    def hidden(samples: Any) -> Any:
        return {
            name: rows._replace(mask=jnp.zeros_like(rows.mask)) for name, rows in samples.items()
        }

    last = jax.tree.map(lambda a: jnp.broadcast_to(a[-1:], (more, *a.shape[1:])), inputs)
    still = last.substeps._replace(dt=jnp.zeros_like(last.substeps.dt))
    inert = ScanInputs(still, hidden(last.fast), hidden(last.slow))
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), inputs, inert)


def _split_segments(tree: Any, segment: int) -> Any:
    """Arrays (K, ...) in segments (K / segment, segment, ...), the last filled with zeros."""

    def split(a: Array) -> Array:
        more = -a.shape[0] % segment
        if more:
            a = jnp.concatenate([a, jnp.zeros((more, *a.shape[1:]), a.dtype)])
        return a.reshape(-1, segment, *a.shape[1:])

    return jax.tree.map(split, tree)


def _merge_segments(tree: Any, epochs: int) -> Any:
    """The inverse of `_split_segments`: (epochs, ...), without the zeros."""
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:epochs], tree)


@dataclass(frozen=True)
class _PerturbedLeaves:
    """Which leaves of `prepared` and of the inputs a derivative is asked for; known at trace time."""

    prepared: tuple[bool, ...]
    inputs: tuple[bool, ...]


jax.tree_util.register_static(_PerturbedLeaves)


def _scan_adjoint(
    lowered: LoweredModel,
    save: SaveSpec,
    segment: int,
    perturbed: _PerturbedLeaves,
    live: tuple[bool, ...],
    starts: FilterCarry,
    prepared: Any,
    inputs: ScanInputs,
    cotangents: list[Array],
) -> tuple[Any, Belief, list[Array]]:
    """Cotangents of the perturbed leaves of `prepared`, of the first belief, and of the perturbed inputs.

    `cotangents` are those of the `live` leaves of `ScanOutputs`; the others have none. A segment is
    filtered again from its start, and the VJP residuals of each epoch are kept until the backward pass
    through it.
    """
    epochs = inputs.substeps.dt.shape[0]
    leaves, tree = jax.tree.flatten(_pad_epochs(inputs, segment))
    values, prepared_tree = jax.tree.flatten(prepared)
    floats = [v for f, v in zip(perturbed.prepared, values, strict=True) if f]
    residuals = _VjpResiduals()

    def adjoint_segment(adjoint: Any, segment_inputs: Any) -> Any:
        start, inputs, cotangents = segment_inputs

        def forward_epoch(carry: FilterCarry, inputs: Packed) -> tuple[FilterCarry, Packed]:
            leaves = inputs.unpack()

            def epoch(floats: list[Array], carry: FilterCarry, moved: list[Array]) -> Any:
                full = jax.tree.unflatten(tree, merge_leaves(perturbed.inputs, moved, leaves))
                own = merge_leaves(perturbed.prepared, floats, values)
                bound = lowered.bind(jax.tree.unflatten(prepared_tree, own), adjoint=True)
                carry, outputs = scan_epoch(bound, save, carry, full)
                live_outputs = zip(live, jax.tree.leaves(outputs), strict=True)
                return (carry, [v for f, v in live_outputs if f])

            moved = [v for f, v in zip(perturbed.inputs, leaves, strict=True) if f]
            (carry, _), vjp = jax.vjp(epoch, floats, carry, moved)
            return carry, pack(residuals.take(vjp, values, leaves))

        def backward_epoch(adjoint: Any, epoch_inputs: Any) -> Any:
            after, total = adjoint
            saved, leaves, cotangents = (one.unpack() for one in epoch_inputs)
            vjp = residuals.restore(saved, values, leaves)
            of_floats, before, of_inputs = vjp((after, cotangents))
            return (before, jax.tree.map(jnp.add, total, of_floats)), pack(of_inputs)

        _, saved = lax.scan(forward_epoch, start, inputs)
        return lax.scan(backward_epoch, adjoint, (saved, inputs, cotangents), reverse=True)

    zero = jax.tree.map(lambda a: jnp.zeros(a.shape[1:], a.dtype), starts)
    adjoint = (zero, jax.tree.map(jnp.zeros_like, floats))
    split_inputs = _split_segments(pack(leaves, 1), segment)
    segments = (starts, split_inputs, _split_segments(pack(cotangents, 1), segment))
    (first, total), of_inputs = lax.scan(adjoint_segment, adjoint, segments, reverse=True)
    return total, first.belief, _merge_segments(of_inputs, epochs).unpack()


class _VjpResiduals:
    """The residuals of an epoch's VJP as arrays that a scan can hand over.

    Arrays that both the forward and the backward scan have anyway are left out.
    """

    def __init__(self) -> None:
        self._tree: Any = None
        self._places: list[tuple[int, int] | None] = []

    def take(self, vjp: Any, *shared: list[Array]) -> list[Array]:
        """The arrays that `vjp` holds and none of the lists `shared` does."""
        places = {id(a): (i, k) for i, own in enumerate(shared) for k, a in enumerate(own)}
        leaves, self._tree = jax.tree.flatten(vjp)
        self._places = [places.get(id(leaf)) for leaf in leaves]
        return [leaf for leaf, at in zip(leaves, self._places, strict=True) if at is None]

    def restore(self, saved: list[Array], *shared: list[Array]) -> Any:
        """The VJP function, from the result of `take` and the same lists."""
        own = iter(saved)
        leaves = [next(own) if at is None else shared[at[0]][at[1]] for at in self._places]
        return jax.tree.unflatten(self._tree, leaves)


# --- all runs -----------------------------------------------------------------------------------------


def filter_with_jax_derivatives(
    lowered: LoweredModel,
    save: SaveSpec,
    checkpoint: bool,
    prepared: Any,
    first: ScanInit,
    inputs: ScanInputs,
) -> ScanOutputs:
    """The filter with JAX's own derivatives, forward and reverse."""

    def scan(_: None, prepared: Any, first: ScanInit, inputs: ScanInputs) -> Any:
        epoch = partial(scan_epoch, lowered.bind(prepared, adjoint=False), save)
        if checkpoint:
            epoch = jax.checkpoint(epoch)
        return lax.scan(epoch, initial_carry(lowered, *first), inputs)[1], None

    return map_batches((), scan, None, prepared, first, inputs)[0]


def filter_with_adjoint(
    lowered: LoweredModel,
    save: SaveSpec,
    segment: int,
    devices: Devices,
    prepared: Any,
    first: ScanInit,
    inputs: ScanInputs,
) -> ScanOutputs:
    """The filter with its reverse derivative by the adjoint; `segment` epochs between kept carries."""
    return _with_adjoint(lowered, save, segment, devices)(prepared, first, inputs)


@lru_cache(maxsize=64)
def _with_adjoint(
    lowered: LoweredModel, save: SaveSpec, segment: int, devices: Devices
) -> Callable[..., Any]:
    def run(segment: int | None, _: None, *trees: Any) -> Any:
        def scan(_: None, *trees: Any) -> Any:
            return _scan(lowered, save, segment, *trees)

        outputs, starts = map_batches(devices, scan, None, *trees)
        if segment is None:
            return outputs, None
        return outputs, BatchedArrays(starts, jnp.zeros(jax.tree.leaves(trees)[0].shape[0]))

    forward_only = vmap_as_more_runs(devices, partial(run, None))
    forward_saving = vmap_as_more_runs(devices, partial(run, segment))

    @jax.custom_vjp
    def function(prepared: Any, first: ScanInit, inputs: ScanInputs) -> ScanOutputs:
        return forward_only(None, prepared, first, inputs)[0]

    def forward(prepared: Any, first: ScanInit, inputs: ScanInputs) -> Any:
        perturbed = _PerturbedLeaves(_perturbed(prepared), _perturbed(inputs))
        values = jax.tree.map(lambda leaf: leaf.value, (prepared, first, inputs))
        outputs, starts = forward_saving(None, *values)
        return outputs, (values[0], starts, values[2], perturbed, values[1].rejecting_s)

    def backward(saved: Any, cotangents: Any) -> Any:
        prepared, starts, inputs, perturbed, rejecting_s = saved
        cotangents = _symmetrise_cotangents(cotangents)
        leaves = jax.tree.leaves(cotangents, is_leaf=lambda c: isinstance(c, SymbolicZero))
        live = tuple(
            not isinstance(c, SymbolicZero) and jnp.issubdtype(c.dtype, jnp.inexact) for c in leaves
        )
        chosen = [c for flag, c in zip(live, leaves, strict=True) if flag]
        back = _adjoint_of_runs(lowered, save, segment, devices, perturbed, live)
        total, first, of_inputs = back(starts, prepared, inputs, chosen)[0]
        # The times of rejected samples decide which samples are accepted, but have no derivative.
        rejecting_s = None if rejecting_s is None else jnp.zeros_like(rejecting_s)
        inputs_bar = cotangent_tree(inputs, perturbed.inputs, of_inputs)
        prepared_bar = cotangent_tree(prepared, perturbed.prepared, total)
        return prepared_bar, ScanInit(first, rejecting_s), inputs_bar

    function.defvjp(forward, backward, symbolic_zeros=True)
    return function


def _perturbed(tree: Any) -> tuple[bool, ...]:
    """Which leaves, of a `custom_vjp` with symbolic zeros, have a derivative."""
    return tuple(
        bool(leaf.perturbed) and jnp.issubdtype(leaf.value.dtype, jnp.inexact)
        for leaf in jax.tree.leaves(tree)
    )


@lru_cache(maxsize=256)
def _adjoint_of_runs(
    lowered: LoweredModel,
    save: SaveSpec,
    segment: int,
    devices: Devices,
    perturbed: _PerturbedLeaves,
    live: tuple[bool, ...],
) -> Callable[..., Any]:
    def scan(starts: FilterCarry, *trees: Any) -> Any:
        return _scan_adjoint(lowered, save, segment, perturbed, live, starts, *trees), None

    def run(starts: BatchedArrays, *trees: Any) -> Any:
        count, size = batch_shape(jax.tree.leaves(trees)[0].shape[0], devices)

        def fitting(a: Array) -> Array:
            # `custom_vmap` traces this for one member of a `vmap` before it asks for all of them, and
            # the batches hold all of them already: of that trace only the shapes are used.
            if (a.shape[0], a.shape[-1]) == (count, size):
                return a
            return jnp.zeros((count, *a.shape[1:-1], size), a.dtype)

        arrays = jax.tree.map(fitting, starts.arrays)
        return map_batches(devices, scan, arrays, *trees)

    return vmap_as_more_runs(devices, run)


def _symmetrise_cotangents(cotangents: ScanOutputs) -> ScanOutputs:
    """Cotangents whose covariances (runs, K, S, n, n) are symmetric, as the closed forms need them."""

    def symmetric(cov: Any) -> Any:
        if cov is None or isinstance(cov, SymbolicZero):
            return cov
        return 0.5 * (cov + cov.swapaxes(-1, -2))

    prior = cotangents.prior
    if prior is not None:
        prior = prior._replace(cov=symmetric(prior.cov))
    return cotangents._replace(prior=prior, cov=symmetric(cotangents.cov))


def segment_length(epochs: int, substeps: int, bytes_per_belief: int) -> int:
    """Number of epochs between kept carries.

    The VJP residuals of a segment, about `_BELIEFS_PER_STEP` beliefs a substep, should fit into the second
    cache; in a very long run the kept carries should not fill the memory.
    """
    fitting = _CACHE_BYTES // (_BELIEFS_PER_STEP * substeps * bytes_per_belief)
    segment = min(max(fitting, 2), _LONGEST_SEGMENT)
    if epochs * bytes_per_belief > segment * _MEMORY_BYTES:
        segment = max(segment, math.isqrt(epochs))
    return segment
