"""Real motion capture with stretches hidden, carried on through them by the real IMU.

    python examples/mocap_gaps.py DIR [--rooms 1 3 4] [--hide 0.5 1 2]

DIR holds TUM-VI rooms or EuRoC folders with a pose stream. From each recording stretches of poses are
hidden; at the end of each the estimate is compared with the pose that was hidden there, beside holding the
last pose and going on with its velocity. Real outliers of the motion capture stay in. The last line is
JSON: medians over all hidden stretches, by length; the exit status is 1 where a figure is missed.
`--smoke` hides one stretch in a short piece of one recording, and nothing is asserted.
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
from jaxekf.estimation.parameters import as_arrays
from jaxekf.io.importers import asl
from jaxekf.models import loose_pose
from jaxekf.recordings.types import Flags, Floats, Optical, Times, to_scipy

SETTLE_S, BETWEEN_S = 8.0, 3.0
FIT_S, FIT_FRAMES = 0.05, 3
STEP_DEG, STEP_M = 1.0, 0.05
"""A step from one frame to the next that differs by more from the gyroscope's, or is longer, is an
outlier."""
KNOWN_DEG = 0.3
"""An alignment is corrected where it is known better than this."""
METHODS = ("estimate", "hold last", "constant velocity")


class Gap(NamedTuple):
    """A hidden stretch: its last visible frame and the hidden frame at its end."""

    before: int
    end: int


class Case(NamedTuple):
    """One recording with one length of stretches hidden."""

    name: str
    length_s: float
    gaps: list[Gap]
    original: jaxekf.Recording
    hidden: jaxekf.Recording


def parameters_of(recording: jaxekf.Recording) -> jaxekf.Parameters:
    """Noise of a small MEMS IMU and of motion capture, the same for all: none of it is tuned to a room.

    Densities are several times a data sheet's: the gyroscope's scale and the lever arm are not calibrated
    here. Clock and alignment are, from the poses that can be seen, where they turn enough to tell.
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
        print(f"clock and alignment are taken as stated: {error}", file=sys.stderr)
    else:
        calibration = calibration._replace(latency=np.array(found.latency_s))
        if found.alignment_sigma.max() < np.deg2rad(KNOWN_DEG):
            calibration = calibration._replace(alignment=found.alignment)
    return as_arrays(params._replace(noise=noise, calibration=calibration))


def turning_off(recording: jaxekf.Recording) -> Floats:
    """Degrees by which each step of the poses differs from the gyroscope's, (N - 1,)."""
    optical, imu = recording.need_optical(), recording.need_imu()
    taken = (optical.time_ns - optical.latency_ns - imu.time_ns[0]) / 1e9
    middle, span = 0.5 * (taken[1:] + taken[:-1]), np.diff(taken)
    known = (imu.time_ns - imu.time_ns[0]) / 1e9
    rate = np.stack([np.interp(middle, known, imu.gyroscope[:, i]) for i in range(3)], axis=1)
    turn = to_scipy(optical.q_ref_body)
    expected = Rotation.from_rotvec(rate * span[:, None])
    return np.rad2deg((expected.inv() * turn[:-1].inv() * turn[1:]).magnitude())


def good_frames(recording: jaxekf.Recording) -> Flags:
    """Frames that agree with both neighbours and do not repeat one: where the motion capture can be
    believed."""
    optical = recording.need_optical()
    assert optical.position is not None
    step_m = np.linalg.norm(np.diff(optical.position, axis=0), axis=1)
    frozen = (step_m == 0.0) & (np.diff(optical.q_ref_body, axis=0) == 0.0).all(axis=1)
    calm = (turning_off(recording) < STEP_DEG) & (step_m < STEP_M) & ~frozen
    good = optical.valid.copy()
    good[1:] &= calm
    good[:-1] &= calm
    return good


def hide(recording: jaxekf.Recording, length_s: float) -> Case:
    """Stretches of the length hidden one after the other, with time between them to settle."""
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


def tracked_pose(made: jaxekf.Estimate, optical: Optical, at: Any) -> tuple[Floats, Rotation]:
    """What the motion capture should have said at these instants: its point, and its own frame."""
    turn = to_scipy(made.attitude.value[at])
    point = np.zeros(3) if optical.p_body_tool is None else optical.p_body_tool
    frame = Rotation.from_rotvec(np.array(made.params.calibration.alignment))
    return made.outputs["position"].value[at] + turn.apply(point), turn * frame


def predictions(case: Case, made: jaxekf.Estimate, gap: Gap) -> dict[str, tuple[Floats, Rotation]]:
    """Position of the tracked point and attitude at the end of a stretch, by each method."""
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
    """Position (mm) and attitude (deg) errors of each method, one for each stretch."""
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
    """What became of the motion capture's own outliers, where nothing was hidden."""
    optical = recording.need_optical()
    assert optical.position is not None
    good = good_frames(recording)
    at = _nearest(made.time_ns, optical.time_ns - optical.latency_ns)
    inside = (optical.time_ns >= made.time_ns[0] + int(1e9)) & (optical.time_ns <= made.time_ns[-1])
    point, turn = tracked_pose(made, optical, at)
    off = point - optical.position
    angle = np.rad2deg((turn.inv() * to_scipy(optical.q_ref_body)).magnitude())
    judged = good & inside
    seen = optical.valid & inside
    both = seen[1:] & seen[:-1]
    record = made.sensors["optical"]
    return {
        "outlier_steps": int((turning_off(recording) > STEP_DEG)[both].sum()),
        "refused": int(record.gated.any(axis=1).sum()),
        "frames": len(record.time_ns),
        "median_deg": float(np.median(angle[judged])),
        "median_mm": 1e3 * float(np.median(np.linalg.norm(off[judged], axis=1))),
        "largest_deg_1_in_100": float(np.quantile(angle[judged], 0.99)),
        "largest_deg_1_in_1000": float(np.quantile(angle[judged], 0.999)),
        "largest_mm_1_in_1000": 1e3
        * float(np.quantile(np.linalg.norm(off[judged], axis=1), 0.999)),
        "median_deg_at_the_end": float(np.median(angle[np.flatnonzero(judged)[-100:]])),
    }


def _nearest(times: Times, asked: Times) -> Any:
    return np.clip(np.searchsorted(times, asked), 0, len(times) - 1)


def chosen_recordings(folder: Path, rooms: list[str] | None) -> list[jaxekf.Recording]:
    """The recordings of a folder, only the rooms named where there are any; one that cannot be read is
    left out with a sentence, unless none is left."""
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
            f"{folder}: got no recording that can be read, expected one; mend what is said above"
        )
    return readable


def medians(errors: list[tuple[float, float]]) -> dict[str, float]:
    """Median position and attitude error."""
    position, attitude = np.median(np.array(errors), axis=0)
    return {"mm": float(position), "deg": float(attitude)}


def label(recording: jaxekf.Recording, taken: dict[str, Any]) -> str:
    """A name for the recording that no other has."""
    if recording.name not in taken:
        return recording.name
    return f"{recording.name} {len(taken) + 1}"


def checks_of(table: dict[str, Any], outlying: dict[str, Any]) -> dict[str, bool]:
    """Each figure that must hold."""
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
        # A filter astray stays so for many frames; a single one of motion capture's may be wrong.
        checks[f"{name}: outliers do not make it diverge"] = (
            found["largest_deg_1_in_100"] < 2.0
            and found["median_deg_at_the_end"] < 1.0
            and found["median_mm"] < 20.0
        )
    return checks


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rooms", nargs="+", metavar="N", help="numbers of TUM-VI rooms")
    parser.add_argument("--hide", nargs="+", type=float, default=[0.5, 1.0, 2.0], metavar="SECONDS")
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
                    jaxekf.estimate(run, "loose_pose", parameters_of(run)) for run in runs
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
    print(f"{'hidden':>8}{'stretches':>11}  " + "".join(f"{name:>28}" for name in METHODS))
    for length, row in summary.items():
        cells = "".join(f"{row[n]['mm']:>16.1f} mm{row[n]['deg']:>6.2f}°  " for n in METHODS)
        print(f"{length + ' s':>8}{row['stretches']:>11}  {cells}")
    for name, found in outlying.items():
        print(f"{name}: {found}")
    checks = checks_of(summary, outlying)
    for length in table.keys() - summary.keys():
        checks[f"a stretch of {length} s to hide"] = False
    checks |= {f"{name}: can be estimated": False for name in failed}
    for text, passed in checks.items():
        print(f"{'ok    ' if passed else 'MISSED'} {text}")
    print(json.dumps({"median": summary, "outliers": outlying, "checks": checks}))
    sys.exit(0 if arguments.smoke or all(checks.values()) else 1)


if __name__ == "__main__":
    main()
