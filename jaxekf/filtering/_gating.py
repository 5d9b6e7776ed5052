"""What is done with samples that do not fit: chi-square gates, and weights for heavy tails, on lanes."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxekf._support import chi_square
from jaxekf.filtering import _covariance_algebra as covariance_algebra
from jaxekf.filtering import _repeated_groups as repeated_groups
from jaxekf.filtering._lowered_model import System
from jaxekf.filtering.lowering.lanes import written_sum
from jaxekf.filtering.lowering.structured_matrix import Pattern
from jaxekf.filtering.model import Sensor
from jaxekf.filtering.steps import Rows
from jaxekf.geometry import linalg

_HUBER = 0.95
"""Share of honest samples that Huber's weight leaves alone."""
_REACH = 7.0
"""Of the belief that is widened: points are let in whose squared error is so many times larger than that of
all in the mean, which of honest ones one in a thousand is."""
_STUDENT = 4.0
"""Degrees of freedom of Student's law: its tails are heavy, its variance is finite."""


class Linear(NamedTuple):
    """One sensor linearised: rows, and the pattern of their slope."""

    slope: Pattern
    rows: covariance_algebra.Rows


class Judged(NamedTuple):
    """What gates and weights make of the samples of one instant."""

    linear: dict[str, Linear]
    """What is left: refused rows hidden, noise of what counts less made larger."""
    gated: dict[str, Array]
    """By sensor: (rows, lanes) visible rows that were refused."""
    refused: Array | None
    """(lanes,) as in `Track`; None without gates, as the others."""
    recovered: Array | None
    widened: Array | None
    """(lanes,) what the predicted covariance is multiplied by."""


class _Group(NamedTuple):
    """Rows that are judged together, and their squared distance from what is predicted."""

    members: tuple[int, ...]
    visible: Array
    distance: Array


class _Distance(NamedTuple):
    """The same of each of many like groups, (groups, lanes)."""

    visible: Array
    distance: Array


def judge(
    system: System,
    seen: dict[str, Linear],
    samples: dict[str, Rows],
    prior: Array,
    refused: Array | None,
) -> Judged:
    """Rows that are kept out or count less, and the way back for a belief that keeps everything out.

    Where gates have let nothing in while they refused samples for longer than the model's patience, it
    is the belief that is wrong: the gates open once, and the covariance is multiplied by how many
    times larger than expected the squared errors are. All samples then count in full.
    """
    sensors = {name: system.measurements[name].sensor for name in seen}
    groups = {
        name: _groups(sensors[name], linear, prior)
        for name, linear in seen.items()
        if sensors[name].gate is not None or sensors[name].weighting is not None
    }
    gated, after, recovered, widened = _gates(system, seen, samples, prior, refused, groups)
    linear = {name: _without(one, gated[name]) for name, one in seen.items()}
    for name in groups:
        if sensors[name].weighting is None:
            continue
        larger = _lessening(sensors[name], groups[name], linear[name].rows.mask.shape[-2])
        if recovered is not None:
            larger = jnp.where(recovered, 1.0, larger)
        linear[name] = _weighted(linear[name], larger)
    return Judged(linear, gated, after, recovered, widened)


def weights(sensor: Sensor, residual: Array, cov: Array, mask: Array) -> Array | None:
    """How much each row of a sample counts, (rows,): what the filter divided its noise by; None for a
    sensor without weighting. `cov` is the innovation's, hidden rows as in the identity."""
    if sensor.weighting is None:
        return None
    groups = _distances(sensor, jnp.where(mask, residual, 0.0), cov, mask)
    return 1.0 / lessening(sensor, groups, residual.shape[0])


def lessening(sensor: Sensor, groups: list[_Group], rows: int) -> Array:
    """What the noise of each row is multiplied by, (rows, ...), at least 1.

    With the squared distance d2 of a group of m visible rows: ``sqrt(d2 / c)`` beyond the quantile c of
    chi-square (Huber), ``(v + d2) / (v + m)`` (Student, v degrees of freedom).
    """
    found: list[Any] = [None] * rows
    for members, visible, distance in groups:
        if sensor.weighting == "student":
            larger = jnp.maximum((_STUDENT + distance) / (_STUDENT + visible), 1.0)
        else:
            bound = _bound(_HUBER, members, visible, distance)
            larger = jnp.sqrt(jnp.maximum(distance / bound, 1.0))
        for row in members:
            found[row] = larger
    return jnp.stack(found)


def _lessening(sensor: Sensor, groups: Any, rows: int) -> Array:
    if not isinstance(groups, _Distance):
        return lessening(sensor, groups, rows)
    one = _alone(sensor)
    return jax.vmap(lambda each: lessening(one, [_Group(tuple(range(rows)), *each)], rows))(groups)


def _alone(sensor: Sensor) -> Sensor:
    """One of the like groups of a sensor."""
    assert sensor.alike is not None
    return sensor.alike


def _bound(share: Any, members: tuple[int, ...], visible: Array, like: Array) -> Array:
    """Which a `share` of honest squared distances of as many visible rows does not exceed; where none is
    visible, that of one."""
    bounds = chi_square.ppf(share, np.arange(1, len(members) + 1))
    found = jnp.full_like(like, bounds[0])
    for count in range(2, len(bounds) + 1):
        found = jnp.where(visible == count, bounds[count - 1], found)
    return found


def _weighted(linear: Linear, larger: Array) -> Linear:
    if repeated_groups.are_many(linear.rows.mask):
        noise = jax.vmap(_enlarged)(linear.rows.noise, larger)
    else:
        noise = _enlarged(linear.rows.noise, larger)
    return linear._replace(rows=linear.rows._replace(noise=noise))


def _enlarged(noise: Array, larger: Array) -> Array:
    if noise.ndim == larger.ndim:
        return noise * larger
    root = jnp.sqrt(larger)
    return noise * root[:, None] * root[None]


def _without(linear: Linear, gated: Array) -> Linear:
    return linear._replace(rows=linear.rows._replace(mask=linear.rows.mask & ~gated))


def _gates(
    system: System,
    seen: dict[str, Linear],
    samples: dict[str, Rows],
    prior: Array,
    refused: Array | None,
    groups: dict[str, Any],
) -> tuple[dict[str, Array], Array | None, Array | None, Array | None]:
    """Rows refused, seconds of refusing, where the gates were opened, and by how much to widen."""
    gated = {name: jnp.zeros_like(one.rows.mask) for name, one in seen.items()}
    watched = [n for n in seen if system.measurements[n].sensor.gate is not None]
    none = jnp.zeros(prior.shape[-1], bool)
    if refused is None:
        return gated, None, None, None
    if not watched:
        return gated, refused, none, None
    ratios = {}
    tally = _Tally(none, none, jnp.zeros_like(refused), jnp.ones_like(refused))
    for name in watched:
        given = (seen[name].rows.mask, groups[name], samples[name].dt)
        tally, gated[name], ratios[name] = _counted(system.measurements[name].sensor, tally, *given)
    let_in, kept_out, refused_s, excess = tally
    after = jnp.where(let_in, 0.0, refused + refused_s)
    # Earlier samples must have used up the patience: a single one is refused whatever its period.
    recovered = kept_out & ~let_in & (refused > system.model.patience_s)
    for n in watched:
        known = ratios[n] < jnp.inf
        if isinstance(groups[n], _Distance):
            # Most points of an image are honest and the others far off, also from a belief so widened.
            known &= ratios[n] <= _REACH * jnp.broadcast_to(excess, known.shape)
        gated[n] &= ~(known & jnp.broadcast_to(recovered, known.shape))
    widened = lax.stop_gradient(jnp.where(recovered, excess, 1.0))
    return gated, jnp.where(recovered, 0.0, after), recovered, widened


class _Tally(NamedTuple):
    """What the gates did at one instant, each (lanes,)."""

    let_in: Array
    kept_out: Array
    refused_s: Array
    """The longest sampling period of what was refused."""
    excess: Array
    """How many times larger than expected the squared error of it is at most; of many like groups in the
    geometric mean, in which a few that are far off count little."""


def _counted(
    sensor: Sensor, tally: _Tally, mask: Array, groups: Any, dt: Array
) -> tuple[_Tally, Array, Array]:
    """The tally with one more sensor, its rows that were refused, and for each row how many times larger
    than expected its group's squared error is."""
    if isinstance(groups, _Distance):
        return _counted_many(_alone(sensor), tally, mask, groups, dt)
    let_in, kept_out, refused_s, excess = tally
    gated, ratio = _gate(sensor, mask, groups)
    finite = gated & (jnp.stack(ratio) < jnp.inf)
    for row in range(mask.shape[0]):
        let_in = let_in | (mask[row] & ~gated[row])
        kept_out = kept_out | finite[row]
        excess = jnp.where(finite[row], jnp.maximum(excess, ratio[row]), excess)
        refused_s = jnp.where(finite[row], jnp.maximum(refused_s, dt), refused_s)
    return _Tally(let_in, kept_out, refused_s, excess), gated, jnp.stack(ratio)


def _counted_many(
    sensor: Sensor, tally: _Tally, mask: Array, groups: _Distance, dt: Array
) -> tuple[_Tally, Array, Array]:
    """The same with a sensor of many like groups, `sensor` being one of them.

    It has let something in where it let in most of what it saw: by chance a few points always fit.
    """
    rows = tuple(range(mask.shape[1]))
    zero = jnp.zeros_like(dt)

    def one(carry: tuple[Array, Array, Array, Array], at: Any) -> tuple[Any, Any]:
        balance, kept_out, number, logs = carry
        mask, each = at
        gated, ratio = _gate(sensor, mask, [_Group(rows, *each)])
        refused, seen = gated[0], mask[0]
        for row in rows[1:]:
            refused, seen = refused | gated[row], seen | mask[row]
        known = refused & (ratio[0] < jnp.inf)
        balance = balance + jnp.where(refused, -1.0, jnp.where(seen, 1.0, 0.0))
        log = jnp.log(jnp.where(known, jnp.maximum(ratio[0], 1.0), 1.0))
        carry = (balance, kept_out | known, number + known.astype(dt.dtype), logs + log)
        return carry, (gated, jnp.stack(ratio))

    begin = (zero, jnp.zeros(dt.shape, bool), zero, zero)
    (balance, refused, number, logs), (gated, ratio) = lax.scan(one, begin, (mask, groups))
    larger = jnp.maximum(tally.excess, jnp.exp(logs / jnp.maximum(number, 1.0)))
    return (
        _Tally(
            tally.let_in | (balance > 0.0),
            tally.kept_out | refused,
            jnp.where(refused, jnp.maximum(tally.refused_s, dt), tally.refused_s),
            jnp.where(refused, larger, tally.excess),
        ),
        gated,
        lax.stop_gradient(ratio),
    )


def _groups(sensor: Sensor, linear: Linear, prior: Array) -> Any:
    """Distances of the groups of a sensor: `_Group` of each, or `_Distance` of many like ones."""
    if repeated_groups.are_many(linear.rows.mask):

        def one(_: None, rows: covariance_algebra.Rows) -> tuple[None, Any]:
            (found,) = _groups(_alone(sensor), linear._replace(rows=rows), prior)
            return None, _Distance(found.visible, found.distance)

        return lax.scan(one, None, linear.rows)[1]
    rows = linear.rows
    # What is differentiated by closed forms counts on symmetric cotangents of covariances.
    cov = linalg.symmetrise(
        covariance_algebra.innovation_covariance(linear.slope, rows.slope, rows.noise, prior)
    )
    return _distances(sensor, rows.residual, linalg.mask_covariance(cov, rows.mask), rows.mask)


def _distances(sensor: Sensor, residual: Array, cov: Array, mask: Array) -> list[_Group]:
    found = []
    for members in sensor.group_rows:
        part = jnp.stack([residual[i] for i in members])
        shared = jnp.stack([jnp.stack([cov[i, j] for j in members]) for i in members])
        visible = written_sum([mask[i].astype(int) for i in members])
        found.append(_Group(members, visible, linalg.squared_distance(part, shared)))
    return found


def _gate(sensor: Sensor, mask: Array, groups: list[_Group]) -> tuple[Array, list[Array]]:
    """Visible rows whose group lies outside its chi-square bound; and for each row how many times
    larger than expected its group's squared error is."""
    outside: list[Any] = [None] * sensor.rows
    ratios: list[Any] = [None] * sensor.rows
    for members, visible, distance in groups:
        bound = _bound(sensor.gate, members, visible, distance)
        # A distance that is NaN is outside too: such a row must not enter the update.
        rejected = jnp.logical_not(distance <= bound)
        ratio = distance / jnp.maximum(visible, 1).astype(distance.dtype)
        for row in members:
            outside[row], ratios[row] = rejected, lax.stop_gradient(ratio)
    return lax.stop_gradient(jnp.stack(outside) & mask), ratios
