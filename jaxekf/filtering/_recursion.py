"""The recursion over time: many runs in blocks of lanes, and its derivative by the adjoint.

Arguments and results carry the runs on their first axis. Inside, a block of runs lies on the last axis
and one scan takes it through time. The derivative goes back through the same steps, a few at a
time: they are filtered again from the belief they started from, and only such beliefs are kept.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from jaxekf.filtering._lowered_model import System
from jaxekf.filtering._step import Moment, Outcome, Track, begin, predict, update
from jaxekf.filtering.lowering.batched_vjp import merge, unfilled
from jaxekf.filtering.lowering.blocks import Blocks, Devices, in_blocks, over_more_runs, shape_of
from jaxekf.filtering.lowering.packed import Packed, packed
from jaxekf.filtering.model import Belief
from jaxekf.geometry import linalg

_LARGEST_UNROLLED_SUBSTEPS = 2
_CACHE_BYTES = 1 << 20
_MEMORY_BYTES = 1 << 32
_BELIEFS_PER_STEP = 8
_LONGEST_SEGMENT = 16


class Given(NamedTuple):
    """What the recursion is driven with; leading axes (K, S), slow samples (K,)."""

    moments: Moment
    fast: Any
    slow: Any


class First(NamedTuple):
    """What a run starts from."""

    belief: Belief
    refused: Array | None = None
    """Seconds of refused samples before the start."""


class Kept(NamedTuple):
    """What of every substep is kept; leading axes (K, S). None where it was not asked for."""

    prior: Belief | None
    mean: Any
    cov: Array | None
    log_likelihood: Array
    healthy: Array
    used: Any
    """By sensor; (K, S, rows) for fast sensors, (K, rows) for slow ones."""
    gated: Any
    recovered: Array | None
    """(K, S) where the gates were opened; None without gates."""
    refused: Array | None
    """(K, S) as in `Track`."""


class What(NamedTuple):
    """What to keep besides means and log-likelihoods."""

    prior: bool
    cov: bool
    used: bool


def _keep(what: What, outcome: Outcome) -> Kept:
    return Kept(
        outcome.prior if what.prior else None,
        outcome.after.belief.mean,
        linalg.symmetrise(outcome.after.belief.cov) if what.cov else None,
        outcome.log_likelihood,
        outcome.healthy,
        outcome.used if what.used else {},
        outcome.gated if what.used else {},
        outcome.recovered if what.used else None,
        outcome.after.refused if what.used else None,
    )


def _epoch(
    system: System, what: What, adjoint: bool, prepared: Any, track: Track, given: Given
) -> tuple[Track, Kept]:
    """All substeps of one epoch; slow sensors are taken at the last."""
    count = given.moments.dt.shape[0] - 1

    def ahead(track: Track, moment: Moment) -> Track:
        belief = predict(system, prepared, track.belief, moment, adjoint=adjoint)
        return track._replace(belief=belief)

    def take(ahead: Track, u: Any, samples: Any) -> tuple[Track, Kept]:
        outcome = update(system, prepared, ahead, u, samples, adjoint=adjoint)
        return outcome.after, _keep(what, outcome)

    def substep(track: Track, at: Any) -> tuple[Track, Kept]:
        moment, samples = at
        return take(ahead(track, moment), moment.u, samples)

    every = (given.moments, given.fast)
    moment, fast = jax.tree.map(lambda a: a[-1], every)
    if count and not given.fast:
        # One scan over all predictions: the transition is compiled once, not twice.
        prior, kept = lax.scan(substep, track, every)
        track, last = take(prior, moment.u, given.slow)
        earlier = jax.tree.map(lambda a: a[:-1], kept)
        return track, _gathered(earlier, last, given.slow)
    earlier = None
    if count:
        before = jax.tree.map(lambda a: a[:-1], every)
        unroll = count <= _LARGEST_UNROLLED_SUBSTEPS
        track, earlier = lax.scan(substep, track, before, unroll=unroll)
    track, last = take(ahead(track, moment), moment.u, fast | given.slow)
    return track, _gathered(earlier, last, given.slow)


def _gathered(earlier: Kept | None, last: Kept, slow: Any) -> Kept:
    """The substeps of an epoch one after the other; what slow sensors did apart from them."""
    both = (last.used, last.gated)
    ended = [{name: v for name, v in part.items() if name in slow} for part in both]
    fast = [{name: v for name, v in part.items() if name not in slow} for part in both]
    last = last._replace(used=fast[0], gated=fast[1])
    if earlier is None:
        whole = jax.tree.map(lambda a: a[None], last)
    else:
        whole = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), earlier, last)
    return whole._replace(used=whole.used | ended[0], gated=whole.gated | ended[1])


# --- one block of runs, on lanes ----------------------------------------------------------------------


def _scan(
    system: System,
    what: What,
    adjoint: bool,
    segment: int | None,
    prepared: Any,
    first: First,
    given: Given,
) -> tuple[Kept, Track | None]:
    """All epochs; also, where `segment` is given, the track at the start of every `segment` epochs."""
    track = begin(system, *first)

    def epoch(track: Track, given: Packed) -> tuple[Track, Packed]:
        after, kept = _epoch(system, what, adjoint, prepared, track, given.opened())
        return after, packed(kept)

    if segment is None:
        return lax.scan(epoch, track, packed(given, 1))[1].opened(), None

    def stretch(track: Track, given: Packed) -> tuple[Track, tuple[Packed, Track]]:
        after, kept = lax.scan(epoch, track, given)
        return after, (kept, track)

    epochs = given.moments.dt.shape[0]
    pieces = _cut(packed(_filled(given, segment), 1), segment)
    kept, starts = lax.scan(stretch, track, pieces)[1]
    return _joined(kept, epochs).opened(), starts


def _filled(given: Given, segment: int) -> Given:
    """`given` with inert steps at the end, so that segments divide it: no time passes, no row is visible.

    All else is as at the last step, for a sampling period of zero, say, would divide the noise.
    """
    more = -given.moments.dt.shape[0] % segment
    if not more:
        return given

    def hidden(samples: Any) -> Any:
        return {
            name: rows._replace(mask=jnp.zeros_like(rows.mask)) for name, rows in samples.items()
        }

    last = jax.tree.map(lambda a: jnp.broadcast_to(a[-1:], (more, *a.shape[1:])), given)
    still = last.moments._replace(dt=jnp.zeros_like(last.moments.dt))
    inert = Given(still, hidden(last.fast), hidden(last.slow))
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), given, inert)


def _cut(tree: Any, segment: int) -> Any:
    """Arrays (K, ...) in segments (K / segment, segment, ...), the last filled with zeros."""

    def cut(a: Array) -> Array:
        more = -a.shape[0] % segment
        if more:
            a = jnp.concatenate([a, jnp.zeros((more, *a.shape[1:]), a.dtype)])
        return a.reshape(-1, segment, *a.shape[1:])

    return jax.tree.map(cut, tree)


def _joined(tree: Any, epochs: int) -> Any:
    """The segments of `_cut` as (epochs, ...) again, without what filled the last one."""
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:epochs], tree)


@dataclass(frozen=True)
class _Flags:
    """Which leaves a derivative is asked by; known when the program is traced."""

    prepared: tuple[bool, ...]
    given: tuple[bool, ...]


jax.tree_util.register_static(_Flags)


def _scan_back(
    system: System,
    what: What,
    segment: int,
    free: tuple[bool, ...],
    moving: tuple[bool, ...],
    live: tuple[bool, ...],
    starts: Track,
    prepared: Any,
    given: Given,
    cotangents: list[Array],
) -> tuple[Any, Belief, list[Array]]:
    """Cotangents of what was prepared, of the first belief, and of the moving leaves of `given`.

    `cotangents` are those of the live leaves of `Kept`; the others have none. A segment is filtered again
    from its start, and what the derivative of each epoch needs is kept until the way back through it.
    """
    epochs = given.moments.dt.shape[0]
    every, tree = jax.tree.flatten(_filled(given, segment))
    values, prepared_tree = jax.tree.flatten(prepared)
    floats = [v for f, v in zip(free, values, strict=True) if f]
    pulls = _Pulls()

    def stretch(carry: Any, at: Any) -> Any:
        start, given, cotangents = at

        def step(track: Track, given: Packed) -> tuple[Track, Packed]:
            leaves = given.opened()

            def forward(floats: list[Array], track: Track, moved: list[Array]) -> Any:
                full = jax.tree.unflatten(tree, merge(moving, moved, leaves))
                own = jax.tree.unflatten(prepared_tree, merge(free, floats, values))
                track, kept = _epoch(system, what, True, own, track, full)
                live_kept = zip(live, jax.tree.leaves(kept), strict=True)
                return (track, [v for f, v in live_kept if f])

            moved = [v for f, v in zip(moving, leaves, strict=True) if f]
            (track, _), pull = jax.vjp(forward, floats, track, moved)
            return track, packed(pulls.opened(pull, values, leaves))

        def back(carry: Any, at: Any) -> Any:
            after, total = carry
            saved, leaves, cotangents = (one.opened() for one in at)
            pull = pulls.closed(saved, values, leaves)
            gained, before, of_given = pull((after, cotangents))
            return (before, jax.tree.map(jnp.add, total, gained)), packed(of_given)

        _, saved = lax.scan(step, start, given)
        return lax.scan(back, carry, (saved, given, cotangents), reverse=True)

    zero = jax.tree.map(lambda a: jnp.zeros(a.shape[1:], a.dtype), starts)
    carry = (zero, jax.tree.map(jnp.zeros_like, floats))
    pieces = (starts, _cut(packed(every, 1), segment), _cut(packed(cotangents, 1), segment))
    (first, total), of_given = lax.scan(stretch, carry, pieces, reverse=True)
    return total, first.belief, _joined(of_given, epochs).opened()


class _Pulls:
    """The pullback of an epoch as arrays that a scan can hand over, without those that both sides have."""

    def __init__(self) -> None:
        self._tree: Any = None
        self._places: list[tuple[int, int] | None] = []

    def opened(self, pull: Any, *shared: list[Array]) -> list[Array]:
        """The arrays that `pull` holds and none of the lists `shared` does."""
        places = {id(a): (i, k) for i, own in enumerate(shared) for k, a in enumerate(own)}
        leaves, self._tree = jax.tree.flatten(pull)
        self._places = [places.get(id(leaf)) for leaf in leaves]
        return [leaf for leaf, at in zip(leaves, self._places, strict=True) if at is None]

    def closed(self, saved: list[Array], *shared: list[Array]) -> Any:
        """The pullback, from what `opened` gave and the same lists."""
        own = iter(saved)
        leaves = [next(own) if at is None else shared[at[0]][at[1]] for at in self._places]
        return jax.tree.unflatten(self._tree, leaves)


# --- all runs -----------------------------------------------------------------------------------------


def filter_plainly(
    system: System, what: What, checkpoint: bool, prepared: Any, first: First, given: Given
) -> Kept:
    """The recursion with JAX's own derivatives, forward and reverse."""

    def runs(_: None, prepared: Any, first: First, given: Given) -> tuple[Kept, None]:
        epoch = partial(_epoch, system, what, False, prepared)
        if checkpoint:
            epoch = jax.checkpoint(epoch)
        return lax.scan(epoch, begin(system, *first), given)[1], None

    return in_blocks((), runs, None, prepared, first, given)[0]


def filter_with_adjoint(
    system: System,
    what: What,
    segment: int,
    devices: Devices,
    prepared: Any,
    first: First,
    given: Given,
) -> Kept:
    """The recursion with its reverse derivative by the adjoint; `segment` epochs between kept beliefs."""
    return _with_adjoint(system, what, segment, devices)(prepared, first, given)


@lru_cache(maxsize=64)
def _with_adjoint(
    system: System, what: What, segment: int, devices: Devices
) -> Callable[..., Kept]:
    def run(segment: int | None, _: None, *trees: Any) -> Any:
        def scan(_: None, *trees: Any) -> Any:
            return _scan(system, what, False, segment, *trees)

        kept, starts = in_blocks(devices, scan, None, *trees)
        if segment is None:
            return kept, None
        return kept, Blocks(starts, jnp.zeros(jax.tree.leaves(trees)[0].shape[0]))

    ahead = over_more_runs(devices, partial(run, None))
    ahead_saving = over_more_runs(devices, partial(run, segment))

    @jax.custom_vjp
    def function(prepared: Any, first: First, given: Given) -> Kept:
        return ahead(None, prepared, first, given)[0]

    def forward(prepared: Any, first: First, given: Given) -> Any:
        flags = _Flags(_perturbed(prepared), _perturbed(given))
        values = jax.tree.map(lambda leaf: leaf.value, (prepared, first, given))
        kept, starts = ahead_saving(None, *values)
        return kept, (values[0], starts, values[2], flags, first.refused is None)

    def backward(saved: Any, cotangents: Any) -> Any:
        prepared, starts, given, flags, at_rest = saved
        cotangents = _symmetric(cotangents)
        every = jax.tree.leaves(cotangents, is_leaf=lambda c: isinstance(c, SymbolicZero))
        live = tuple(
            not isinstance(c, SymbolicZero) and jnp.issubdtype(c.dtype, jnp.inexact) for c in every
        )
        chosen = [c for flag, c in zip(live, every, strict=True) if flag]
        back = _backward(system, what, segment, devices, flags, live)
        total, first, of_given = back(starts, prepared, given, chosen)[0]
        # When samples were refused decides what is let in, but nothing depends on it smoothly.
        refused = None if at_rest else jnp.zeros(first.cov.shape[0], first.cov.dtype)
        back_to_given = unfilled(given, flags.given, of_given)
        back_to_prepared = unfilled(prepared, flags.prepared, total)
        return back_to_prepared, First(first, refused), back_to_given

    function.defvjp(forward, backward, symbolic_zeros=True)
    return function


def _perturbed(tree: Any) -> tuple[bool, ...]:
    """Which leaves, of a `custom_vjp` with symbolic zeros, have a derivative."""
    return tuple(
        bool(leaf.perturbed) and jnp.issubdtype(leaf.value.dtype, jnp.inexact)
        for leaf in jax.tree.leaves(tree)
    )


@lru_cache(maxsize=256)
def _backward(
    system: System,
    what: What,
    segment: int,
    devices: Devices,
    flags: _Flags,
    live: tuple[bool, ...],
) -> Callable[..., Any]:
    def scan(starts: Track, *trees: Any) -> Any:
        asked = (flags.prepared, flags.given, live)
        return _scan_back(system, what, segment, *asked, starts, *trees), None

    def run(starts: Blocks, *trees: Any) -> Any:
        count, size = shape_of(jax.tree.leaves(trees)[0].shape[0], devices)

        def fitting(a: Array) -> Array:
            # `custom_vmap` traces this for one member of a `vmap` before it asks for all of them, and
            # the blocks hold all of them already: of that trace only the shapes are used.
            if (a.shape[0], a.shape[-1]) == (count, size):
                return a
            return jnp.zeros((count, *a.shape[1:-1], size), a.dtype)

        arrays = jax.tree.map(fitting, starts.arrays)
        return in_blocks(devices, scan, arrays, *trees)

    return over_more_runs(devices, run)


def _symmetric(cotangents: Kept) -> Kept:
    """The cotangents of the covariances kept, (runs, K, S, n, n), made symmetric."""

    def symmetric(cov: Any) -> Any:
        if cov is None or isinstance(cov, SymbolicZero):
            return cov
        return 0.5 * (cov + cov.swapaxes(-1, -2))

    prior = cotangents.prior
    if prior is not None:
        prior = prior._replace(cov=symmetric(prior.cov))
    return cotangents._replace(prior=prior, cov=symmetric(cotangents.cov))


def segment_length(epochs: int, substeps: int, bytes_per_belief: int) -> int:
    """Epochs between kept beliefs.

    What the derivatives of the epochs of a segment need, about `_BELIEFS_PER_STEP` beliefs a substep,
    should stay in the second cache; with very many epochs the beliefs kept should not fill the memory.
    """
    fitting = _CACHE_BYTES // (_BELIEFS_PER_STEP * substeps * bytes_per_belief)
    segment = min(max(fitting, 2), _LONGEST_SEGMENT)
    if epochs * bytes_per_belief > segment * _MEMORY_BYTES:
        segment = max(segment, math.isqrt(epochs))
    return segment
