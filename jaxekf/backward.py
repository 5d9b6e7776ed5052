"""The smoother's pass back through a block of runs, on lanes.

Modified Bryson-Frazier form: what the samples after an instant say is carried back as information on
the error there, so that no predicted covariance is inverted and nothing is asked of the process noise.
With the belief (x, P) of the filter and the information (a, L) of what came later,

    x_smoothed = retract(x, P a),    P_smoothed = P - P L P,

the latter counted from the smoothed mean. For a linear system both are those of Rauch, Tung, Striebel.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf import algebra, epochs, linalg, many, patterned
from jaxekf.algebra import Gained, Rows, Solved
from jaxekf.kernels import loop
from jaxekf.lanes import written_sum
from jaxekf.model import Belief
from jaxekf.patterned import Pattern
from jaxekf.recursion import First, Given
from jaxekf.step import Moment, Track, any_used, begin, blocks_of_rows, look, take_keeping
from jaxekf.system import System


class Information(NamedTuple):
    """What later samples say of the error at an instant: ``a`` (n, lanes) and ``L`` (n, n, lanes)."""

    vector: Array
    matrix: Array


class Filtered(NamedTuple):
    """What the pass needs of the filter; leading axes (K, S)."""

    prior: Belief
    updated: Belief
    refused: Array | None


class _Instant(NamedTuple):
    """One substep."""

    moment: Moment
    before: Any
    """Mean at the end of the substep before."""
    refused: Array | None
    """Seconds of refused samples at the end of the substep before."""
    filtered: Filtered


def scan_back(
    system: System, adjoint: bool, prepared: Any, first: First, given: Given, filtered: Filtered
) -> tuple[Belief, Belief]:
    """The smoothed beliefs at every substep, leading axes (K, S), and at the start."""
    size, lanes = first.belief.cov.shape[1:]
    dtype = first.belief.cov.dtype
    nothing = Information(jnp.zeros((size, lanes), dtype), jnp.zeros((size, size, lanes), dtype))
    start = begin(system, *first)
    before = jax.tree.map(one_earlier, start.belief.mean, filtered.updated.mean)
    refused = None
    if start.refused is not None and filtered.refused is not None:
        refused = one_earlier(start.refused, filtered.refused)
    epoch = partial(_epoch, system, adjoint, prepared)
    every = _Instant(given.moments, before, refused, filtered)
    info, found = lax.scan(epoch, nothing, (every, given.fast, given.slow), reverse=True)
    return found, smoothed(system, prepared, first.belief, info, adjoint=adjoint)


def one_earlier(first: Array, every: Array) -> Array:
    """The values (K, S, ...) at the end of each substep before: `first` is that of the start."""
    flat = every.reshape(-1, *every.shape[2:])
    return jnp.concatenate([first[None], flat[:-1]]).reshape(every.shape)


def _epoch(
    system: System, adjoint: bool, prepared: Any, info: Information, at: Any
) -> tuple[Information, Belief]:
    """All substeps of one epoch, the last first; slow sensors were taken at the last."""
    every, fast, slow = at

    def substep(info: Information, at: Any) -> tuple[Information, Belief]:
        instant, samples = at
        belief = smoothed(system, prepared, instant.filtered.updated, info, adjoint=adjoint)
        info = _before_update(system, prepared, info, instant, samples, adjoint)
        return _before_prediction(system, prepared, info, instant, adjoint), belief

    return epochs.over_substeps_back(substep, info, (every, fast), slow)


def lessened(p: Array, matrix: Array) -> Array:
    """``P - P L P``."""
    lost = loop(algebra.product, p, loop(algebra.product, matrix, p))
    return loop(lambda p, lost: linalg.symmetrise(p - lost), p, lost)


def smoothed(
    system: System, prepared: Any, belief: Belief, info: Information, *, adjoint: bool
) -> Belief:
    """The belief of the filter with what came later."""
    p = belief.cov
    delta = loop(algebra.apply, p, info.vector)
    cov = lessened(p, info.matrix)
    correction = system.correction
    always = jnp.ones(p.shape[-1], bool)
    mean, reset, _ = correction.piece(
        prepared["correction"], belief.mean, delta, always, adjoint=adjoint
    )
    if not correction.reset.is_identity:
        cov = algebra.congruence(correction.reset, reset, cov)[0]
    return Belief(mean, cov)


def _before_prediction(
    system: System, prepared: Any, info: Information, instant: _Instant, adjoint: bool
) -> Information:
    """From the end of a prediction to its start: ``F' a`` and ``F' L F``."""
    transition, moment = system.transition, instant.moment
    found = transition.piece(
        prepared["transition"], instant.before, moment.u, moment.dt, adjoint=adjoint
    )
    return carried(transition.state, found[1], info)


def carried(p: Pattern, block: Array | None, info: Information) -> Information:
    """``M' a`` and ``M' L M``."""
    back, turned = p.transposed, patterned.transpose(block)
    vector = loop(partial(patterned.multiply, back), turned, info.vector)
    return Information(vector, algebra.congruence(back, turned, info.matrix)[0])


def _before_update(
    system: System,
    prepared: Any,
    info: Information,
    instant: _Instant,
    samples: dict[str, Any],
    adjoint: bool,
) -> Information:
    """From after the samples of an instant to before them; they are taken again to see their gain."""
    if not samples:
        return info
    prior = instant.filtered.prior
    ahead = Track(prior, instant.refused)
    judged, cov = look(system, prepared, ahead, instant.moment.u, samples, adjoint=adjoint)
    linear = judged.linear
    gained = Gained(cov, jnp.zeros_like(cov[0]), jnp.zeros_like(cov[0, 0]))
    taken = []
    for slope, rows in blocks_of_rows(system.measurements, linear):
        gained, solved = take_keeping(slope, gained, rows)
        taken.append((slope, rows, solved))
    correction = system.correction
    used = any_used(linear)
    _, reset, shift = correction.piece(
        prepared["correction"], prior.mean, gained.delta, used, adjoint=adjoint
    )
    if shift is not None:
        # The model's constraint moved the mean: what is known is counted from where it had been.
        vector = info.vector + loop(algebra.apply, info.matrix, shift)
        info = info._replace(vector=vector)
    if not correction.reset.is_identity:
        info = carried(correction.reset, reset, info)
    for slope, rows, solved in reversed(taken):
        info = before_rows(slope, rows, solved, info)
    return info


def before_rows(p: Pattern, rows: Rows, found: Solved, info: Information) -> Information:
    """``A' a + H' inv(S) e`` and ``A' L A + H' inv(S) H`` with ``A = I - K H``, of rows that
    `step.take_keeping` took."""
    if many.are_many(rows.mask):

        def one(info: Information, at: Any) -> tuple[Information, None]:
            rows, found = at
            return before_rows(p, rows, found, info), None

        return lax.scan(one, info, (rows, found), reverse=True)[0]
    size, back, turned = p.shape[1], p.transposed, patterned.transpose(rows.slope)
    gain = [row[:size] for row in found.solved]
    seen = [row[size] for row in found.solved]
    inverse = [row[size + 1 :] for row in found.solved]

    def push_of(gain: list[Array], seen: list[Array], vector: Array, mask: Array) -> Array:
        """``inv(S) e - K' a``, (rows, lanes)."""
        pushed = [
            s - written_sum([g[k] * vector[k] for k in range(size)])
            for g, s in zip(gain, seen, strict=True)
        ]
        return jnp.where(mask, jnp.stack(pushed), 0.0)

    push = loop(push_of, gain, seen, info.vector, rows.mask)
    vector = info.vector + loop(partial(patterned.multiply, back), turned, push)

    def half_of(gain: Array, matrix: Array) -> Array:
        """A row of ``K' L``."""
        return written_sum([gain[k][None] * matrix[k] for k in range(size)])

    half = loop(jnp.stack, [loop(half_of, g, info.matrix) for g in gain])

    def inner_of(half: Array, gain: list[Array], inverse: list[Array], mask: Array) -> Array:
        """``K' L K + inv(S)`` of the rows that count."""
        known = jnp.where(mask[:, None] & mask[None], jnp.stack(inverse), 0.0)
        return algebra.product_transposed(half, jnp.stack(gain)) + known

    inner = loop(inner_of, half, gain, inverse, rows.mask)

    # With T = K' L - (K' L K + inv(S)) H / 2 the whole is L - H' T - T' H.
    def spread_of(slope: Array | None, inner: Array, half: Array) -> Array:
        drawn = patterned.multiply(back, patterned.transpose(slope), inner, axis=1)
        return half - 0.5 * drawn

    spread = loop(spread_of, rows.slope, inner, half)
    whole = loop(partial(patterned.multiply, back), turned, spread)
    matrix = loop(lambda m, w: m - w - w.swapaxes(0, 1), info.matrix, whole)
    return Information(vector, matrix)
