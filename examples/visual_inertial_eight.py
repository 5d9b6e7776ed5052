"""A camera and an IMU that move along a figure eight in front of a scene (Hol 2008).

    python examples/visual_inertial_eight.py [--seeds 20] [--figure eight.png] [--smoke]

The errors of the fused estimate are compared with those of the pose of each image alone (PnP), at 25, 12.5,
6 and 3 images per second. Then the drift in two seconds without images is evaluated, with the true gravity
vector in the scene, with the one estimated from images and accelerometer, and with one that is 1 deg off.
The figure shows the path, the drift, and the search regions of the landmarks in the image after it. The
last line of the output is JSON; the exit status is 1 if images alone are better at some rate. With --smoke
one run at one rate is estimated, without drift and figure, and nothing is checked.
"""

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

import jaxekf

jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
jaxekf.set_up()

import numpy as np
from matplotlib.patches import Ellipse
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial.transform import Rotation

from jaxekf.models import search_regions
from jaxekf.pose_solvers import pnp
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import Floats, Times, to_scipy
from jaxekf.reporting.plots import style
from jaxekf.simulation.camera_runs import IMAGE, CameraGrade, camera_recording

RATES_HZ = (25.0, 12.5, 6.0, 3.0)
SECONDS, SETTLED_S = 10.8, 2.0
BLIND = (6.0, 8.0)
DRIFT_S = (0.5, 1.0, 1.5, 2.0)
CONSOLE = Console(stderr=True)


class Errors(NamedTuple):
    """Squared errors at some instants."""

    position: Floats
    """(N,) m^2."""
    attitude: Floats
    """(N,) rad^2."""


def errors(time_ns: Times, position: Floats, q: Floats, run: jaxekf.Recording) -> Errors:
    """Squared errors of poses at these instants."""
    at = encoder_at(run.need_encoder(), time_ns)
    assert at.position is not None
    turn = to_scipy(at.q_ref_body).inv() * to_scipy(q)
    return Errors(np.sum((position - at.position) ** 2, axis=1), turn.magnitude() ** 2)


def joined(found: list[Errors]) -> Errors:
    """The errors of all runs in one."""
    return Errors(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def rms(found: Errors) -> tuple[float, float]:
    """RMS of position in mm and of attitude in deg."""
    position, attitude = (float(np.sqrt(np.mean(part))) for part in found)
    return 1e3 * position, float(np.rad2deg(attitude))


def runs_at(rate_hz: float, seeds: int, **changes: Any) -> list[jaxekf.Recording]:
    """Simulate one run for each seed."""
    grade = CameraGrade(camera_hz=rate_hz)
    return [
        camera_recording(f"eight-{seed}", seed=seed, duration_s=SECONDS, grade=grade, **changes)
        for seed in range(seeds)
    ]


def compared(runs: list[jaxekf.Recording]) -> tuple[dict[str, tuple[float, float]], list[Any]]:
    """RMSE of the fused estimate and of images alone, at images after `SETTLED_S`; and the estimates."""
    made = jaxekf.estimate_many(runs, "visual")
    fused, alone = [], []
    for run, one in zip(runs, made, strict=True):
        camera = run.need_camera()
        raw = pnp.poses(camera)
        settled = camera.time_ns >= camera.time_ns[0] + int(SETTLED_S * 1e9)
        chosen = raw.valid & settled & (camera.time_ns <= one.time_ns[-1])
        at = camera.time_ns[chosen]
        alone.append(errors(at, raw.position[chosen], raw.q_ref_body[chosen], run))
        here = np.searchsorted(one.time_ns, at)
        position, q = one.outputs["position"].value[here], one.attitude.value[here]
        fused.append(errors(at, position, q, run))
    return {"fused": rms(joined(fused)), "images alone": rms(joined(alone))}, made


def drift(runs: list[jaxekf.Recording]) -> tuple[dict[str, tuple[float, float]], list[Any]]:
    """RMSE at each time in `DRIFT_S` after the last image; and the estimates."""
    made = jaxekf.estimate_many(runs, "visual")
    found = {}
    for after in DRIFT_S:
        each = []
        for run, one in zip(runs, made, strict=True):
            camera = run.need_camera()
            last = camera.time_ns[camera.usable.any(axis=1)]
            last = last[last < last[0] + int(BLIND[0] * 1e9)][-1]
            here = [int(np.searchsorted(one.time_ns, last + int(after * 1e9)))]
            position, q = one.outputs["position"].value[here], one.attitude.value[here]
            each.append(errors(one.time_ns[here], position, q, run))
        found[f"{after:g}"] = rms(joined(each))
    return found, made


def with_gravity(runs: list[jaxekf.Recording], turn: Rotation | None) -> list[jaxekf.Recording]:
    """The runs with a rotated gravity vector; with None without one, so that it is estimated."""
    changed = []
    for run in runs:
        info = dict(run.info)
        stated = info.pop("gravity_ref")
        if turn is not None:
            info["gravity_ref"] = turn.apply(stated).tolist()
        changed.append(run.replace(info=info))
    return changed


def searched(run: jaxekf.Recording) -> tuple[search_regions.Regions, Floats]:
    """The search regions of the landmarks in the first image after the gap, and their pixels (M, 2)."""
    camera = run.need_camera()
    image = int(np.searchsorted(camera.time_ns, camera.time_ns[0] + int(BLIND[1] * 1e9)))
    hidden = camera.visible.copy()
    hidden[image:] = False
    one = jaxekf.estimate(run.replace(camera=replace(camera, visible=hidden)), "visual")
    there = int(np.searchsorted(one.time_ns, camera.time_ns[image]))
    ahead = jaxekf.Belief(jax.tree.map(lambda a: a[there], one.state), one.cov[there])
    seen = camera.usable[image]
    found = search_regions.search_regions(one.params, ahead, camera.p_ref_landmark[seen])
    return found, camera.pixel[image, seen]


def draw_searched(axes: Any, run: jaxekf.Recording) -> None:
    """Draw the image after the gap: landmarks, and the ellipses of their search regions."""
    found, pixel = searched(run)
    half, angle = search_regions.ellipses(found)
    for centre, axis, turn in zip(np.asarray(found.pixel), half, angle, strict=True):
        ellipse = Ellipse(centre, *(2.0 * axis), angle=np.rad2deg(turn))
        ellipse.set(fill=False, edgecolor=style.ESTIMATE, lw=1.0)
        axes.add_patch(ellipse)
    axes.plot([], [], color=style.ESTIMATE, lw=1.0, label="99 % search region")
    axes.plot(*pixel.T, ".", color=style.MEASURED, ms=4, label="landmark")
    axes.set(
        xlim=(0, IMAGE[0]), ylim=(IMAGE[1], 0), aspect="equal", xlabel="u (px)", ylabel="v (px)"
    )
    axes.set(title="first image after the gap")
    axes.legend(fontsize=8, loc="lower left")


def figure(run: jaxekf.Recording, one: Any) -> Any:
    """A figure of the path, of the error of the height over time, and of the image after the gap."""
    drawn, axes = style.new_grid(1, 3, (15.0, 4.2))
    path, over, image = axes[0]
    draw_searched(image, run)
    at = encoder_at(run.need_encoder(), one.time_ns)
    raw = pnp.poses(run.need_camera())
    place, sigma = one.outputs["position"].value, one.outputs["position"].sigma
    assert at.position is not None
    path.plot(
        *raw.position[raw.valid, 1::-1].T,
        ".",
        color=style.MEASURED,
        ms=4,
        label="images alone",
    )
    path.plot(*at.position[:, 1::-1].T, color=style.TRUTH, lw=1.0, label="truth")
    path.plot(*place[:, 1::-1].T, color=style.ESTIMATE, lw=1.0, label="fused")
    path.legend(fontsize=8, loc="upper center")
    path.set(xlabel="y (m)", ylabel="x, up (m)", title="path", aspect="equal")
    seconds = (run.need_camera().time_ns - one.time_ns[0]) / 1e9
    truth = at.position[:, 0]
    style.band(over, one.time, 1e3 * (place[:, 0] - truth), 1e3 * sigma[:, 0], "2σ of the estimate")
    over.plot(one.time, 1e3 * (place[:, 0] - truth), color=style.ESTIMATE, lw=1.0, label="fused")
    here = np.clip(np.searchsorted(one.time_ns, run.need_camera().time_ns), 0, len(truth) - 1)
    off = 1e3 * (raw.position[:, 0] - truth[here])
    over.plot(
        seconds[raw.valid], off[raw.valid], ".", color=style.MEASURED, ms=4, label="images alone"
    )
    begin, end = BLIND
    over.axvspan(begin, end, color=style.HIDDEN, alpha=0.6, lw=0, label="no images")
    over.set(xlabel="time (s)", ylabel="error of x, up (mm)", title="two seconds without images")
    over.set_ylim(-150.0, 150.0)
    over.legend(ncols=2, fontsize=8)
    return drawn


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20, help="number of seeds (20)")
    parser.add_argument("--figure", type=Path, default=Path("eight.png"), help="figure (eight.png)")
    parser.add_argument("--smoke", action="store_true", help="one run at one rate")
    return parser.parse_args()


def drifts(seeds: int, file: Path) -> dict[str, dict[str, tuple[float, float]]]:
    """The drift without images for each gravity vector; writes the figure of the first run."""
    runs = runs_at(12.5, seeds, blind=(BLIND,))
    drifted = {}
    drifted["true"], made = drift(runs)
    drifted["estimated"], _ = drift(with_gravity(runs, None))
    off = Rotation.from_rotvec(np.deg2rad([0.0, 1.0, 0.0]))
    drifted["1 deg off"], _ = drift(with_gravity(runs, off))
    style.save(figure(runs[0], made[0]), file)
    return drifted


def main() -> None:
    arguments = parse_arguments()
    began = time.perf_counter()
    found = {}
    if arguments.smoke:
        arguments.seeds = 1
    rates = (12.5,) if arguments.smoke else RATES_HZ
    for rate in track(rates, "image rates", console=CONSOLE, transient=True):
        found[f"{rate:g}"] = compared(runs_at(rate, arguments.seeds))[0]
    drifted = {} if arguments.smoke else drifts(arguments.seeds, arguments.figure)
    console = Console()
    table = Table("images per second", "fused", "images alone", title="RMSE, mm and deg")
    for rate, both in found.items():
        table.add_row(rate, *(f"{mm:.1f} mm, {deg:.3f} deg" for mm, deg in both.values()))
    console.print(table)
    table = Table(
        "seconds without images",
        *(f"gravity {name}" for name in drifted),
        title="drift, RMS, mm and deg",
    )
    for after in next(iter(drifted.values()), ()):
        both = [column[after] for column in drifted.values()]
        table.add_row(after, *(f"{mm:.1f} mm, {deg:.3f} deg" for mm, deg in both))
    console.print(table)
    better = all(
        fused < alone
        for both in found.values()
        for fused, alone in zip(both["fused"], both["images alone"], strict=True)
    )
    print(
        json.dumps(
            {
                "seeds": arguments.seeds,
                "rmse_mm_deg": found,
                "drift_mm_deg": drifted,
                "fused_is_better": better,
                "seconds": round(time.perf_counter() - began, 1),
            }
        )
    )
    sys.exit(0 if arguments.smoke or better else 1)


if __name__ == "__main__":
    main()
