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

from jaxekf.filtering import _covariance_algebra as covariance_algebra
from jaxekf.filtering import _repeated_groups as repeated_groups
from jaxekf.filtering import _substeps as substeps
from jaxekf.filtering._covariance_algebra import Gained
from jaxekf.filtering._lowered_model import System
from jaxekf.filtering._recursion import First, Given
from jaxekf.filtering._step import Moment, Track, any_used, begin, look, take_keeping
from jaxekf.filtering.lowering import structured_matrix
from jaxekf.filtering.lowering.lanes import stage
from jaxekf.filtering.lowering.structured_matrix import Bands, Pattern
from jaxekf.filtering.model import Belief
from jaxekf.geometry import linalg


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

    return substeps.over_substeps_back(substep, info, (every, fast), slow)


def lessened(p: Array, matrix: Array) -> Array:
    """``P - P L P``."""
    lost = stage(covariance_algebra.product(p, stage(covariance_algebra.product(matrix, p))))
    return stage(linalg.symmetrise(p - lost))


def smoothed(
    system: System, prepared: Any, belief: Belief, info: Information, *, adjoint: bool
) -> Belief:
    """The belief of the filter with what came later."""
    p = belief.cov
    delta = stage(covariance_algebra.apply(p, info.vector))
    cov = lessened(p, info.matrix)
    correction = system.correction
    always = jnp.ones(p.shape[-1], bool)
    mean, reset, _ = correction.piece(
        prepared["correction"], belief.mean, delta, always, adjoint=adjoint
    )
    if not correction.reset.is_identity:
        cov = linalg.symmetrise(covariance_algebra.congruence(correction.reset, reset, cov))
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


def carried(p: Pattern, bands: Bands, info: Information) -> Information:
    """``M' a`` and ``M' L M``."""
    back, turned = p.transposed, structured_matrix.transpose(bands)
    vector = stage(structured_matrix.multiply(back, turned, info.vector))
    return Information(
        vector, linalg.symmetrise(covariance_algebra.congruence(back, turned, info.matrix))
    )


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
    for one in linear.values():
        gained, kept = take_keeping(one.slope, gained, one.rows)
        taken.append((covariance_algebra.pattern_taken(one.slope, one.rows), kept))
    correction = system.correction
    used = any_used(linear)
    _, reset, shift = correction.piece(
        prepared["correction"], prior.mean, gained.delta, used, adjoint=adjoint
    )
    if shift is not None:
        # The model's constraint moved the mean: what is known is counted from where it had been.
        vector = info.vector + stage(covariance_algebra.apply(info.matrix, shift))
        info = info._replace(vector=vector)
    if not correction.reset.is_identity:
        info = carried(correction.reset, reset, info)
    for slope, kept in reversed(taken):
        info = before_rows(slope, kept, info)
    return info


def before_rows(p: Pattern, kept: Any, info: Information) -> Information:
    """``A' a + H' s`` and ``A' L A + H' S^-1 H`` with ``A = I - K H``, of rows that `step.take_keeping`
    took."""
    rows, taken = kept
    if repeated_groups.are_many(rows.mask):

        def one(info: Information, kept: Any) -> tuple[Information, None]:
            return before_rows(p, kept, info), None

        return lax.scan(one, info, kept, reverse=True)[0]
    vector, matrix = info
    for block, (gain, inverse, scaled) in reversed(
        list(zip(covariance_algebra.blocks(p, rows), taken, strict=True))
    ):
        matrix, _ = covariance_algebra.back_through(block, gain, matrix, inverse, None)
        push = stage(block.shown(scaled - covariance_algebra.apply(gain, vector)))
        vector = stage(vector + block.back(push))
    return Information(vector, matrix)
