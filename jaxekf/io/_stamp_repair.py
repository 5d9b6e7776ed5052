"""Stamps of a CSV file that need repair: counters, wraps, shared stamps, stamps of receipt, and shifts.

All repairs are asked for by entries of the stream's section of `recording.toml`; without them a wrap is an
error and bursts are a note, both naming the entry.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf.io.csv_table import TIME_UNITS, Table, stamps, times_or_blank
from jaxekf.recordings.facts import as_number, wrong_entry
from jaxekf.recordings.stamp_envelope import delays, restamped
from jaxekf.recordings.types import NANOSECONDS, Floats, Times

ENTRIES = {
    "time_shift": "seconds that are added to the stamps, of any sign (default 0)",
    "time_wrap": 'bits of a counter of `time_unit` that wraps, or with its unit such as "32 us"',
    "counter_rate": "rate in Hz, where the column `time` counts samples (a packet or frame number)",
    "spread_stamps": "whether rows that share a stamp are spread evenly up to it (default false)",
    "restamp": "whether stamps of receipt are replaced by the line below them (default false)",
}
"""Entries of a section, and what they mean."""
_WIDTHS = (8, 16, 24, 32)
_LONGEST_SHIFT_S = 1e9
_SHORT, _FEW = 0.1, 0.05
"""A step is short below this part of the mean step; stamps come in bursts if a larger share is short."""
_SPREAD = 2.5
"""Spread of the delays, in mean steps, from which on short steps are those of bursts: the union of two
regular sequences has less."""
_FEWEST = 50


class StampRepair(NamedTuple):
    """Repair of the stamps of one stream, as its section asks for."""

    label: str
    shift_ns: int = 0
    wrap: int | None = None
    """Nanoseconds, or counts with `counter_rate`, after which the counter begins again."""
    rate_hz: float | None = None
    spread: bool = False
    restamp: bool = False
    framed: bool = False
    """Whether the rows of one frame share a stamp."""


def stated(label: str, about: Mapping[str, Any], place: Path | str, framed: bool) -> StampRepair:
    """The repair that a section asks for. Raises `RecordingError` for an entry of another form."""

    def flag(key: str) -> bool:
        value = about.get(key, False)
        if not isinstance(value, bool):
            raise wrong_entry(place, f"{label}.{key}", value, "true or false")
        return value

    shift = as_number(about.get("time_shift", 0.0))
    if shift is None or abs(shift) > _LONGEST_SHIFT_S:
        expected = f"finite seconds of any sign, {_LONGEST_SHIFT_S:g} at most"
        raise wrong_entry(place, f"{label}.time_shift", about["time_shift"], expected)
    rate = None
    if "counter_rate" in about:
        value = about["counter_rate"]
        rate = as_number(value)
        if rate is None or not 0.0 < rate < 1e6:
            raise wrong_entry(place, f"{label}.counter_rate", value, "a positive rate in Hz")
    spread = flag("spread_stamps")
    if spread and framed:
        hint = "leaving it out: rows of one frame share a stamp"
        raise wrong_entry(place, f"{label}.spread_stamps", True, f"false for {label}", hint)
    wrap = _wrap(label, about, place, rate is not None)
    shift_ns = round(shift * NANOSECONDS)
    return StampRepair(label, shift_ns, wrap, rate, spread, flag("restamp"), framed)


def _wrap(label: str, about: Mapping[str, Any], place: Path | str, counted: bool) -> int | None:
    value = about.get("time_wrap")
    if value is None:
        return None
    found = re.fullmatch(r"(\d+)(?: +(s|ms|us|µs|ns))?", str(value))
    bits = int(found[1]) if found and not isinstance(value, bool) else 0
    if not found or not 4 <= bits <= 62 or (counted and found[2]):
        expected = 'a number of bits such as 32, or with the unit of the counter "32 us"'
        raise wrong_entry(place, f"{label}.time_wrap", value, expected)
    unit = found[2] or about.get("time_unit", "s")
    return 2**bits if counted else 2**bits * 10 ** TIME_UNITS[unit]


def mended(table: Table, asked: StampRepair) -> tuple[Table, tuple[str, ...]]:
    """The table with its stamps repaired, and a note on each repair.

    Raises `RecordingError` for stamps that go back as those of a counter that wraps, if nothing is asked.
    """
    if "time" not in table.columns:
        return table, ()
    notes: list[str] = []
    times = stamps(table) if asked.rate_hz is None else _counts(table)
    if asked.wrap is not None:
        times, count = unwrapped(times, asked.wrap)
        notes.append(f"the counter of the stamps wraps {count} times: unwrapped")
    else:
        _refuse_wrap(table, times, asked)
    if asked.rate_hz is not None:
        notes += _losses(times, asked)
        times = _scaled(times, asked.rate_hz)
    frame = np.arange(len(times))
    if asked.framed and len(times):
        frame = np.cumsum(np.diff(times, prepend=times[0]) != 0)
        times = times[np.flatnonzero(np.diff(frame, prepend=-1))]
    if asked.spread:
        times, note = spread(times)
        notes += note
    if asked.restamp and len(times) >= _FEWEST:
        times, found = restamped(times)
        notes.append(
            f"stamps of receipt are replaced by the line below them: a sample every"
            f" {found.period_s * 1e3:.6g} ms, delays of {1e3 * found.median_s:.3g} ms (median) and"
            f" {1e3 * found.largest_s:.3g} ms (largest) taken off, {found.lost} samples taken for lost; a"
            " constant delay remains, which jaxekf align finds"
        )
    if asked.shift_ns:
        notes.append(f"{asked.shift_ns / NANOSECONDS:g} s are added to the stamps (time_shift)")
    return replace(table, times=times[frame] + asked.shift_ns), tuple(notes)


def _counts(table: Table) -> Times:
    """The column `time` as whole counts."""
    counts, known = times_or_blank(table, "time", 1)
    if not known.all():
        row = int(np.argmin(known))
        raise table.error(row, "time", "a blank cell", "a count", "removing the row")
    return counts


def _scaled(counts: Times, rate_hz: float) -> Times:
    """Counts in nanoseconds; exact where a period is a whole number of them."""
    period = Decimal(NANOSECONDS) / Decimal(repr(rate_hz))
    if period == period.to_integral_value():
        return counts * int(period)
    return np.array([int((n * period).to_integral_value()) for n in counts.tolist()], np.int64)


def _losses(counts: Times, asked: StampRepair) -> list[str]:
    step = np.diff(counts)
    lost = int((step[step > 1] - 1).sum())
    if not lost:
        return []
    return [f"{lost} samples are missing by the counter, at {int((step > 1).sum())} places"]


def unwrapped(times: Times, modulus: int) -> tuple[Times, int]:
    """Times (N,) with the modulus added at each jump back by more than half of it, and the jumps."""
    jumps = np.diff(times) < -(modulus // 2)
    return times + modulus * np.concatenate([[0], np.cumsum(jumps)]), int(jumps.sum())


def _refuse_wrap(table: Table, times: Times, asked: StampRepair) -> None:
    """Raise `RecordingError` at the first jump back by the length of a counter."""
    steps = np.diff(times)
    back = np.flatnonzero(steps < 0)
    forward = steps[steps > 0]
    if not back.size or not forward.size:
        return
    usual = float(np.median(forward))
    at = int(back[0])
    for unit in dict.fromkeys((table.time_unit, "us", "ns", "ms")):
        scale = 1 if asked.rate_hz is not None else 10 ** TIME_UNITS[unit]
        for bits in _WIDTHS:
            after = float(steps[at]) + 2.0**bits * scale
            if 0.0 < after < 5.0 * usual and 2.0**bits * scale > 20.0 * usual:
                own = unit == table.time_unit or asked.rate_hz is not None
                entry = f"time_wrap = {bits}" if own else f'time_wrap = "{bits} {unit}"'
                named = "counts" if asked.rate_hz is not None else unit
                raise table.error(
                    at + 1,
                    "time",
                    f"{table.cell(at + 1, 'time')} after {table.cell(at, 'time')}, back by 2^{bits}"
                    f" {named} less one step, as a counter of {bits} bits does that wraps",
                    "times that increase",
                    f"{entry} under [{asked.label}] in recording.toml, which unwraps it",
                )
        if asked.rate_hz is not None:
            return


def spread(times: Times) -> tuple[Times, list[str]]:
    """Rows that share a stamp spread up to it, a period apart; the last of them keeps the stamp."""
    group = np.cumsum(np.diff(times, prepend=times[:1]) != 0)
    first = np.flatnonzero(np.diff(group, prepend=-1))
    size = np.diff(np.append(first, len(times)))
    if size.max(initial=1) == 1 or len(first) < 2:
        return times, []
    interval = np.diff(times[first]).astype(float)
    period = float(np.median(interval / size[1:]))
    each = np.minimum(period, np.concatenate([[period], interval / size[1:]]))
    place = first[group] + size[group] - 1 - np.arange(len(times))
    moved = times - np.round(place * each[group]).astype(np.int64)
    shared = int(size[size > 1].sum())
    note = (
        f"{shared} rows share a stamp with others, up to {int(size.max())} of them: spread"
        f" {period / 1e6:.6g} ms apart, the last on the stamp"
    )
    return moved, [note]


def burst_notes(label: str, time_ns: Times) -> tuple[str, ...]:
    """A note on stamps that come in bursts, as those of receipt do; none for others."""
    steps: Floats = np.diff(time_ns).astype(float)
    if len(steps) < _FEWEST:
        return ()
    mean = float(np.mean(steps[steps < 20.0 * np.mean(steps)]))
    short = float(np.mean(steps < _SHORT * mean))
    if short < _FEW:
        return ()
    found = delays(time_ns)
    if found.spread_s * NANOSECONDS < _SPREAD * mean:
        return ()
    return (
        f"stamps come in bursts: {100.0 * short:.0f} % of the steps are below"
        f" {_SHORT * mean / 1e6:.2g} ms, at a mean step of {mean / 1e6:.4g} ms, and delays spread over"
        f" {1e3 * found.spread_s:.3g} ms; these are times of receipt, not of measurement: record the"
        f" sensor's own stamps, or set restamp = true under [{label}] in recording.toml",
    )
