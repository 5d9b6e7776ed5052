"""Accelerometer and magnetometer of an IMU at rates of their own, brought to the gyroscope's samples."""

from typing import NamedTuple

import numpy as np

from jaxekf.recordings.quaternion_norms import whole
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Times, period_ns

_OWN = 0.05
"""Share of the gyroscope's rows without an accelerometer from which on that has a rate of its own; below
it, these are samples that are missing."""
_SHORTEST_S, _LONGEST_S = 0.1, 0.5
_PERIODS = 3.0


_HELD, _LARGE = 0.05, 8.0
"""Share of rows that repeat the one before, and steps of resolution by which the values change elsewhere,
from which on they are held."""


class Rows(NamedTuple):
    """Rows of an IMU of which each has a gyroscope, or is of another sensor alone."""

    accelerometer: Floats | None
    """(N, 3)"""
    magnetometer: Floats | None
    """(N, 3)"""
    alone: Flags
    """(N,) rows without any gyroscope, read for the other sensors."""
    notes: tuple[str, ...]


def at_gyroscope(
    time_ns: Times, gyroscope: Floats, accelerometer: Floats | None, magnetometer: Floats | None
) -> Rows:
    """The other sensors at the gyroscope's rows (N,), where cells between their samples are blank.

    The accelerometer is interpolated on the straight line between its samples if they are no more than
    three of its periods apart. A magnetometer sample in a row without a gyroscope goes to the nearest row
    that has one, interpolated to that time.
    """
    turning = whole(gyroscope)
    others = np.zeros(len(time_ns), bool)
    for values in (accelerometer, magnetometer):
        if values is not None:
            others |= whole(values)
    alone = np.asarray(np.isnan(gyroscope).all(axis=1)) & others
    notes: list[str] = []
    if accelerometer is not None:
        known = whole(accelerometer)
        blank = np.asarray(np.isnan(accelerometer).all(axis=1)) & turning
        if known.sum() > 1 and blank.sum() > _OWN * turning.sum():
            accelerometer = _interpolated(time_ns, accelerometer, known, blank)
            notes.append(
                f"the accelerometer has {int(known.sum())} samples of its own, {_hz(time_ns[known])}:"
                f" interpolated to the {int(turning.sum())} of the gyroscope, {_hz(time_ns[turning])}"
            )
    if magnetometer is not None and (lone := whole(magnetometer) & alone).any():
        magnetometer, moved = _at_nearest(time_ns, magnetometer, lone, turning)
        notes.append(f"{moved} samples of the magnetometer are moved to the nearest gyroscope's")
    return Rows(accelerometer, magnetometer, alone, tuple(notes))


def held_note(gyroscope: Floats) -> tuple[str, ...]:
    """A note on values (N, 3) that are held between samples; none where they repeat because they change
    by less than the resolution."""
    change = np.abs(np.diff(gyroscope, axis=0))
    largest = change.max(axis=1, initial=0.0)
    moved = largest > 0.0
    if moved.sum() < 50 or moved.all():
        return ()
    step = float(change[change > 0.0].min())
    # The change into the row that is repeated, or that of an earlier one that is repeated again.
    last = np.maximum.accumulate(np.where(moved, np.arange(len(moved)), 0))
    fast = largest[last] > _LARGE * step
    share = float((~moved & fast).sum() / max(int(fast.sum()), 1))
    if share < _HELD:
        return ()
    return (
        f"{100.0 * share:.0f} % of the rows repeat the gyroscope of the row before to the last bit while"
        " it changes by much more than its resolution: values are held between samples, such as in a"
        " message for each sensor's event; blank the cells of a sensor that has no new sample",
    )


def _hz(time_ns: Times) -> str:
    period = period_ns(time_ns)
    return f"{NANOSECONDS / period:.4g} Hz" if period else "once"


def _interpolated(time_ns: Times, values: Floats, known: Flags, asked: Flags) -> Floats:
    """Values (N, 3) with those `asked` (N,) between the `known` ones; NaN in gaps and far outside."""
    times, there = time_ns[known], time_ns[asked]
    limit = np.clip(_PERIODS * period_ns(times) / NANOSECONDS, _SHORTEST_S, _LONGEST_S)
    after = np.clip(np.searchsorted(times, there), 1, len(times) - 1)
    gap = times[after] - times[after - 1]
    outside = np.maximum(np.maximum(times[0] - there, there - times[-1]), 0)
    near = (gap <= limit * NANOSECONDS) & (outside <= 1.5 * period_ns(times))
    t, own = (there - times[0]).astype(float), (times - times[0]).astype(float)
    found = np.stack([np.interp(t, own, column) for column in values[known].T], axis=1)
    values = values.copy()
    values[asked] = np.where(near[:, None], found, np.nan)
    return values


def _at_nearest(time_ns: Times, values: Floats, lone: Flags, turning: Flags) -> tuple[Floats, int]:
    """Values (N, 3) of `lone` rows at the nearest of the rows `turning`, and how many have moved."""
    rows = np.flatnonzero(turning)
    if not rows.size:
        return values, 0
    times = time_ns[rows]
    after = np.clip(np.searchsorted(times, time_ns[lone]), 1, max(len(times) - 1, 1))
    after = np.minimum(after, len(times) - 1)
    before = np.maximum(after - 1, 0)
    closer = time_ns[lone] - times[before] < times[after] - time_ns[lone]
    target = np.unique(rows[np.where(closer, before, after)])
    target = target[~whole(values[target])]
    asked = np.zeros(len(time_ns), bool)
    asked[target] = True
    return _interpolated(time_ns, values, whole(values), asked), len(target)
