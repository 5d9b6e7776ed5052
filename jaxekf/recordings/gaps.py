"""Parts of a run: between two times, and between the gaps of its IMU, where the motion is not known."""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from jaxekf._support import arrays
from jaxekf._support.errors import RecordingError
from jaxekf.recordings.accounts import Intake, Part, Reason
from jaxekf.recordings.types import NANOSECONDS, Flags, Recording, Times, period_ns

LONGEST_INPUT_GAP_S = 0.1
"""An input is interpolated over shorter gaps; over longer ones the motion is not known."""
_SHORTEST_S = 0.5
"""Shortest stretch between two gaps that is estimated."""


def longest_ns(time_ns: Times) -> float:
    """The longest step between samples of an input that is bridged, ns."""
    return max(LONGEST_INPUT_GAP_S * NANOSECONDS, 3 * period_ns(time_ns))


def crop(recording: Recording, start_s: float = 0.0, end_s: float = np.inf) -> Recording:
    """The part of a run between two times, for example to hold out its end from a tuning.

    Parameters
    ----------
    recording
        The run.
    start_s, end_s
        Seconds from the IMU's first sample. Samples taken at `start_s` belong to the part, those taken at
        `end_s` do not.

    Returns
    -------
    Recording
        The part, with the account of its rows, the name ``NAME-part`` and its times in ``info["part"]``.

    Raises
    ------
    RecordingError
        If the IMU has no sample in the interval.

    Examples
    --------
    >>> import jaxekf
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> training, validation = jaxekf.crop(run, 0.0, 16.0), jaxekf.crop(run, 16.0)
    >>> [len(part.need_imu().time_ns) for part in (run, training, validation)]
    [3001, 2000, 1001]
    """
    time = recording.need_imu().time_ns
    length_s = float(time[-1] - time[0]) / NANOSECONDS
    last = np.iinfo(np.int64).max
    start_s = arrays.number(start_s, arrays.argument("start_s"))
    end_s = arrays.number(end_s, arrays.argument("end_s"))
    begin = int(time[0]) + round(max(start_s, 0.0) * NANOSECONDS) if start_s <= length_s else last
    end = int(time[0]) + round(end_s * NANOSECONDS) if end_s <= length_s else last
    if not ((time >= begin) & (time < end)).any():
        raise RecordingError(
            recording.path or recording.name,
            f"no sample of the IMU from {start_s:g} s to {end_s:g} s",
            f"an interval within 0 to {length_s:.3f} s",
            "other times",
        )
    part = _part(recording, begin, end)
    about = f"{start_s:g} s to {min(end_s, length_s):g} s of '{recording.name}'"
    return part.replace(name=f"{recording.name}-part", info={**recording.info, "part": about})


def split_at_gaps(recording: Recording) -> tuple[list[Recording], list[Recording]]:
    """Split a run at the gaps of its IMU that are longer than 0.1 s and than three periods.

    Every row of the recording belongs to one part; rows of other streams within a gap belong to the part
    before it.

    Parameters
    ----------
    recording
        The run.

    Returns
    -------
    list of Recording
        The parts that can be estimated, named ``NAME-part1`` and so on, with the gaps in ``info["part"]``;
        the run itself if it has no gap or no IMU.
    list of Recording
        The parts that cannot be estimated: shorter than 0.5 s, or without a sample of tracker or camera.

    Examples
    --------
    The IMU has no samples for 0.8 s:

    >>> import numpy as np
    >>> import jaxekf
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> imu = run.need_imu()
    >>> run = run.replace(imu=imu.take(np.r_[:1000, 1100:3001]))
    >>> parts, left_out = jaxekf.split_at_gaps(run)
    >>> [part.name for part in parts], left_out
    (['free-5-part1', 'free-5-part2'], [])
    """
    if recording.imu is None:
        return [recording], []
    time = recording.imu.time_ns
    steps = np.diff(time)
    at = np.flatnonzero(steps > longest_ns(time))
    if not at.size:
        return [recording], []
    listed = ", ".join(
        f"{steps[i] / NANOSECONDS:.3f} s at {time[i] / NANOSECONDS:.3f} s" for i in at[:5]
    )
    more = f" and {len(at) - 5} more" if len(at) > 5 else ""
    lowest, highest = np.iinfo(np.int64).min, np.iinfo(np.int64).max
    edges = [lowest, *(int(time[i + 1]) for i in at), highest]
    good, bad = [], []
    for k, (begin, end) in enumerate(itertools.pairwise(edges)):
        part = _part(recording, begin, end)
        about = f"{k + 1} of {len(edges) - 1} of '{recording.name}', cut at gaps of the IMU: {listed}{more}"
        part = part.replace(
            name=f"{recording.name}-part{k + 1}", info={**recording.info, "part": about}
        )
        (good if _can_be_estimated(part) else bad).append(part)
    if good and bad:
        left = "; ".join(
            f"{part.name} is left out ("
            + ", ".join(f"{account.rows} rows of {label}" for label, account in part.intake.items())
            + ")"
            for part in bad
        )
        first = good[0]
        good[0] = first.replace(info={**first.info, "part": f"{first.info['part']}; {left}"})
    return good, bad


def _can_be_estimated(part: Recording) -> bool:
    if part.imu is None or np.ptp(part.imu.time_ns) < _SHORTEST_S * NANOSECONDS:
        return False
    first, last = part.imu.time_ns[[0, -1]]
    taken = []
    if part.optical is not None:
        taken.append(part.optical.time_ns[part.optical.valid] - part.optical.latency_ns)
    for stream in (part.markers, part.camera):
        if stream is not None:
            seen = stream.usable.any(axis=1)
            taken.append(stream.time_ns[seen] - stream.latency_ns)
    return any(bool(((t >= first) & (t <= last)).any()) for t in taken)


def _part(recording: Recording, begin: int, end: int) -> Recording:
    """Samples taken from one time to another, the latter not included."""
    streams: dict[str, Any] = {}
    intake: dict[str, Intake] = {}
    for label, stream in recording.streams.items():
        late = stream.latency_ns

        def inside(stamps: Times, late: int = late) -> Flags:
            return (stamps - late >= begin) & (stamps - late < end)

        rows = inside(stream.time_ns)
        streams[label] = stream.take(rows) if rows.any() else None
        account = recording.intake.get(label)
        if account is not None:
            intake[label] = _account_of(account, rows, inside)
    return recording.with_streams(streams, intake=intake)


def _account_of(account: Intake, rows: Flags, inside: Any) -> Intake:
    """The account of the rows of one part."""

    def cut(reasons: Mapping[str, Reason]) -> dict[str, Reason]:
        found = {}
        for name, reason in reasons.items():
            chosen = inside(reason.time_ns)
            if chosen.any():
                found[name] = Reason(reason.numbers[chosen], reason.time_ns[chosen])
        return found

    masked, dropped = cut(account.masked), cut(account.dropped)
    parts = {}
    for name, part in account.parts.items():
        absent, gone = part.absent[inside(part.absent)], part.dropped[inside(part.dropped)]
        parts[name] = Part(int(rows.sum()) - len(absent) + len(gone), gone, absent)
    # Masked rows that are none of the stream's samples.
    there = account.numbers if account.numbers is not None else np.zeros(0, np.intp)
    out = sum(int((~np.isin(reason.numbers, there)).sum()) for reason in masked.values())
    if parts:
        count = sum(part.rows for part in parts.values()) + out
    else:
        count = int(rows.sum()) + sum(reason.count for reason in dropped.values()) + out
    numbers = account.numbers
    if numbers is not None and len(numbers) == len(rows):
        numbers = numbers[rows]
    return replace(
        account, rows=count, masked=masked, dropped=dropped, parts=parts, numbers=numbers
    )
