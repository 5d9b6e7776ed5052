"""Gradient search compared with derivative-free searches: ``python benchmarks/searches.py [--quick]``.

Each search finds 18 numbers, the full 3 x 3 factors of the three noises of `loose`, from simulated runs
with noise that is correlated between axes; the start is wrong by factors of 3 to 10. The unit of work is
one evaluation of the objective; one with gradient counts by its measured time. Also times a complete tuning
of ten runs. Prints tables and, as the last line, JSON. ``--smoke`` has one short run, one objective and one
iteration.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

import jaxekf

jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
jaxekf.set_up()

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from clock import timed
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

import tuning
from jaxekf.estimation.parameters import as_arrays
from jaxekf.recordings.types import Recording, from_scipy, to_scipy
from jaxekf.simulation import attitude_runs
from tuning.search import evaluation

GYROSCOPE_DEG = np.array([[0.05, 0.0, 0.0], [0.03, 0.06, 0.0], [-0.02, 0.01, 0.03]])
"""Factor of the covariance of the gyroscope's white noise, deg/s/sqrt(Hz)."""
OPTICAL_DEG = np.array([[0.2, 0.0, 0.0], [0.15, 0.3, 0.0], [0.1, -0.1, 0.4]])
"""Factor of the tracker's covariance, deg."""
FACTORS = {"gyroscope": 10.0, "bias_walk": 3.0, "optical": 0.2}
"""Factors between start and truth of the standard deviations of each axis."""
SWEEPS = 20


def correlated(seed: int, duration_s: float) -> Recording:
    """Simulate a run with noise that is correlated between axes."""
    grade = attitude_runs.SensorGrade(gyroscope_deg=0.0, optical_deg=0.0)
    motion = attitude_runs.free_motion(seed, rest_s=0.5)
    hidden = [(t, t + 1.0) for t in np.arange(5.0, duration_s, 8.0)]
    run = attitude_runs.recording(
        f"run-{seed}", motion, seed=seed, duration_s=duration_s, grade=grade, occlusions=hidden
    )
    rng, imu, optical = np.random.default_rng([seed, 7]), run.need_imu(), run.need_optical()
    white = rng.standard_normal(imu.gyroscope.shape) @ np.deg2rad(GYROSCOPE_DEG).T
    turn = rng.standard_normal((len(optical.time_ns), 3)) @ np.deg2rad(OPTICAL_DEG).T
    q = np.where(optical.valid[:, None], optical.q_ref_body, [1.0, 0.0, 0.0, 0.0])
    return run.replace(
        imu=replace(imu, gyroscope=imu.gyroscope + white * np.sqrt(grade.imu_hz)),
        optical=replace(optical, q_ref_body=from_scipy(to_scipy(q) * Rotation.from_rotvec(turn))),
    )


def start_off(model: Any) -> Any:
    """The true standard deviations of each axis times `FACTORS`, without correlation."""
    each = {
        "gyroscope": np.sqrt(np.diag(GYROSCOPE_DEG @ GYROSCOPE_DEG.T)),
        "bias_walk": np.full(3, attitude_runs.SensorGrade().bias_walk_deg),
        "optical": np.sqrt(np.diag(OPTICAL_DEG @ OPTICAL_DEG.T)),
    }
    noise = {name: np.deg2rad(FACTORS[name] * value) for name, value in each.items()}
    base = as_arrays(model.parameters)
    return as_arrays(base._replace(noise=base.noise._replace(**noise)))


def ratio(model: Any, runs: Sequence[Recording], tuned: tuning.Tuned, seconds: float) -> float:
    """The time of the objective with its gradient, relative to that without."""
    aim = tuned.objective
    groups = tuning.objective.data.prepare_groups(model, runs, need_truth=aim.needs_truth)
    counts = evaluation.total_counts(groups, aim)
    given = model, aim, tuned.layout, np.asarray(tuned.layout.to_free(tuned.start)), tuned.start

    def over(function: Any) -> float:
        def all_groups() -> Any:
            return [function(*given, data, counts) for data in groups]

        return timed(all_groups, seconds=seconds).median_s

    return over(evaluation._value_and_gradient) / over(evaluation._value)


def race(
    runs: Sequence[Recording], objective: str, quick: bool, smoke: bool = False
) -> dict[str, Any]:
    """Run the three searches from the same start: work to reach the final value of coordinate search."""
    model = jaxekf.get_model("loose")
    given: dict[str, Any] = {"model": model, "objective": objective, "axes": "full"}
    given["start"] = start_off(model)
    sweeps = 1 if smoke else 3 if quick else SWEEPS
    coordinates = tuning.tune_by_coordinates(runs, sweeps=sweeps, **given)
    limit = 3 * coordinates.evaluations
    simplex = tuning.tune_by_nelder_mead(runs, evaluations=limit, **given)
    iterations, seconds = (1, 0.0) if smoke else (20, 1.0) if quick else (60, 5.0)
    tuned = tuning.tune(runs, iterations=iterations, rescale=False, **given)
    cost = ratio(model, runs, tuned, seconds)
    aim = coordinates.value
    steps = [i + 1 for i, step in enumerate(tuned.history) if step.training <= aim]
    lower = [step.evaluations for step in simplex.history if step.value <= aim]
    work = steps[0] * cost if steps else None
    return {
        "objective": objective,
        "start": coordinates.history[0].value,
        "gradient costs": cost,
        "work to reach coordinate search's end": {
            "coordinate search": coordinates.history[-1].evaluations,
            "Nelder-Mead": lower[0] if lower else None,
            "gradient": work,
        },
        "work in total": {
            "coordinate search": coordinates.evaluations,
            "Nelder-Mead": simplex.evaluations,
            "gradient": tuned.evaluations * cost,
        },
        "final value": {
            "coordinate search": coordinates.value,
            "Nelder-Mead": simplex.value,
            "gradient": tuned.best.training,
        },
        "gradient evaluations": tuned.evaluations,
        "stopped": tuned.stopped,
        "times fewer": coordinates.history[-1].evaluations / work if work else None,
    }


def show(found: dict[str, Any]) -> None:
    """Print the results of one objective as a table."""
    title = (
        f"{found['objective']}: {found['start']:.5g} at the start; value with gradient takes"
        f" {found['gradient costs']:.2f} times a value"
    )
    print(title)
    table = Table("", "work to reach", "work in total", "final value")
    for name, value in found["final value"].items():
        reach = found["work to reach coordinate search's end"][name]
        table.add_row(
            name,
            "–" if reach is None else f"{reach:.0f}",
            f"{found['work in total'][name]:.0f}",
            f"{value:.6g}",
        )
    Console(width=100).print(table)
    fewer = "–" if found["times fewer"] is None else f"{found['times fewer']:.1f}"
    print(f"times fewer: {fewer}; {found['stopped']}", flush=True)


def whole_tuning(count: int, duration_s: float, **how: Any) -> dict[str, Any]:
    """Time a tuning of noise and calibration, with compilation."""
    grade = attitude_runs.SensorGrade(imu_hz=200.0)
    matrix = np.array([[1.01, 0.004, -0.006], [-0.003, 0.99, 0.005], [0.002, -0.004, 1.005]])
    runs = []
    for seed in range(count):
        motion = attitude_runs.free_motion(seed, speed_deg=60.0)
        run = attitude_runs.recording(
            f"run-{seed}", motion, seed=seed, duration_s=duration_s, grade=grade
        )
        imu = run.need_imu()
        late = replace(
            imu,
            time_ns=imu.time_ns + 5_000_000,
            gyroscope=imu.gyroscope @ np.linalg.inv(matrix).T,
        )
        runs.append(run.replace(imu=late))
    free = ["noise", "calibration.clock_offset", "calibration.gyroscope_matrix"]
    times: list[float] = []
    begin = time.perf_counter()
    tuned = tuning.tune(
        runs, free=free, progress=lambda *_: times.append(time.perf_counter() - begin), **how
    )
    spent = time.perf_counter() - begin
    found = tuned.params.calibration
    return {
        "runs": count,
        "seconds each": duration_s,
        "s": spent,
        "s to the first iteration": times[0],
        "s an iteration": (times[-1] - times[0]) / max(len(times) - 1, 1),
        "evaluations": tuned.evaluations,
        "stopped": tuned.stopped,
        "objective": tuned.objective.describe(),
        "value": tuned.best.training,
        "clock offset, ms": 1e3 * float(found.clock_offset),
        "largest error of the matrix": float(np.abs(found.gyroscope_matrix - matrix).max()),
    }


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer and shorter runs and searches")
    parser.add_argument("--smoke", action="store_true", help="one iteration on one short run")
    arguments = parser.parse_args()
    quick, smoke = arguments.quick, arguments.smoke
    # First, so that its compilation is part of the time.
    size = (2, 6.0) if quick else (10, 60.0)
    if smoke:
        whole = [
            whole_tuning(1, 1.0, objective="map", optimiser=tuning.FisherScoring(), iterations=1)
        ]
    else:
        whole = [
            whole_tuning(*size, objective="map", optimiser=tuning.FisherScoring()),
            whole_tuning(*size),
        ]
    for one in whole:
        print(f"a whole tuning: {one}", flush=True)
    count, length = (1, 1.0) if smoke else (2, 6.0) if quick else (8, 40.0)
    runs = [correlated(seed, length) for seed in range(count)]
    races = []
    for objective in ("likelihood",) if smoke else ("attitude", "likelihood"):
        races.append(race(runs, objective, quick, smoke))
        show(races[-1])
    print(json.dumps({"whole tunings": whole, "races": races, "cores": os.cpu_count()}))


if __name__ == "__main__":
    main()
