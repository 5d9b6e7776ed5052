"""Orientation from gyroscope, accelerometer and magnetometer of BROAD trials, compared with other filters.

    python examples/broad_orientation.py DIR --train 01 05 10 16 28 32 --test 02 07 12 24 35

DIR is the folder of BROAD's MATLAB files. The model `marg` is tuned by gradient on the training trials,
with their motion capture as truth; it then estimates the test trials, filtered and smoothed. It is
compared with VQF and its offline form, and with Madgwick's and Mahony's filters (from `ahrs`, with gains
tuned on the training trials):

    pip install "jaxekf[bench]"

The errors are those of BROAD: RMS over the samples of `movement` of the total angle between estimate and
truth, of its rotation about the vertical (heading) and of the remaining rotation (inclination); no heading
offset is removed. The reference frame of Madgwick's filter in `ahrs` is north, west, up, that of the others
east, north, up. The last line of the output is JSON with the means over the test trials and the error of
each trial. Filters that are not installed are left out. `--smoke` filters a short piece of one trial with
the default noise.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.util import find_spec
from multiprocessing import get_context
from typing import Any, NamedTuple

# Compilation takes a third of the time with this setting, and the filter runs only for seconds.
os.environ.setdefault("JAXEKF_COMPILE", "quick")

import jax

import jaxekf

jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
jaxekf.set_up()

from importlib import import_module

import numpy as np
from recorded import parse, piece
from rich.console import Console
from rich.progress import track
from rich.table import Table

import tuning
from jaxekf.calibration import time_offset
from jaxekf.evaluation.metrics import OrientationError, orientation_error
from jaxekf.io.importers import broad
from jaxekf.models import marg
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import Floats, Times, to_scipy
from tuning.objective.data import prepare_groups
from tuning.objective.objectives import visible_rows

ITERATIONS = 12
CONSOLE = Console(stderr=True)
COARSE = 6
"""Samples of a training trial that are averaged to one: less work, and noise densities do not depend on the
sample rate."""
DOUBT = 0.7
"""Prior standard deviation of the logarithm of each density: a factor of two about the default."""
INDEPENDENT = 10
"""Effective number of independent errors in the training trials, since heading errors last for minutes. It
determines the weight of the prior, which prevents overfitting to these trials."""
MADGWICK = (0.01, 0.02, 0.05, 0.1, 0.2)
MAHONY = (0.05, 0.1, 0.25, 0.5, 1.0)
SHARES = (0.001, 0.03, 0.3)
"""Mahony's integral gains relative to the proportional ones; the package does not accept 0."""
NORTH_WEST_UP = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""Rotation from north, west, up to east, north, up."""


class Gains(NamedTuple):
    """Gains of a filter of `ahrs`."""

    kind: str
    proportional: float
    integral: float = 0.0


# ---------------------------------------------------------------------------------------------
# This package


def coarse(trial: jaxekf.Recording) -> jaxekf.Recording:
    """A trial with the IMU averaged over `COARSE` samples; the magnetic field is the middle sample."""
    imu = trial.need_imu()
    count = len(imu.time_ns) // COARSE
    middle = np.arange(count) * COARSE + COARSE // 2

    def mean(values: Floats | None) -> Floats | None:
        if values is None:
            return None
        return values[: count * COARSE].reshape(count, COARSE, 3).mean(axis=1)

    gyroscope = mean(imu.gyroscope)
    assert gyroscope is not None and imu.magnetometer is not None
    field = imu.magnetometer[middle]
    return trial.replace(
        imu=jaxekf.Imu(imu.time_ns[middle], gyroscope, mean(imu.accelerometer), field)
    )


def start_for(trials: Sequence[jaxekf.Recording]) -> jaxekf.Parameters:
    """The default parameters, with the clock offset between motion capture and gyroscope of the trials."""
    lags = [time_offset.match(t.need_optical(), t.need_imu(), t.name).latency_s for t in trials]
    calibration = marg.DEFAULTS.calibration._replace(clock_offset=np.array(-np.median(lags)))
    return marg.DEFAULTS._replace(calibration=calibration)


def tuned_on(trials: Sequence[jaxekf.Recording], iterations: int) -> tuning.Tuned:
    """Noise with the least attitude error of the filter, with a prior about the defaults."""
    learning = [coarse(trial) for trial in trials]
    # The objective weighs the prior by a number of rows.
    rows = sum(int(visible_rows(data)) for data in prepare_groups(marg.MODEL, learning))
    objective = tuning.Objective((("attitude", 1.0),), prior=rows / INDEPENDENT)

    def progress(step: tuning.Iteration, total: int) -> None:
        if sys.stderr.isatty():
            print(
                f"\r  step {step.number + 1}/{total}: {step.training:.4f}", end="", file=sys.stderr
            )

    return tuning.tune(
        learning,
        model=marg.MODEL,
        start=start_for(trials),
        objective=objective,
        free=[tuning.Free("noise", prior=DOUBT)],
        iterations=iterations,
        progress=progress,
    )


# ---------------------------------------------------------------------------------------------
# Other filters


def vqf(imu: jaxekf.Imu, *, offline: bool) -> Floats:
    """Quaternions (N, 4) of VQF (Laidig and Seel 2023) with default parameters, filtered or offline."""
    package = import_module("vqf")
    streams = [
        np.ascontiguousarray(a) for a in (imu.gyroscope, imu.accelerometer, imu.magnetometer)
    ]
    period = float(np.mean(np.diff(imu.time_ns))) * 1e-9
    if offline:
        return package.offlineVQF(*streams, period)["quat9D"]
    return package.VQF(period).updateBatch(*streams)["quat9D"]


def start_of(trial: jaxekf.Recording) -> Floats:
    """Initial attitude (4,) of this package's filter, used for all filters."""
    found = marg.find_start(trial, {"magnetometer": marg.magnetometer(trial)})
    assert found is not None
    return np.asarray(found.first["q_ref_body"])


def by_ahrs(gains: Gains, imu: jaxekf.Imu, start: Floats) -> Floats:
    """Quaternions (N, 4), to east, north, up, of a filter of `ahrs` with the initial attitude (4,)."""
    filters = import_module("ahrs.filters")
    rate = 1e9 / float(np.mean(np.diff(imu.time_ns)))
    if gains.kind == "madgwick":
        made = filters.Madgwick(frequency=rate, gain=gains.proportional)
        q = product(NORTH_WEST_UP * np.array([1.0, 1.0, 1.0, -1.0]), start)
    else:
        made = filters.Mahony(frequency=rate, k_P=gains.proportional, k_I=gains.integral)
        q = start
    found = np.empty((len(imu.time_ns), 4))
    assert imu.accelerometer is not None and imu.magnetometer is not None
    for i, sample in enumerate(
        zip(imu.gyroscope, imu.accelerometer, imu.magnetometer, strict=True)
    ):
        q = made.updateMARG(q, *sample)
        found[i] = q
    if gains.kind == "madgwick":
        found = product(NORTH_WEST_UP, found)
    return found


def product(p: Floats, q: Floats) -> Floats:
    """Quaternion (4,) times quaternions (..., 4)."""
    return (to_scipy(p) * to_scipy(q)).as_quat(scalar_first=True)


def ahrs_error(
    gains: Gains, imu: jaxekf.Imu, start: Floats, truth: jaxekf.Encoder
) -> OrientationError:
    """Error of a filter of `ahrs` on one trial."""
    return scored(by_ahrs(gains, imu, start), imu.time_ns, truth)


def scored(q: Floats, time_ns: Times, truth: jaxekf.Encoder) -> OrientationError:
    """Errors of quaternions (N, 4) at these times (N,)."""
    at = encoder_at(truth, time_ns)
    return orientation_error(q[at.scored], at.q_ref_body[at.scored])


def errors_of_gains(
    trials: Sequence[jaxekf.Recording], gains: Sequence[Gains], description: str
) -> dict[Gains, list[OrientationError]]:
    """Errors of filters of `ahrs` for each of these gains and each trial, in parallel processes, because
    they take 200 us per sample in Python."""
    tasks = [(g, t.need_imu(), start_of(t), t.need_encoder()) for g in gains for t in trials]
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        waiting = [pool.submit(ahrs_error, *task) for task in tasks]
        for _ in track(
            as_completed(waiting), description, len(waiting), console=CONSOLE, transient=True
        ):
            pass
    found: dict[Gains, list[OrientationError]] = {g: [] for g in gains}
    for (g, *_), done in zip(tasks, waiting, strict=True):
        found[g].append(done.result())
    return found


def best(trials: Sequence[jaxekf.Recording], gains: Sequence[Gains]) -> Gains:
    """The gains with the least mean error over the trials."""
    found = errors_of_gains(trials, gains, f"gains of {gains[0].kind}")
    return min(found, key=lambda g: mean(found[g]).total_deg)


def mean(errors: Sequence[OrientationError]) -> OrientationError:
    """Means over trials."""
    return OrientationError(*np.mean(np.array(errors), axis=0).tolist())


# ---------------------------------------------------------------------------------------------


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--train", nargs="+", default=[], metavar="TRIAL", help="training trials")
    parser.add_argument("--test", nargs="+", default=[], metavar="TRIAL", help="test trials")
    parser.add_argument("--iterations", type=int, default=ITERATIONS, help="iterations (12)")
    parser.add_argument("--alone", action="store_true", help="no comparison with other filters")
    arguments = parse(parser, "broad")
    if arguments.smoke:
        arguments.train, arguments.test = ["01"], ["02"]
    if not (arguments.train and arguments.test):
        parser.error("got no trials, expected --train and --test with numbers of trials")
    return arguments


def own_errors(
    trials: Sequence[jaxekf.Recording], params: jaxekf.Parameters, smoke: bool
) -> dict[str, list[OrientationError]]:
    """Errors of the model on each trial, filtered and smoothed."""
    found = {}
    # The smoother takes more time to compile.
    for name in ("filtered",) if smoke else ("filtered", "smoothed"):
        made = jaxekf.estimate_many(
            trials, marg.MODEL, params, smooth=name == "smoothed", clock="tracker"
        )
        found[name] = [
            scored(one.outputs["attitude"].value, one.time_ns, trial.need_encoder())
            for one, trial in zip(made, trials, strict=True)
        ]
    return found


def installed(package: str) -> bool:
    """Whether a package can be imported; if not, print that it is left out."""
    found = find_spec(package) is not None
    if not found:
        print(f'{package} is left out: pip install "jaxekf[bench]"', file=sys.stderr)
    return found


def other_errors(
    training: Sequence[jaxekf.Recording], testing: Sequence[jaxekf.Recording], smoke: bool
) -> tuple[dict[str, list[OrientationError]], dict[str, Gains]]:
    """Errors of the installed other filters on each test trial, and their tuned gains."""
    found: dict[str, list[OrientationError]] = {}
    for name, offline in (("vqf", False), ("offline_vqf", True)) if installed("vqf") else ():
        found[name] = [
            scored(vqf(t.need_imu(), offline=offline), t.need_imu().time_ns, t.need_encoder())
            for t in testing
        ]
    if not installed("ahrs"):
        return found, {}
    if smoke:
        chosen = {"madgwick": Gains("madgwick", MADGWICK[0])}
    else:
        chosen = {"madgwick": best(training, [Gains("madgwick", g) for g in MADGWICK])}
        first = best(training, [Gains("mahony", g, SHARES[1] * g) for g in MAHONY])
        chosen["mahony"] = best(
            training, [first._replace(integral=s * first.proportional) for s in SHARES]
        )
    for name, gains in chosen.items():
        found[name] = errors_of_gains(testing, [gains], name)[gains]
    return found, chosen


def show(found: dict[str, list[OrientationError]], names: Sequence[str]) -> None:
    """Print a table of the total error of each trial, and the means of the three errors."""
    table = Table("", *names, "mean", "heading", "inclination", title="RMSE, deg")
    for column in table.columns[1:]:
        column.justify = "right"
    for method, errors in found.items():
        cells = [f"{e.total_deg:.2f}" for e in errors] + [f"{value:.2f}" for value in mean(errors)]
        table.add_row(method.replace("_", " "), *cells)
    Console().print(table)


def main() -> None:
    arguments = parse_arguments()
    began = time.perf_counter()
    training, testing = (
        [broad.load(broad.find(arguments.folder, trial)) for trial in trials]
        for trials in (arguments.train, arguments.test)
    )
    if arguments.smoke:
        training, testing = (
            [piece(run, 60.0, 4.0) for run in runs] for runs in (training, testing)
        )
        params, summary = start_for(training), "not tuned"
    else:
        tuned = tuned_on(training, arguments.iterations)
        params, seconds = tuned.params, time.perf_counter() - began
        summary = f"tuned in {len(tuned.history)} steps, {seconds:.0f} s: {tuned.stopped}"
    found = own_errors(testing, params, arguments.smoke)
    gains: dict[str, Gains] = {}
    if not arguments.alone:
        others, gains = other_errors(training, testing, arguments.smoke)
        found |= others
    show(found, arguments.test)
    print(summary)
    for part in (params.noise, params.calibration):
        values = {k: np.round(np.asarray(v, float), 5).tolist() for k, v in part._asdict().items()}
        print("  " + ", ".join(f"{name} {value}" for name, value in values.items()))
    document: dict[str, Any] = {
        "trials": arguments.test,
        "mean": {name: mean(errors)._asdict() for name, errors in found.items()},
        "total_deg": {name: [e.total_deg for e in errors] for name, errors in found.items()},
        "gains": {name: one._asdict() for name, one in gains.items()},
        "seconds": round(time.perf_counter() - began, 1),
    }
    print(json.dumps(document))


if __name__ == "__main__":
    main()
