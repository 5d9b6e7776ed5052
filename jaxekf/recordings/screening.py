"""Screening of a stream's rows while it is read: used, masked or dropped, by reason and place.

Whatever a stream was read from (CSV, HDF5, NPZ, another program's file), its rows are judged here, so
that a fault has the same result everywhere. A masked row is a sample that must not be used; a dropped
row is no sample at all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxekf.recordings import sensor_rates
from jaxekf.recordings.accounts import Indices, Intake, Place, Reason
from jaxekf.recordings.quaternion_norms import judge_quaternions, whole
from jaxekf.recordings.types import Encoder, Flags, Floats, Imu, Optical, Times

SLOWEST_S, SLOWEST_TRACKER_S = 0.5, 1.5
"""Median step from which on a stream is taken for one whose times are in another unit."""
FASTEST_S = 2e-5
_BEYOND = 1e6
"""SI: beyond any sensor, such as the huge numbers that mark a lost tool."""
_SHARED = 0.2
"""Share of rows with the stamp of the one before, from which on stamps are shared on purpose."""
STATUS_OK = ("ok", "0")
"""Words of a status that mean a good sample, unless others are stated; in lower case."""
NDI_STATUS = {
    "3": "partly out of volume",
    "5": "partial",
    "9": "out of volume",
    "17": "bad fit",
    "20": "fell behind",
    "31": "missing",
}
"""Meaning of the status numbers of NDI trackers."""


def optical(
    place: Place,
    time_ns: Times,
    quaternion: Floats,
    position: Floats | None = None,
    *,
    status: Sequence[str] | NDArray[np.str_] | None = None,
    status_ok: Sequence[str] = STATUS_OK,
    error: Floats | None = None,
    error_max: float = np.inf,
    hidden: Flags | None = None,
    also: Mapping[str, Flags] | None = None,
    sort: bool = False,
    **fields: Any,
) -> tuple[Optical, Intake]:
    """A tracker's poses (w, x, y, z, body to reference; metres; NaN where blank), bad rows masked.

    `status` (N,) are words of which `status_ok` (any case) mean a good row; rows whose reported fit
    `error` (N,), metres, exceeds `error_max` are masked, as are those that `hidden` (N,) names, and those
    (N,) that an importer knows to be bad, for the reasons `also`. `fields` are further fields of `Optical`.
    Raises `RecordingError` where no row is usable, and what `in_order`, `check_rate` and
    `judge_quaternions` do.
    """
    numbers = [a for a in (quaternion, position, error, hidden) if a is not None]
    if status is not None:
        numbers.append(np.unique(np.asarray(status, str), return_inverse=True)[1].astype(float))
    order, account = in_order(place, time_ns, numbers, sort=sort)
    place, time_ns = place.take(order), time_ns[order]
    check_rate(place, time_ns, SLOWEST_TRACKER_S)
    quaternion = chosen(quaternion, order)
    position = None if position is None else chosen(position, order)
    error = None if error is None else error[order]
    reasons: dict[str, Flags] = {} if hidden is None else {"hidden": hidden[order]}
    if status is not None:
        words = np.array([str(status[i]).strip().lower() for i in order], str)
        good = {str(word).strip().lower() for word in status_ok}
        for word in np.unique(words):
            if word not in good:
                meaning = NDI_STATUS.get(word)
                name = f"status {word}" if meaning is None else f"status {word} ({meaning})"
                reasons[name] = words == word
    reasons |= {name: bad[order] for name, bad in (also or {}).items()}
    # Only rows with a good status are judged as quaternions; the others may hold anything.
    ignored = np.zeros(len(time_ns), bool)
    for bad in reasons.values():
        ignored |= bad
    unit, lost, notes = judge_quaternions(place, np.where(ignored[:, None], np.nan, quaternion))
    reasons |= lost
    if position is not None:
        reasons["position not finite"] = ~whole(position)
        reasons["position beyond any tracker"] = huge(position)
    if error is not None:
        with np.errstate(invalid="ignore"):
            reasons[f"fit error over {error_max:g} m"] = error > error_max
    valid, account = mask_first(place, time_ns, account, reasons)
    hint = "a run in which the tool is seen, or stating the status words that are good (status_ok)"
    need_usable(place, valid, account, "row", hint)
    coarse = rounded(quaternion[valid])
    account = replace(
        account, notes=(*account.notes, *notes), has_status=status is not None, rounded=coarse
    )
    return Optical(time_ns, unit, valid, position, error=error, **fields), account


def imu(
    place: Place,
    time_ns: Times,
    gyroscope: Floats,
    accelerometer: Floats | None = None,
    magnetometer: Floats | None = None,
    *,
    sort: bool = False,
) -> tuple[Imu, Intake]:
    """An IMU's samples, SI units; rows of which gyroscope or accelerometer is not finite are masked: they
    are left out of the stream, for an input cannot be masked.

    A magnetometer may be slower than the rest: where it is not finite it was not read. An accelerometer
    at a rate of its own, blank between its samples or in rows of its own, is brought to the gyroscope's
    samples by `sensor_rates.at_gyroscope`. Raises `RecordingError` where no row is finite, and what
    `in_order` and `check_rate` raise.
    """
    numbers = [a for a in (gyroscope, accelerometer, magnetometer) if a is not None]
    order, account = in_order(place, time_ns, numbers, sort=sort)
    place, time_ns = place.take(order), time_ns[order]
    check_rate(place, time_ns)
    gyroscope = chosen(gyroscope, order)
    others = (None if a is None else chosen(a, order) for a in (accelerometer, magnetometer))
    joined = sensor_rates.at_gyroscope(time_ns, gyroscope, *others)
    bad, far = ~whole(gyroscope), huge(gyroscope)
    if joined.accelerometer is not None:
        bad |= ~whole(joined.accelerometer)
        far |= huge(joined.accelerometer)
    reasons = {"of another sensor, without gyroscope": joined.alone}
    valid, account = mask_first(
        place, time_ns, account, reasons | {"not finite": bad, "beyond any sensor": far}
    )
    if not valid.any():
        raise place.error(
            None, None, f"no finite row among {account.rows}", "at least one", "recording again"
        )
    assert account.numbers is not None
    notes = (*account.notes, *joined.notes, *sensor_rates.held_note(gyroscope[valid]))
    account = replace(account, numbers=account.numbers[valid], notes=notes)
    kept = np.flatnonzero(valid)
    others = (joined.accelerometer, joined.magnetometer)
    streams = (None if a is None else chosen(a, kept) for a in others)
    return Imu(time_ns[valid], chosen(gyroscope, kept), *streams), account


def encoder(
    place: Place,
    time_ns: Times,
    quaternion: Floats,
    position: Floats | None = None,
    *,
    scored: Flags | None = None,
    hidden: Flags | None = None,
    sort: bool = False,
    latency_ns: int = 0,
) -> tuple[Encoder, Intake]:
    """Truth (w, x, y, z, tool to the tracker's reference; metres), what is not a rotation masked, as are
    rows that `hidden` (N,) names.

    A position that is not known is NaN. Raises what `in_order` and `judge_quaternions` raise.
    """
    scored = np.ones(len(time_ns), bool) if scored is None else scored
    hidden = np.zeros(len(time_ns), bool) if hidden is None else hidden
    numbers = [quaternion, scored, hidden]
    numbers += [] if position is None else [position]
    order, account = in_order(place, time_ns, numbers, sort=sort)
    place, time_ns = place.take(order), time_ns[order]
    hidden = hidden[order]
    seen = np.where(hidden[:, None], np.nan, quaternion[order])
    unit, lost, notes = judge_quaternions(place, seen)
    valid, account = mask_first(place, time_ns, account, {"hidden": hidden} | lost)
    hint = "leaving the stream out where there is no truth"
    need_usable(place, valid, account, "row", hint)
    account = replace(account, notes=(*account.notes, *notes))
    position = None if position is None else position[order]
    scored = scored[order] & valid
    return Encoder(time_ns, unit, valid, scored, position, latency_ns), account


def judge_markers(
    place: Place,
    time_ns: Times,
    position: Floats,
    marker: Indices,
    account: Intake,
    *,
    seen: Flags | None = None,
) -> tuple[Flags, Intake]:
    """Which rows (N,), each of a marker (N,) at a position (N, 3), are of one that is seen; the others are
    masked, by reason.

    `seen` (N,) is the flag of the source for each row, where it has one: a position that is repeated
    exactly is then accepted, as that of a static tool. Raises `RecordingError` where no row is left.
    """
    blank, finite = np.asarray(np.isnan(position).all(axis=1)), whole(position)
    reasons = {} if seen is None else {"hidden": ~seen}
    reasons |= {
        "blank": blank,
        "not finite": ~finite,
        "missing marker (zeros)": finite & np.asarray((position == 0.0).all(axis=1)),
        "beyond any tracker": huge(position),
    }
    if seen is None and not rounded(position[finite]):
        order = np.lexsort((time_ns, marker))
        order = order[finite[order]]
        there = position[order]
        again = np.zeros(len(position), bool)
        same = (there[1:] == there[:-1]).all(axis=1) & (np.diff(marker[order]) == 0)
        again[order[1:][same]] = True
        reasons["suspicious (position repeated exactly)"] = again
    valid, account = mask_first(place, time_ns, account, reasons)
    need_usable(place, valid, account, place.unit, "a run in which markers are seen")
    return valid, account


def judge_points(
    place: Place, time_ns: Times, pixel: Floats, account: Intake, *, seen: Flags | None = None
) -> tuple[Flags, Intake]:
    """Which rows (N,), each of a landmark's image point (N, 2), are of one that was found; the others are
    masked, by reason.

    `seen` (N,) is the flag of the source for each row, where it has one. Raises `RecordingError` where no
    row is left.
    """
    blank = np.asarray(np.isnan(pixel).all(axis=1))
    reasons = {} if seen is None else {"hidden": ~seen}
    reasons |= {"blank": blank, "not finite": ~whole(pixel)}
    valid, account = mask_first(place, time_ns, account, reasons)
    need_usable(place, valid, account, place.unit, "a run in which landmarks are found")
    return valid, account


def in_order(
    place: Place,
    time_ns: Times,
    data: Sequence[Floats | Flags],
    *,
    sort: bool = False,
    part: Indices | None = None,
    parts: Sequence[str] = (),
) -> tuple[Indices, Intake]:
    """Rows in order of time, each time once, and what was dropped.

    With `part` (N,), such as the marker that each row is of, it is each part that has each time once;
    `parts` are their names.

    A row with the time and all numbers of the one before is dropped. Raises `RecordingError` for one of the
    same time with other numbers, and for time that runs backwards, unless `sort` puts it right.
    """
    order, notes = np.arange(len(time_ns)), ()
    early = np.flatnonzero(np.diff(time_ns) < 0)
    if early.size and not sort:
        at = int(early[0]) + 1
        got = f"{_seconds(time_ns[at])} s after {_seconds(time_ns[at - 1])} s"
        expected = "times that increase" if part is None else "times that do not decrease"
        hint = "splitting logs that were put together, or --sort to order the rows by time"
        raise place.error(at, "time", got, expected, hint)
    if early.size:
        late = int(np.sum(time_ns < np.maximum.accumulate(time_ns)))
        order = np.argsort(time_ns, kind="stable")
        notes = (f"{late} rows were out of order and are sorted by time",)
    time = time_ns[order]
    before, again = _repeats(time, None if part is None else part[order])
    if again.size:
        flat = np.concatenate([np.reshape(d, (len(time_ns), -1)) for d in data], axis=1)[order]
        one, other = flat[again], flat[before]
        same = ((one == other) | (np.isnan(one) & np.isnan(other))).all(axis=1)
        if not same.all():
            at = int(order[again[np.argmin(same)]])
            named = "" if part is None else f"'{parts[part[at]]}' at "
            got = f"{named}{_seconds(time_ns[at])} s twice with other numbers"
            expected = "each time once" if part is None else "each of them once a frame"
            hint = "exporting times with more digits, or removing one of the rows"
            if part is None and place.unit == "line" and len(again) > _SHARED * len(time_ns):
                hint = "exporting times with more digits, or spread_stamps = true in recording.toml"
            raise place.error(at, "time", got, expected, hint)
    kept = np.ones(len(time), bool)
    kept[again] = False
    dropped = {}
    if again.size:
        dropped["repeated"] = reasoned(place, order[again], time[again])
    kept = order[kept]
    numbers = kept if place.numbers is None else place.numbers[kept]
    return kept, Intake(len(time_ns), {}, dropped, notes, place.unit, numbers)


def _repeats(time_ns: Times, part: Indices | None) -> tuple[Indices, Indices]:
    """Rows with the time (and part) of an earlier one: the one before each, and they themselves."""
    if part is None:
        again = np.flatnonzero(np.diff(time_ns) == 0) + 1
        return again - 1, again
    order = np.lexsort((part, time_ns))
    same = (np.diff(time_ns[order]) == 0) & (np.diff(part[order]) == 0)
    at = np.flatnonzero(same)
    return order[at], order[at + 1]


def reasoned(place: Place, rows: Indices, time_ns: Times) -> Reason:
    """The reason of rows (n,) of a place, which have these stamps."""
    numbers = rows if place.numbers is None else place.numbers[rows]
    order = np.argsort(numbers, kind="stable")
    return Reason(numbers[order], time_ns[order])


def mask_first(
    place: Place, time_ns: Times, intake: Intake, found: Mapping[str, Flags]
) -> tuple[Flags, Intake]:
    """Which rows (N,) are valid where each of these is a reason to mask one, and the account of it; a row
    counts for the first reason that holds."""
    valid = np.ones(len(time_ns), bool)
    masked = dict(intake.masked)
    for name, bad in found.items():
        rows = np.flatnonzero(bad & valid)
        if rows.size:
            masked[name] = reasoned(place, rows, time_ns[rows])
            valid[rows] = False
    return valid, replace(intake, masked=masked)


def need_usable(place: Place, valid: Flags, account: Intake, what: str, hint: str) -> None:
    """Raise `RecordingError`, with the reasons, where no row (or line) is valid."""
    if not valid.any():
        reasons = ", ".join(f"{r.count} {name}" for name, r in account.masked.items())
        got = f"no usable {what} among {account.rows} ({reasons})"
        raise place.error(None, None, got, "at least one", hint)


def check_reported(
    place: Place, column: str, values: Floats | None, least: float = -np.inf
) -> Floats | None:
    """Figures (N, ...) that a sensor reports, unchanged. Raises `RecordingError` unless each is finite and
    not below `least`, or NaN where none was reported."""
    if values is not None and (bad := np.argwhere(np.isinf(values) | (values < least))).size:
        at = tuple(bad[0])
        expected = "a finite number" if np.isinf(least) else f"a finite number, {least:g} or more"
        hint = "writing NaN, which means that none was reported"
        raise place.error(int(at[0]), column, f"{values[at]}", expected, hint)
    return values


def chosen(values: NDArray[Any], rows: Indices) -> NDArray[Any]:
    """Some rows of values (N, ...); the values themselves, no copy, where that is all of them in order."""
    every = len(rows) == len(values) and bool((rows == np.arange(len(rows))).all())
    return values if every else values[rows]


def huge(values: Floats) -> Flags:
    """Rows (N,) of values (N, c) of which some are beyond what is measured."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((values > _BEYOND) | (values < -_BEYOND)).any(axis=1))


def check_rate(place: Place, time_ns: Times, slowest_s: float = SLOWEST_S) -> None:
    """Raise `RecordingError` where the rate that the times imply is that of another unit."""
    if len(time_ns) < 3:
        return
    step = float(np.median(np.diff(time_ns))) * 1e-9
    mean = float(time_ns[-1] - time_ns[0]) / (len(time_ns) - 1) * 1e-9
    if 0.0 < step < FASTEST_S and mean < 100.0 * FASTEST_S:
        got = f"a sample every {step:.3g} s"
        expected = f"a rate of {1e-3 / FASTEST_S:g} kHz at most"
        raise place.error(None, "time", got, expected, _unit_hint(place, 's", or "ms'))
    if step < slowest_s:
        return
    for unit, factor in (("ms", 1e3), ("µs", 1e6), ("ns", 1e9)):
        rate = factor / step
        if 2.0 < rate <= 2e4:
            raise place.error(
                None,
                "time",
                f"a sample every {step:.6g} s",
                f"a rate of more than {1.0 / slowest_s:.2g} Hz (in {unit} it would be {rate:.4g} Hz)",
                _unit_hint(place, unit),
            )


def _unit_hint(place: Place, unit: str) -> str:
    """Only the rows of a text have a unit that may be stated: data sets hold nanoseconds."""
    if place.unit == "sample":
        return "writing time_ns in nanoseconds"
    return f'stating the unit of its times: time_unit = "{unit}"'


def _seconds(time_ns: int) -> str:
    return f"{int(time_ns) / 1e9:.9f}".rstrip("0").rstrip(".")


def rounded(values: Floats) -> bool:
    """Whether numbers were exported with so few decimals that a resting tool may repeat them."""
    finite = values[np.isfinite(values)]
    scaled = 1e4 * finite[np.abs(finite) < 1e6]
    return bool(np.all(np.abs(scaled - np.round(scaled)) < 1e-6)) if scaled.size else False
