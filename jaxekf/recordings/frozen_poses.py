"""Poses that a tracker repeats to the last bit: so looks a tool that was lost.

Which of them are masked needs the IMU beside the tracker, so that it is done once a run is whole.
"""

from dataclasses import replace

import numpy as np

from jaxekf.recordings.accounts import Indices, Place
from jaxekf.recordings.screening import reasoned
from jaxekf.recordings.types import Flags, Floats, Imu, Optical, Recording, Times

_RESTING, _TURNED, _STILL = 0.05, 0.04, 0.02
"""Largest rate (rad/s) and turn (rad) of the gyroscope of a static tool, and rad/s below which it is
static."""


def without_repeats(recording: Recording) -> Recording:
    """A run in which poses that a tracker repeats to the last bit are masked: so looks a lost tool.

    Where the gyroscope turns meanwhile the pose is frozen, whatever its status. Where it does not, a
    good status is accepted, and so are numbers of four decimals or fewer, which repeat of
    themselves; other repeats are suspicious, and the identity at the origin from its first row on.
    """
    stream, account = recording.optical, recording.intake.get("optical")
    if stream is None or account is None:
        return recording
    seen = np.flatnonzero(stream.valid)
    pose = stream.q_ref_body[seen]
    if stream.position is not None:
        pose = np.concatenate([pose, stream.position[seen]], axis=1)
    again = (pose[1:] == pose[:-1]).all(axis=1)
    if not again.any():
        return recording
    repeated = np.concatenate([[False], again])
    first = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(seen))))
    frozen = repeated & _turned(recording, seen, first)
    home = np.zeros(pose.shape[1])
    home[0] = 1.0
    lost = (pose == home).all(axis=1) & (stream.position is not None)
    lost &= repeated | np.concatenate([again, [False]])
    # The first row of a pose that lasts while the tool turns is good; that of a lost tool is not.
    frozen[first[frozen & lost]] = True
    names = {"frozen while the IMU moves": frozen}
    if not account.has_status:
        names["suspicious (identity at the origin, repeated)"] = lost
        if not account.rounded:
            names["suspicious (pose repeated exactly)"] = repeated
    place = Place(recording.path or recording.name, account.numbers)
    bad = np.zeros(len(seen), bool)
    for name, which in names.items():
        rows = seen[which & ~bad]
        bad |= which
        if rows.size:
            account = account.with_masked(name, reasoned(place, rows, stream.time_ns[rows]))
    if not bad.any():
        return recording
    valid = stream.valid.copy()
    valid[seen[bad]] = False
    if not valid.any():
        raise place.error(
            None, None, "one pose in all rows", "a tool that moves", "a run in which it is seen"
        )
    return recording.replace(
        optical=replace(stream, valid=valid), intake={**recording.intake, "optical": account}
    )


def _turned(recording: Recording, seen: Indices, first: Indices) -> Flags:
    """Whether the gyroscope turns by more than its noise since the first row of the same pose (n,)."""
    stream, imu = recording.optical, recording.imu
    assert stream is not None
    if imu is None:
        return np.zeros(len(seen), bool)
    taken = stream.time_ns[seen] - stream.latency_ns
    rate = imu.gyroscope - _resting_rate(stream, imu, seen, first, taken)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(rate, axis=0)])
    low = np.clip(np.searchsorted(imu.time_ns, taken[first]), 0, len(imu.time_ns) - 1)
    high = np.clip(np.searchsorted(imu.time_ns, taken, side="right"), low + 1, len(imu.time_ns))
    lasts = (taken - taken[first]) * 1e-9
    mean = np.linalg.norm((total[high] - total[low]) / (high - low)[:, None], axis=1)
    return (mean > _RESTING) | (mean * lasts > _TURNED)


def _resting_rate(stream: Optical, imu: Imu, seen: Indices, first: Indices, taken: Times) -> Floats:
    """Mean reading of the gyroscope while the tracker shows a static tool, which is its bias; else 0."""
    step = max(1, int(np.searchsorted(taken, taken[0] + 500_000_000)))
    a, b = stream.q_ref_body[seen[:-step]], stream.q_ref_body[seen[step:]]
    if not len(a):
        return np.zeros(3)
    angle = 2.0 * np.arccos(np.clip(np.abs(np.sum(a * b, axis=1)), 0.0, 1.0))
    span = (taken[step:] - taken[:-step]) * 1e-9
    # A pose that is the same for long is what is in doubt.
    new = first == np.arange(len(first))
    still = (angle < _STILL * span) & new[:-step] & new[step:] & (span < 2.0)
    if still.sum() < 10:
        return np.zeros(3)
    at = np.clip(np.searchsorted(imu.time_ns, taken[:-step][still]), 0, len(imu.time_ns) - 1)
    return np.median(imu.gyroscope[at], axis=0)
