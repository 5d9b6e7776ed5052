"""Reset of a belief that no sample agrees with, on the batch axis.

Gates and weights assume that the belief is right and a sample may be wrong. If all samples of some
sensors are outside their chi-square bounds for `Model.gate_reset_after_s`, the belief is taken to be
wrong: process noise is added to it at once, and the sample is used with full weight. The noise opens the
states that these sensors observe. The other states, such as biases, get no more than the variance of the
start behind a gate, and more where wrong samples may have moved them.
"""

import operator
from collections.abc import Mapping
from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxekf.filtering.lowering.structured_matrix import Pattern

_GROWTH = 99.0
"""Variance that a reset adds to states that the sensors do not observe, as a multiple of theirs, if the
gates have kept wrong samples from moving them: ten times the deviation."""

_MOST = 1e4
"""Largest variance that a reset adds without a gate, as a multiple of that at the start."""
_FEWEST = 6
"""Samples in a row before a reset, at least, from a slow sensor."""


class ResetGroup(NamedTuple):
    """Sensors that observe common states, and so confirm or contradict the same part of the belief."""

    sensors: tuple[str, ...]
    observed: tuple[bool, ...]
    """For each entry of the error vector, whether one of the sensors observes it."""
    is_gated: bool
    """Whether all of these sensors have a gate."""


class ResetTally(NamedTuple):
    """Summary of the samples of a group at one instant, each (lanes,)."""

    accepted: Array
    """Whether any sample is within its bound."""
    rejected: Array
    rejected_s: Array
    """The longest sampling period of the samples outside their bounds."""
    excess: Array
    """The largest ratio of squared error to expected squared error among groups of rows outside their
    bounds; for repeated groups their geometric mean, in which a few that are far off count little."""


class Resets(NamedTuple):
    """The resets of all groups at one instant."""

    rejecting_s: Array
    """(groups, lanes) as in `FilterCarry`, after this instant."""
    recovered: dict[str, Array]
    """By sensor: (lanes,) where its group is reset."""
    added_cov: Array
    """(n, n, lanes) process noise of the resets, without derivatives; zero where there is none."""

    @property
    def anywhere(self) -> Array:
        """(lanes,) where any group is reset."""
        nowhere = jnp.zeros(self.rejecting_s.shape[-1], bool)
        return reduce(operator.or_, self.recovered.values(), nowhere)


def find_groups(
    patterns: Mapping[str, Pattern], gated: Mapping[str, bool]
) -> tuple[ResetGroup, ...]:
    """The groups of a model's sensors, from the sparsity of their Jacobians."""
    found: list[tuple[list[str], np.ndarray]] = []
    for name, pattern in patterns.items():
        observed = (pattern.base != 0.0).any(axis=0)
        for _, cols in pattern.bands:
            observed[list(cols)] = True
        joined, others = [name], []
        for names, states in found:
            if (states & observed).any():
                joined, observed = names + joined, states | observed
            else:
                others.append((names, states))
        found = [*others, (joined, observed)]
    return tuple(
        ResetGroup(tuple(names), tuple(states.tolist()), all(gated[name] for name in names))
        for names, states in found
    )


def reset(
    groups: tuple[ResetGroup, ...],
    tallies: Mapping[str, ResetTally],
    rejecting_s: Array,
    after_s: float,
    prior_cov: Array,
    initial_variance: Array,
) -> Resets:
    """The counters of all groups after an instant, and the resets.

    Parameters
    ----------
    groups
        The model's groups.
    tallies
        By sensor, for those sampled at this instant.
    rejecting_s
        (groups, lanes) seconds, as in `FilterCarry`.
    after_s
        `Model.gate_reset_after_s`.
    prior_cov
        Predicted covariance, (n, n, lanes).
    initial_variance
        (n, lanes) variances at the start of a run.
    """
    counters, recovered = [], {}
    added = jnp.zeros_like(prior_cov)
    # Without derivatives: the noise follows the innovation, hardly the covariance.
    prior_cov, initial = lax.stop_gradient(prior_cov), initial_variance[:, None]
    for counter, group in zip(rejecting_s, groups, strict=True):
        sampled = [tallies[name] for name in group.sensors if name in tallies]
        if not sampled:
            counters.append(counter)
            continue
        tally = sampled[0]
        for other in sampled[1:]:
            tally = ResetTally(
                tally.accepted | other.accepted,
                tally.rejected | other.rejected,
                jnp.maximum(tally.rejected_s, other.rejected_s),
                jnp.maximum(tally.excess, other.excess),
            )
        # Earlier samples must have filled the time: a few are outside by chance, whatever their period.
        enough = counter > jnp.maximum(after_s, _FEWEST * tally.rejected_s)
        here = tally.rejected & ~tally.accepted & enough
        cleared = here | tally.accepted
        counters.append(jnp.where(cleared, 0.0, counter + tally.rejected_s))
        recovered |= {name: here for name in group.sensors if name in tallies}
        # Gates have kept wrong samples from moving the other states; without, all have moved them.
        grown, excess = _GROWTH * prior_cov, tally.excess[None, None]
        most = initial if group.is_gated else _MOST * initial
        allowed = jnp.minimum(grown if group.is_gated else grown * excess, most)
        inside = np.array(group.observed)
        both = np.outer(inside, inside)[..., None]
        opened = jnp.where(both, prior_cov * (excess - 1.0), 0.0)
        outside = np.diag(~inside)[..., None]
        noise = jnp.where(outside, allowed, opened)
        added = added + jnp.where(here[None, None], noise, 0.0)
    return Resets(jnp.stack(counters), recovered, added)
