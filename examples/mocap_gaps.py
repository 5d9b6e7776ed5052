"""Real motion capture with hidden intervals, over which a real IMU extrapolates.

    python examples/mocap_gaps.py DIR [--rooms 1 3 4] [--hide 0.5 1 2]

DIR has TUM-VI rooms or EuRoC folders with a pose stream. Intervals of poses are hidden in each recording.
At the end of each interval the hidden pose is compared with the estimate and with two other predictions:
the last pose held, and constant velocity. Real outliers of the motion capture are kept. The last line of
the output is JSON with the medians over all hidden intervals by length; the exit status is 1 if an expected
value is missed. `--smoke` hides one interval in a short piece of one recording, and nothing is checked.
"""

import argparse
import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

import jaxekf

jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
jaxekf.set_up()

import numpy as np
from recorded import parse, piece
from rich.progress import Progress
from scipy.spatial.transform import Rotation

from jaxekf.calibration import time_offset
from jaxekf.io.importers import asl
from jaxekf.models import loose_pose
from jaxekf.recordings.types import Flags, Floats, Times, to_scipy

SETTLE_S, BETWEEN_S = 8.0, 3.0
FIT_S, FIT_FRAMES = 0.05, 3
STEP_DEG, STEP_M = 1.0, 0.05
"""A step between frames is an outlier if its rotation differs from the gyroscope's by more than this, or if
it is longer than this."""
KNOWN_DEG = 0.3
"""An estimated alignment is used if its standard deviation is below this."""
METHODS = ("estimate", "hold last", "constant velocity")


class Gap(NamedTuple):
    """A hidden interval: indices of the last visible frame and of its last hidden frame."""

    before: int
    end: int


class Case(NamedTuple):
    """One recording with hidden intervals of one length."""

    name: str
    length_s: float
    gaps: list[Gap]
    original: jaxekf.Recording
    hidden: jaxekf.Recording


def parameters_of(recording: jaxekf.Recording) -> jaxekf.Parameters:
    """Noise of a small MEMS IMU and of motion capture, the same for all recordings, without tuning.

    Densities are several times those of data sheets, because the gyroscope's scale and the lever arm are
    not calibrated. Clock offset and alignment are estimated from the visible poses if these rotate enough.
    """
    params = loose_pose.MODEL.parameters
    noise = params.noise._replace(
        gyroscope=6e-4,
        accelerometer=1e-2,
        bias_walk=5e-5,
        accelerometer_walk=1e-3,
        position=1e-3,
        optical=np.deg2rad(0.2),
    )
    calibration = params.calibration
    try:
        found = time_offset.match(recording.need_optical(), recording.need_imu(), recording.name)
    except jaxekf.RecordingError as error:
        print(f"clock and alignment are those of the recording: {error}", file=sys.stderr)
    else:
        calibration = calibration._replace(latency=np.array(found.latency_s))
        if found.alignment_sigma.max() < np.deg2rad(KNOWN_DEG):
            calibration = calibration._replace(alignment=found.alignment)
    return params._replace(noise=noise, calibration=calibration)


def rotation_error_deg(recording: jaxekf.Recording) -> Floats:
    """Difference (N - 1,) in deg between the rotation of each step of the poses and the gyroscope's."""
    optical, imu = recording.need_optical(), recording.need_imu()
    taken = (optical.time_ns - optical.latency_ns - imu.time_ns[0]) / 1e9
    middle, span = 0.5 * (taken[1:] + taken[:-1]), np.diff(taken)
    known = (imu.time_ns - imu.time_ns[0]) / 1e9
    rate = np.stack([np.interp(middle, known, imu.gyroscope[:, i]) for i in range(3)], axis=1)
    turn = to_scipy(optical.q_ref_body)
    expected = Rotation.from_rotvec(rate * span[:, None])
    return np.rad2deg((expected.inv() * turn[:-1].inv() * turn[1:]).magnitude())


def good_frames(recording: jaxekf.Recording) -> Flags:
    """Flags (N,) of frames that agree with both neighbours and do not repeat one."""
    optical = recording.need_optical()
    assert optical.position is not None
    step_m = np.linalg.norm(np.diff(optical.position, axis=0), axis=1)
    frozen = (step_m == 0.0) & (np.diff(optical.q_ref_body, axis=0) == 0.0).all(axis=1)
    calm = (rotation_error_deg(recording) < STEP_DEG) & (step_m < STEP_M) & ~frozen
    good = optical.valid.copy()
    good[1:] &= calm
    good[:-1] &= calm
    return good


def hide(recording: jaxekf.Recording, length_s: float) -> Case:
    """Hide intervals of this length, with time between them for the filter to settle."""
    optical = recording.need_optical()
    good = good_frames(recording)
    t = optical.time_ns / 1e9
    valid, gaps = optical.valid.copy(), []
    driven = recording.need_imu().time_ns[[0, -1]] / 1e9
    start, last = max(t[0], driven[0]) + SETTLE_S, min(t[-1] - 0.5, driven[1])
    while start + length_s < last:
        inside = np.flatnonzero((t >= start) & (t <= start + length_s))
        before = int(inside[0]) - 1 if inside.size else 0
        whole = inside.size and good[inside[-1]] and good[max(0, before - 6) : before + 1].all()
        if whole and abs(t[inside[-1]] - t[before] - length_s) < 0.05:
            valid[inside] = False
            gaps.append(Gap(before, int(inside[-1])))
        start += length_s + BETWEEN_S
    changed = recording.replace(
        name=f"{recording.name}-{length_s:g}", optical=replace(optical, valid=valid)
    )
    return Case(recording.name, length_s, gaps, recording, changed)


def tracked_pose(
    made: jaxekf.Estimate, optical: jaxekf.Optical, at: Any
) -> tuple[Floats, Rotation]:
    """Estimated position of the tracked point and attitude of the tracked frame at these instants."""
    turn = to_scipy(made.attitude.value[at])
    point = np.zeros(3) if optical.p_body_tool is None else optical.p_body_tool
    frame = Rotation.from_rotvec(np.array(made.params.calibration.alignment))
    return made.outputs["position"].value[at] + turn.apply(point), turn * frame


def predictions(case: Case, made: jaxekf.Estimate, gap: Gap) -> dict[str, tuple[Floats, Rotation]]:
    """Position of the tracked point and attitude at the end of an interval, by each method."""
    optical = case.original.need_optical()
    assert optical.position is not None
    at = int(np.searchsorted(made.time_ns, optical.time_ns[gap.end] - optical.latency_ns))
    found = {"estimate": tracked_pose(made, optical, at)}
    last = optical.position[gap.before], to_scipy(optical.q_ref_body[gap.before])
    found["hold last"] = last
    t = (optical.time_ns - optical.time_ns[gap.before]) / 1e9
    back = max(FIT_S, (FIT_FRAMES - 0.5) * float(np.median(np.diff(t))))
    chosen = np.flatnonzero((t >= -back) & (t <= 0.0) & optical.valid)
    speed = np.polyfit(t[chosen], optical.position[chosen], 1)[0]
    vectors = (last[1].inv() * to_scipy(optical.q_ref_body[chosen])).as_rotvec()
    rate = np.polyfit(t[chosen], vectors, 1)[0]
    span = t[gap.end]
    found["constant velocity"] = (
        last[0] + speed * span,
        last[1] * Rotation.from_rotvec(rate * span),
    )
    return found


def score(case: Case, made: jaxekf.Estimate) -> dict[str, list[tuple[float, float]]]:
    """Position (mm) and attitude (deg) errors of each method, one for each interval."""
    optical = case.original.need_optical()
    assert optical.position is not None
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in METHODS}
    for gap in case.gaps:
        true = to_scipy(optical.q_ref_body[gap.end])
        for name, (position, turn) in predictions(case, made, gap).items():
            off = 1e3 * float(np.linalg.norm(position - optical.position[gap.end]))
            errors[name].append((off, float(np.rad2deg((turn.inv() * true).magnitude()))))
    return errors


def outliers(recording: jaxekf.Recording, made: jaxekf.Estimate) -> dict[str, Any]:
    """Motion-capture outliers in a recording without hidden intervals, and errors of the estimate."""
    optical = recording.need_optical()
    assert optical.position is not None
    good = good_frames(recording)
    at = _nearest(made.time_ns, optical.time_ns - optical.latency_ns)
    inside = (optical.time_ns >= made.time_ns[0] + int(1e9)) & (optical.time_ns <= made.time_ns[-1])
    point, turn = tracked_pose(made, optical, at)
    off = point - optical.position
    angle = np.rad2deg((turn.inv() * to_scipy(optical.q_ref_body)).magnitude())
    scored = good & inside
    seen = optical.valid & inside
    both = seen[1:] & seen[:-1]
    record = made.sensors["optical"]
    return {
        "outlier_steps": int((rotation_error_deg(recording) > STEP_DEG)[both].sum()),
        "refused": int(record.gated.any(axis=1).sum()),
        "frames": len(record.time_ns),
        "median_deg": float(np.median(angle[scored])),
        "median_mm": 1e3 * float(np.median(np.linalg.norm(off[scored], axis=1))),
        "largest_deg_1_in_100": float(np.quantile(angle[scored], 0.99)),
        "largest_deg_1_in_1000": float(np.quantile(angle[scored], 0.999)),
        "largest_mm_1_in_1000": 1e3
        * float(np.quantile(np.linalg.norm(off[scored], axis=1), 0.999)),
        "median_deg_at_the_end": float(np.median(angle[np.flatnonzero(scored)[-100:]])),
    }


def _nearest(times: Times, wanted: Times) -> Any:
    return np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)


def chosen_recordings(folder: Path, rooms: list[str] | None) -> list[jaxekf.Recording]:
    """The recordings of a folder, or those of the named rooms. One that cannot be read is left out with a
    message; if none is left, the script ends."""
    found = asl.find(folder)
    if not found:
        sys.exit(
            f"{folder}: got no recording in the ASL layout, expected TUM-VI rooms or EuRoC folders"
        )
    if rooms:
        named = [(re.search(r"room_?(\d+)", path.resolve().as_posix()), path) for path in found]
        there = {int(match[1]) for match, _ in named if match}
        if missing := [room for room in rooms if not room.isdecimal() or int(room) not in there]:
            sys.exit(f"{folder}: got no room {', '.join(missing)}, expected one of {sorted(there)}")
        wanted = {int(room) for room in rooms}
        found = [path for match, path in named if match and int(match[1]) in wanted]
    readable = []
    for path in found:
        try:
            readable.append(asl.load(path))
        except jaxekf.RecordingError as error:
            print(f"left out: {error}", file=sys.stderr)
    if not readable:
        sys.exit(
            f"{folder}: got no recording that can be read, expected one; see the messages above"
        )
    return readable


def medians(errors: list[tuple[float, float]]) -> dict[str, float]:
    """Median position and attitude error."""
    position, attitude = np.median(np.array(errors), axis=0)
    return {"mm": float(position), "deg": float(attitude)}


def label(recording: jaxekf.Recording, taken: dict[str, Any]) -> str:
    """A unique name for the recording."""
    if recording.name not in taken:
        return recording.name
    return f"{recording.name} {len(taken) + 1}"


def checks_of(table: dict[str, Any], outlying: dict[str, Any]) -> dict[str, bool]:
    """The checks of the expected values."""
    checks = {}
    if "1" in table:
        one = table["1"]
        checks["attitude after 1 s: at most 0.5 deg"] = one["estimate"]["deg"] <= 0.5
        checks["attitude after 1 s: at most 0.1 of holding the last"] = (
            one["estimate"]["deg"] <= 0.1 * one["hold last"]["deg"]
        )
    if "0.5" in table:
        half = table["0.5"]
        checks["position after 0.5 s: at most 0.2 of constant velocity"] = (
            half["estimate"]["mm"] <= 0.2 * half["constant velocity"]["mm"]
        )
    for name, found in outlying.items():
        # A diverged filter is wrong for many frames, an outlier of the motion capture for one.
        checks[f"{name}: outliers do not make it diverge"] = (
            found["largest_deg_1_in_100"] < 2.0
            and found["median_deg_at_the_end"] < 1.0
            and found["median_mm"] < 20.0
        )
    return checks


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rooms", nargs="+", metavar="N", help="numbers of TUM-VI rooms")
    parser.add_argument(
        "--hide",
        nargs="+",
        type=float,
        default=[0.5, 1.0, 2.0],
        metavar="SECONDS",
        help="lengths of the hidden intervals, s (0.5 1 2)",
    )
    arguments = parse(parser, "tumvi")
    if arguments.smoke:
        arguments.rooms, arguments.hide = ["4"], [0.5]
    recordings = chosen_recordings(arguments.folder, arguments.rooms)
    if arguments.smoke:
        recordings = [piece(recordings[0], 20.0, SETTLE_S + 3.0)]
    table: dict[str, dict[str, list[Any]]] = {}
    outlying, failed = {}, []
    with Progress(transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("recordings", total=len(recordings))
        for recording in recordings:
            cases = [hide(recording, length) for length in arguments.hide]
            runs = [recording, *(case.hidden for case in cases)]
            try:
                whole, *found = [
                    jaxekf.estimate(run, "loose_pose", parameters_of(run), clock="tracker")
                    for run in runs
                ]
            except jaxekf.JaxekfError as error:
                print(f"left out: {error}", file=sys.stderr)
                failed.append(recording.name)
                continue
            outlying[label(recording, outlying)] = outliers(recording, whole)
            for case, made in zip(cases, found, strict=True):
                by_method = table.setdefault(f"{case.length_s:g}", {name: [] for name in METHODS})
                for name, errors in score(case, made).items():
                    by_method[name] += errors
            progress.advance(task)
    summary: dict[str, Any] = {}
    for length, methods in table.items():
        if methods["estimate"]:
            summary[length] = {name: medians(errors) for name, errors in methods.items()}
            summary[length]["stretches"] = len(methods["estimate"])
    print(f"{'hidden':>8}{'intervals':>11}  " + "".join(f"{name:>28}" for name in METHODS))
    for length, row in summary.items():
        cells = "".join(f"{row[n]['mm']:>16.1f} mm{row[n]['deg']:>6.2f}°  " for n in METHODS)
        print(f"{length + ' s':>8}{row['stretches']:>11}  {cells}")
    for name, found in outlying.items():
        print(f"{name}: {found}")
    checks = checks_of(summary, outlying)
    for length in table.keys() - summary.keys():
        checks[f"an interval of {length} s to hide"] = False
    checks |= {f"{name}: can be estimated": False for name in failed}
    for text, passed in checks.items():
        print(f"{'ok    ' if passed else 'MISSED'} {text}")
    print(json.dumps({"median": summary, "outliers": outlying, "checks": checks}))
    sys.exit(0 if arguments.smoke or all(checks.values()) else 1)


if __name__ == "__main__":
    main()
