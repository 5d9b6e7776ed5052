"""Poses that are rotated by a fixed wrong rotation for some time, found against the gyroscope.

A tracker that confuses the markers of a rigid body reports a pose that is turned by 180 deg or another
fixed angle, for one sample or for seconds. The turn between two poses then contradicts the gyroscope at
both ends of the stretch, and the two contradictions are inverse to each other. A clock offset, a wrong
scale or noise contradict everywhere a little; a reference that was moved contradicts once.
"""

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf.calibration import motion_agreement
from jaxekf.calibration.motion_agreement import Integral
from jaxekf.recordings.accounts import Indices, Place
from jaxekf.recordings.screening import reasoned
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Imu, Recording, Times, to_scipy

_LEAST = np.deg2rad(5.0)
_SPREADS, _OF_TURN, _OF_RATE_S = 8.0, 0.3, 0.02
"""A contradiction is larger than 5 deg, 8 times the usual disagreement, 0.3 of the gyroscope's turn, and
the turn in 0.02 s, which covers the errors of lag and scale, together."""
_LONGEST_S = 1.0
"""Poses farther apart are not compared."""
_MOST = 0.2
"""Share of pairs up to which contradictions are single events."""
_EXPLAINED, _CLEAR = 0.6, 0.9
_FEWEST = 40
_REPEATS = 5
_AROUND_S = 0.25
_FROZEN_TURN, _LARGEST_BIAS = np.deg2rad(2.0), np.deg2rad(3.0)
"""Turn, rad, and rate, rad/s, of a gyroscope at rest that repeats of an encoder may have."""


class Flips(NamedTuple):
    """Contradictions between poses and the gyroscope."""

    wrong: Flags
    """(N,) poses that are rotated by a wrong rotation and between right ones."""
    stretches: int
    first_s: float
    """Time of the first, s on the recording's clock."""
    fixed: bool
    """Whether most of them are wrong by one and the same rotation."""
    angle: float
    """Median angle of the wrong rotations, rad."""
    steps: list[tuple[float, float]]
    """Time, s, and angle, rad, of each step that does not return."""


def find_flips(time_ns: Times, q: Floats, imu: Imu, lag_s: float = 0.0) -> Flips | None:
    """Flipped stretches among poses (N, 4) at times (N,); None where the gyroscope does not decide.

    Parameters
    ----------
    time_ns, q
        Times, latency subtracted, and attitudes of the valid poses.
    imu
        The IMU's samples.
    lag_s
        Time by which the poses' stamps are late, s.
    """
    t = (time_ns - imu.time_ns[0]) / NANOSECONDS - lag_s
    covered = np.flatnonzero((t >= 0.0) & (t <= (imu.time_ns[-1] - imu.time_ns[0]) / NANOSECONDS))
    if len(covered) < _FEWEST or len(imu.time_ns) < 2:
        return None
    t, q = t[covered], q[covered]
    if np.abs(np.sum(q[1:] * q[:-1], axis=1)).min() > np.cos(0.5 * _LEAST):
        # No two poses differ by as much as a contradiction.
        return Flips(np.zeros(len(time_ns), bool), 0, np.nan, False, 0.0, [])
    measured = motion_agreement.rotation_vectors(q[:-1], q[1:])
    size = np.linalg.norm(measured, axis=1)
    turned = _turns(t, imu, measured, size)
    if turned is None:
        return None
    apart = np.diff(t)
    contradiction = _angle(Rotation.from_rotvec(turned).inv() * Rotation.from_rotvec(measured))
    rate = np.linalg.norm(imu.gyroscope, axis=1)
    at = np.clip(np.searchsorted((imu.time_ns - imu.time_ns[0]) / NANOSECONDS, t), 0, len(rate) - 1)
    fastest = np.maximum(rate[at[:-1]], rate[at[1:]])
    allowed = _LEAST + _SPREADS * 1.48 * float(np.median(contradiction))
    allowed = allowed + _OF_TURN * np.linalg.norm(turned, axis=1) + _OF_RATE_S * fastest
    jump = (contradiction > allowed) & (apart < _LONGEST_S)
    if jump.sum() > _MOST * len(jump):
        return None
    wrong = np.zeros(len(t), bool)
    found: list[_Part] = []
    # Over a longer gap nothing is compared: the poses on each side of it are judged by themselves.
    edges = np.r_[0, np.flatnonzero(apart >= _LONGEST_S) + 1, len(t)]
    for begin, end in itertools.pairwise(edges):
        at = begin + np.flatnonzero(jump[begin : end - 1])
        parts = _parts(at, begin, end, measured, turned, q, float(np.median(allowed)))
        # A part with right poses on one side only is not closed by a return: a wrong stamp looks like it.
        found += [
            part
            for part in parts
            if part.closed
            or _lasts(t, q, turned, part.end if part.begin == begin else part.begin, part.offset)
        ]
    steps = []
    # The last part may not have returned yet, which earlier ones of the same rotation show.
    if found and found[-1].end == len(t) and found[-1].begin > edges[-2] and not _again(found):
        last = found.pop()
        steps = [(float(time_ns[covered[last.begin]]) / NANOSECONDS, last.offset.magnitude())]
    for part in found:
        wrong[part.begin : part.end] = True
    fixed, angle = _fixed(found)
    begins = np.flatnonzero(np.diff(np.r_[False, wrong].astype(int)) > 0)
    whole = np.zeros(len(time_ns), bool)
    whole[covered] = wrong
    first = float(time_ns[covered[begins[0]]]) / NANOSECONDS if begins.size else np.nan
    return Flips(whole, len(begins), first, fixed, angle, steps)


class _Part(NamedTuple):
    """Poses from one to another that are wrong by one rotation."""

    begin: int
    end: int
    offset: Rotation
    closed: bool
    """Whether right poses come before and after."""


def _parts(
    jumps: Indices,
    begin: int,
    end: int,
    measured: Floats,
    turned: Floats,
    q: Floats,
    allowed: float,
) -> list[_Part]:
    """The wrong parts of the poses from `begin` to `end`, which are cut at the jumps."""
    if not len(jumps):
        return []
    offsets = min(
        (_offsets(jumps, measured, turned, q, allowed, body=body) for body in (True, False)),
        key=lambda found: found[-1].magnitude() > 0.0,
    )
    cuts = np.r_[begin, jumps + 1, end]
    lengths = np.diff(cuts)
    usual = offsets.magnitude() == 0.0
    if lengths[usual].sum() < 0.5 * lengths.sum():
        # The first part is right, unless one with another rotation lasts longer.
        longest = int(np.argmax(np.where(usual, 0, lengths)))
        turned_by = offsets[longest].inv() * offsets
        other = turned_by.magnitude() < 2.0 * _LEAST
        if lengths[other].sum() > lengths[usual].sum():
            usual, offsets = other, turned_by
    right = np.flatnonzero(usual)
    return [
        _Part(int(cuts[k]), int(cuts[k + 1]), offsets[k], bool(right[0] < k < right[-1]))
        for k in np.flatnonzero(~usual).tolist()
    ]


def _turns(t: Floats, imu: Imu, measured: Floats, size: Floats) -> Floats | None:
    """The gyroscope's turns (N - 1, 3) between poses, in the tool's frame and without its bias; None where
    the frame between the two is not determined."""
    integral = Integral(imu.time_ns, imu.gyroscope)
    turned = integral.between(t[:-1], t[1:])
    apart = np.diff(t)
    near = apart < 3.0 * np.median(apart)
    count = int(np.clip(np.ceil(0.1 / np.median(apart)), 1, max(1, near.sum() // _FEWEST)))
    # A jump by its size alone, for the frame is not known yet. Each jump to or from a fixed wrong rotation
    # changes sides, so that one of the sides has the right frame even where half of the poses are wrong.
    jumped = size > 1.5 * np.linalg.norm(turned, axis=1) + 2.0 * _LEAST
    side = np.cumsum(jumped) % 2
    fits = []
    for chosen in (near & ~jumped, near & ~jumped & (side == 0), near & ~jumped & (side == 1)):
        rows = np.flatnonzero(chosen)
        if len(rows) >= _FEWEST:
            rows = rows[: len(rows) // count * count].reshape(-1, count)
            ones, others = (values[rows].sum(axis=1) for values in (measured, turned))
            fits.append((motion_agreement.fit(ones, others), np.flatnonzero(chosen)))
    if not fits:
        return None
    clear = [made for made in fits[:1] if made[0].explained > _CLEAR]
    found, near = max(clear or fits, key=lambda made: made[0].explained)
    if not found.explained > _EXPLAINED:
        return None
    turned = turned @ found.frame.T
    bias = np.median((turned[near] - measured[near]) / apart[near, None], axis=0)
    return turned - bias * apart[:, None]


def _offsets(
    jumps: Indices, measured: Floats, turned: Floats, q: Floats, allowed: float, *, body: bool
) -> Rotation:
    """Rotations (K + 1,) from the right pose to the reported one in each part of a run that is cut at K
    jumps; the identity for angles up to `allowed` (rad).

    The wrong rotation is fixed in the body, as with swapped markers, or in the reference.
    """
    wrong, found = Rotation.identity(), [np.zeros(3)]
    for i in jumps:
        turn = Rotation.from_rotvec(turned[i])
        if body:
            wrong = turn.inv() * wrong * Rotation.from_rotvec(measured[i])
        else:
            wrong = to_scipy(q[i + 1]) * (wrong.inv() * to_scipy(q[i]) * turn).inv()
        if wrong.magnitude() < allowed:
            wrong = Rotation.identity()
        found.append(wrong.as_rotvec())
    return Rotation.from_rotvec(found)


def _again(parts: list[_Part]) -> bool:
    """Whether the last part has the wrong rotation of an earlier one."""
    *earlier, last = parts
    return any((one.offset.inv() * last.offset).magnitude() < 2.0 * _LEAST for one in earlier)


def _fixed(parts: list[_Part]) -> tuple[bool, float]:
    """Whether most of the wrong poses, three at least, are wrong by one rotation, and its angle, rad."""
    if not parts:
        return False, 0.0
    count = np.array([part.end - part.begin for part in parts])
    wrong = Rotation.concatenate([part.offset for part in parts])
    longest = int(np.argmax(count))
    same = (wrong[longest].inv() * wrong).magnitude() < 2.0 * _LEAST
    alike = count[same].sum()
    angle = float(np.median(np.repeat(wrong.magnitude(), count)))
    return bool(alike >= 3 and alike > 0.7 * count.sum()), angle


def _lasts(t: Floats, q: Floats, turned: Floats, at: int, offset: Rotation) -> bool:
    """Whether poses a quarter of a second before and after a jump show it, too: a stamp that is wrong
    contradicts its neighbours only."""
    first = max(int(np.searchsorted(t, t[at] - _AROUND_S)), 0)
    last = min(int(np.searchsorted(t, t[at] + _AROUND_S)), len(t) - 1)
    if last <= at or first >= at - 1:
        return False
    total = Rotation.identity()
    for one in turned[first:last]:
        total = total * Rotation.from_rotvec(one)
    apart = float((total.inv() * to_scipy(q[first]).inv() * to_scipy(q[last])).magnitude())
    angle = float(offset.magnitude())
    return abs(apart - angle) < _LEAST + 0.2 * angle


def _angle(rotation: Rotation) -> Floats:
    return np.asarray(rotation.magnitude())


def without_wrong_truth(recording: Recording) -> Recording:
    """A run whose truth is not scored where it is flipped, or frozen while the IMU turns.

    The encoder's attitudes are judged as a tracker's poses are, against the gyroscope; the account has
    the reason.
    """
    truth, imu, account = recording.encoder, recording.imu, recording.intake.get("encoder")
    if truth is None or imu is None or account is None:
        return recording
    seen = np.flatnonzero(truth.valid)
    time_ns, q = truth.time_ns[seen] - truth.latency_ns, truth.q_ref_body[seen]
    reasons = {"frozen while the IMU moves": frozen(time_ns, q, imu)}
    flips = find_flips(time_ns, q, imu)
    if flips is not None and flips.wrong.mean() < 0.5:
        reasons["flipped against the gyroscope"] = flips.wrong & ~reasons[next(iter(reasons))]
    place = Place(recording.path or recording.name, account.numbers)
    valid = truth.valid.copy()
    for name, bad in reasons.items():
        rows = seen[bad]
        valid[rows] = False
        account = account.with_masked(name, reasoned(place, rows, truth.time_ns[rows]))
    if valid.all() or not valid.any() or (valid == truth.valid).all():
        return recording
    truth = replace(truth, valid=valid, scored=truth.scored & valid)
    return recording.replace(encoder=truth, intake={**recording.intake, "encoder": account})


def frozen(time_ns: Times, q: Floats, imu: Imu) -> Flags:
    """Attitudes (N,) that repeat the one before exactly, five times or more, while the IMU turns."""
    again = np.r_[False, (q[1:] == q[:-1]).all(axis=1)]
    edges = np.flatnonzero(np.diff(np.r_[False, again, False].astype(int)))
    found = np.zeros(len(q), bool)
    integral = Integral(imu.time_ns, imu.gyroscope)
    last = integral.t[-1]
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if end - begin < _REPEATS:
            continue
        t = np.clip((time_ns[[begin, end - 1]] - imu.time_ns[0]) / NANOSECONDS, 0.0, last)
        ends = np.linspace(t[0], t[1], 20)
        path = np.linalg.norm(integral.between(ends[:-1], ends[1:]), axis=1).sum()
        found[begin:end] = path > _FROZEN_TURN + _LARGEST_BIAS * (t[1] - t[0])
    return found
