"""The end of a search: no number stays where a larger step would gain, and undetermined ones go back.

After the search has converged, `settle` tries long steps up of each deviation (the likelihood is flat where
one is far too small beside the others) and a step scaled by the curvature. A number that the Fisher
information leaves open goes back to its start only if that costs less than `REVERTING_COSTS`, the others
following; its interval then comes from the objective itself, since the curvature at one point does not
describe a flat side.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from jaxekf.filtering.model import Parameters
from jaxekf.recordings.types import Flags, Floats
from tuning.objective.fisher_information import Information, information
from tuning.parametrisation.free_vector import scaled
from tuning.results.tuned import Limits, Progress
from tuning.search.descent import Descent

REVERTING_COSTS = 2.0
"""Log-likelihood that going back to the start may cost for one number."""
_WORTH = 0.1
"""Log-likelihood that is worth another step."""
_LEAPS = (10.0, 100.0, 1000.0)
"""Factors by which a deviation is tried larger."""
_LEAP_GAIN = 2.0
_MOST_JUMPS = 8
_LOSS_95 = 1.92
"""Log-likelihood below its maximum at the end of a 95 % interval."""
_NEARER_COSTS = 0.1
"""Log-likelihood that bringing a kept number nearer to its start may cost."""
_REACH = 4.0
"""Prior deviations to which a limit is looked for."""

Scaling = Callable[[Parameters], float] | None
"""Common scale of all covariances at some parameters; None for an objective that knows it."""


def settle(
    search: Descent,
    patience: int,
    confidence_intervals: bool,
    progress: Progress | None,
    scaling: Scaling = None,
) -> tuple[Information | None, Limits, str]:
    """Search to the end; return the information there, limits from the objective, and the ending."""
    while True:
        stopped = search.run(patience, progress)
        search.judge_trial(_bound)
        if "interrupted" in stopped:
            known = _information(search, scaling) if confidence_intervals else None
            return known, {}, stopped
        going = "iterations asked for" not in stopped
        if going and search.trial is None and _leap(search):
            continue
        if not confidence_intervals:
            return None, {}, stopped
        known = _information(search, scaling)
        if going and _scored(search, known):
            continue
        fixed, last = _revertible(search, known)
        if (fixed == search.fixed).all():
            if _brought_nearer(search, known):
                known = _information(search, scaling)
            return known, _limits(search, known), stopped
        search.try_fixing(fixed, last)


def _information(search: Descent, scaling: Scaling) -> Information:
    """Information at the best, with all covariances in the scale that the result will have."""
    assert search.best is not None
    free, base, where = search.best.free, search.base, search.layout
    search.filterings += search.information_cost
    if scaling is None:
        return information(search.model, where, free, base, search.training)
    params = where.from_free(free, base)
    factor = scaling(params)
    search.filterings += 1
    scaled_free = np.asarray(where.to_free(scaled(params, factor, base)))
    found = information(
        search.model, where, scaled_free, scaled(base, factor, base), search.training
    )
    return replace(found, free=np.asarray(free))


def _bound(count: int) -> float:
    """Log-likelihood that `count` numbers that the data do not determine may cost together: each gains a
    half on average by chance."""
    return REVERTING_COSTS if count <= 1 else 0.5 * float(chi2.ppf(chi2.cdf(4.0, 1), count))


def _leap(search: Descent) -> bool:
    """Begin again where a much larger deviation is more likely; return whether there is such a point."""
    best = search.best
    assert best is not None
    if not search.objective.likelihood or search.jumps >= _MOST_JUMPS:
        return False
    unit, lowest, found = search.evidence, best.step.training, None
    least = lowest - _LEAP_GAIN * unit
    where = search.layout
    for i in np.flatnonzero(where.is_logarithm & ~where.is_own & ~search.fixed):
        for factor in _LEAPS:
            point = np.array(best.free)
            point[i] += np.log(factor)
            value = search.probe(point)
            if value < min(least, lowest):
                lowest, found = value, point
            if not value < best.step.training + REVERTING_COSTS * unit:
                break
    if found is not None:
        search.jump(found)
    return found is not None


def _scored(search: Descent, known: Information) -> bool:
    """Go on from a step scaled by the curvature if it gains; return whether it does."""
    best, objective = search.best, search.objective
    assert best is not None
    alone = objective.likelihood and not objective.errors and not objective.truth
    if not alone or search.validation is not None or search.jumps >= _MOST_JUMPS:
        return False
    prior = np.asarray(search.layout.prior) ** -2.0
    slope = objective.likelihood * known.score
    slope = slope - objective.prior * prior * (best.free - search.start)
    curved = objective.likelihood * known.matrix + np.diag((objective.prior + 1e-3) * prior)
    moving, step = np.flatnonzero(~search.fixed), np.zeros(len(slope))
    if not moving.size:
        return False
    step[moving] = np.linalg.solve(curved[np.ix_(moving, moving)], slope[moving])
    gain = _WORTH * objective.likelihood
    if 0.5 * float(step @ slope) < gain:
        return False
    point = best.free + step * min(1.0, 1.0 / float(np.max(np.abs(step))))
    if not search.probe(point) < best.step.training - _WORTH * search.evidence:
        return False
    search.jump(point)
    return True


def _revertible(search: Descent, known: Information) -> tuple[Flags, int]:
    """Numbers to fix at their start, and the last of these; others that are open are marked as kept.

    They are tried one after the other, the least known first: if only the sum of two is known, one is
    enough.
    """
    assert search.best is not None
    fixed, last, value = search.fixed.copy(), -1, search.best.step.training
    while (number := known.least_known(fixed | search.kept, search.kept)) is not None:
        trial = fixed.copy()
        trial[number] = True
        back = search.start[trial] - search.best.free[trial]
        loss = _least(search, known, trial, back)[0]
        count = int(trial.sum() - search.fixed.sum())
        if loss - value <= _bound(count) * search.evidence:
            fixed, last = trial, number
        else:
            search.kept[number] = True
    return fixed, last


def _brought_nearer(search: Descent, known: Information) -> bool:
    """Bring kept numbers that ended in a flat region as near to their start as the data allow; return
    whether any moved. A deviation that tends to zero would else end at any small value."""
    moved = False
    for i in np.flatnonzero(known.wide(search.fixed) & search.kept & ~search.layout.is_own):
        best = search.best
        assert best is not None
        chosen = np.arange(len(search.start)) == i
        way = float(search.start[i] - best.free[i])
        side, prior = np.sign(way), search.layout.prior[i]
        loss = _loss_along(search, known, i)
        near = _reach(loss, side, prior, _NEARER_COSTS, abs(way))[0]
        if near > 0.0:
            value, point = _least(search, known, chosen, np.array([side * near]))
            search.best = best._replace(free=point, step=best.step._replace(training=value))
            moved = True
    return moved


def _loss_along(search: Descent, known: Information, number: Any) -> Callable[[float], float]:
    """Loss of log-likelihood by a change of one number, the others following."""
    assert search.best is not None
    chosen = np.arange(len(search.start)) == number
    low = search.best.step.training - search.prior(search.best.free)[0]

    def loss(change: float) -> float:
        value = _least(search, known, chosen, np.array([change]), likelihood=True)[0]
        return (value - low) / search.evidence

    return loss


def _least(
    search: Descent, known: Information, chosen: Flags, change: Floats, likelihood: bool = False
) -> tuple[float, Floats]:
    """Objective with some numbers changed, and the point: the lower one of others staying, and others
    following by the curvature. With `likelihood` without its prior."""
    assert search.best is not None
    point = np.array(search.best.free)
    point[chosen] += change
    others = ~chosen & ~search.fixed
    points = [point]
    if others.any():
        precision = known.matrix + np.diag(
            (search.objective.prior + 1e-2) * np.asarray(search.layout.prior) ** -2.0
        )
        pull = precision[np.ix_(others, chosen)] @ change
        follow = -np.linalg.solve(precision[np.ix_(others, others)], pull)
        if np.max(np.abs(follow)) > 1e-3:
            moved = point.copy()
            moved[others] += follow
            points.append(moved)
    values = [search.probe(p) - (search.prior(p)[0] if likelihood else 0.0) for p in points]
    values = [value if np.isfinite(value) else np.inf for value in values]
    at = int(np.argmin(values))
    return values[at], points[at]


def _limits(search: Descent, known: Information) -> Limits:
    """Ends of 95 % intervals, as changes of the free number, for those that are known to one side at most.

    An end that the data do not give is infinite; a number that is flat to both sides has no entry.
    """
    assert search.best is not None
    prior, found = np.asarray(search.layout.prior), {}
    wide = known.wide(search.fixed) | search.fixed
    for i in np.flatnonzero(wide & ~search.layout.is_truth & ~search.layout.is_own):
        loss = _loss_along(search, known, i)
        if all(loss(side * prior[i]) < _LOSS_95 for side in (-1.0, 1.0)):
            continue
        ends = [_reach(loss, side, prior[i], _LOSS_95, _REACH * prior[i]) for side in (-1.0, 1.0)]
        found[int(i)] = (ends[0][1], ends[1][1])
    return found


def _reach(
    loss: Callable[[float], float], side: float, prior: float, level: float, most: float
) -> tuple[float, float]:
    """Distances on one side just before and just after the loss reaches a level; `most` and infinity if it
    does not up to there."""
    near, far = 0.0, min(0.25 * prior, most)
    while loss(side * far) < level:
        if far >= most:
            return most, np.inf
        near, far = far, min(2.0 * far, most)
    for _ in range(3):
        middle = 0.5 * (near + far)
        near, far = (middle, far) if loss(side * middle) < level else (near, middle)
    return near, far
