"""Noise and calibration tuned on real recordings: a tracker simulated from BROAD trials.

    python examples/broad_tracker.py FOLDER --train 01 05 10 16 --test 02 07 12 24 --seed 0

FOLDER has BROAD's MATLAB files. Each trial keeps its real gyroscope; the attitude by motion capture is the
truth, and a decimated copy with noise and occlusions is the tracker. From hand-set noise, Q and R are tuned
by gradient on the training trials together with the gyroscope's clock offset and matrix (`--noise-only`
leaves these out). The test trials are estimated before and after the tuning, and smoothed. With
`--calibrate` the objective is the likelihood of the measurements with priors, and each trial has a matrix
of its own; that of a test trial is found from its innovations, and its truth is used only for the score.
With `--baselines` each training trial is first held out in turn, and noise by Allan deviation alone and
searches without gradients are set beside the tuning, with the work that each takes.

The last line of the output is JSON with the attitude RMSE in degrees of each test trial. `--smoke` runs
one iteration on ten seconds of a trial.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from recorded import parse, piece

import jaxekf
import tuning
from jaxekf.io.importers import broad

CALIBRATION = ("calibration.clock_offset", "calibration.gyroscope_matrix")


def hand_set() -> jaxekf.Parameters:
    """Noise that a careful user would choose without looking at the data."""
    params = jaxekf.get_model("loose").parameters
    noise = params.noise._replace(
        gyroscope=np.deg2rad(0.02), bias_walk=np.deg2rad(0.005), optical=np.deg2rad(0.5)
    )
    return params._replace(noise=noise)


def load(folder: Path, trials: list[str], seed: int) -> list[jaxekf.Recording]:
    """Each trial with a simulated tracker."""
    return [
        broad.degrade(broad.load(broad.find(folder, trial)), seed=seed, trial=int(trial))
        for trial in trials
    ]


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--train", nargs="+", default=[], metavar="TRIAL", help="training trials")
    parser.add_argument("--test", nargs="+", default=[], metavar="TRIAL", help="test trials")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the tracker (0)")
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument(
        "--baselines", nargs="*", choices=tuning.BASELINES, help="hold out, with these"
    )
    parser.add_argument("--warm", action="store_true", help="first iterations on the likelihood")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--noise-only", action="store_true", help="no tuning of the calibration")
    which.add_argument(
        "--calibrate", action="store_true", help="likelihood, a gyroscope matrix for each trial"
    )
    arguments = parse(parser, "broad")
    if arguments.smoke:
        arguments.train, arguments.test, arguments.iterations = ["01"], ["02"], 1
    if not (arguments.train and arguments.test):
        parser.error("got no trials, expected --train and --test with numbers of trials")
    return arguments


def say_progress(step: tuning.Iteration, total: int) -> None:
    if sys.stderr.isatty():
        print(f"\r  step {step.number + 1}/{total}: {step.training:.5f}", end="", file=sys.stderr)


def tuning_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """The free parameters, the objective and the number of iterations."""
    found: dict[str, Any] = {"free": ["noise", *CALIBRATION], "iterations": arguments.iterations}
    found["warm"] = arguments.warm
    if arguments.noise_only:
        found["free"] = ["noise"]
    if arguments.calibrate:
        matrix = tuning.Free("calibration.gyroscope_matrix", each_run=True, prior=0.02)
        found |= {"free": ["noise", "calibration.clock_offset", matrix], "objective": "map"}
        found["iterations"] = max(arguments.iterations, 40)
    return found


def hold_out(
    runs: list[jaxekf.Recording], baselines: list[str], options: dict[str, Any]
) -> dict[str, Any]:
    """Hold out each trial in turn, print the scores of each variant, and return them for JSON."""
    found = tuning.cross_validate(
        runs, baselines=baselines, start=hand_set(), progress=say_progress, **options
    )
    errors, nees = found.spread(), found.spread("nees")
    print(
        "held out in turn, mean ± standard deviation of a trial (worst); work in passes of the filter over"
        " all training trials"
    )
    print(f"{'':>12}{'attitude RMSE, deg':>28}{'NEES':>30}{'work':>12}")
    for variant, error in errors.items():
        texts = [
            f"{a.mean:.3f} ± {a.deviation:.3f} ({a.worst:.3f})" for a in (error, nees[variant])
        ]
        work = found.forward.get(variant, float("nan"))
        print(f"{variant:>12}{texts[0]:>28}{texts[1]:>30}{work:>12.0f}")
    return found.as_dict()


def main() -> None:
    arguments = parse_arguments()
    jaxekf.set_up()
    began = time.perf_counter()
    training = load(arguments.folder, arguments.train, arguments.seed)
    testing = load(arguments.folder, arguments.test, arguments.seed)
    if arguments.smoke:
        training, testing = (
            [piece(run, 60.0, 10.0) for run in runs] for runs in (training, testing)
        )
    start = hand_set()
    held_out = None
    if arguments.baselines is not None:
        held_out = hold_out(training, arguments.baselines, tuning_options(arguments))
    tuned = tuning.tune(training, start=start, progress=say_progress, **tuning_options(arguments))
    own = tuning.fit_runs(testing, tuned)
    params = [own[trial.name] for trial in testing]
    compared = tuning.compare("loose", testing, {"initial": start, "tuned": params})
    noise, calibration = tuned.params.noise, tuned.params.calibration
    print(f"tuned in {len(tuned.history)} steps: {tuned.stopped}")
    for name, unit in (
        ("gyroscope", "deg/s/sqrt(Hz)"),
        ("bias_walk", "deg/s^2/sqrt(Hz)"),
        ("optical", "deg"),
    ):
        print(f"  {name:<10} {np.rad2deg(float(getattr(noise, name))):9.5f} {unit}")
    print(f"  gyroscope lags by {1e3 * float(calibration.clock_offset):.2f} ms")
    columns = {"hold last": "hold_last_deg", "initial": "initial_deg", "tuned": "tuned_deg"}
    summary: dict[str, object] = {
        key: [row.attitude_rmse_deg for row in compared.rows if row.variant == variant]
        for variant, key in columns.items()
    }
    # The smoother takes more time to compile.
    smoothed = (
        [] if arguments.smoke else jaxekf.estimate_many(testing, "loose", params, smooth=True)
    )
    summary["smoothed_deg"] = [
        jaxekf.score(made, run).attitude_rmse_deg
        for made, run in zip(smoothed, testing[: len(smoothed)], strict=True)
    ]
    if smoothed:
        columns["smoothed"] = "smoothed_deg"
    print("".join(f"{name:>12}" for name in ("trial", *columns, "NIS", "NEES")))
    checks = [row for row in compared.rows if row.variant == "tuned"]
    for i, trial in enumerate(arguments.test):
        values = [float(np.asarray(summary[key])[i]) for key in columns.values()]
        values += [checks[i].nis, checks[i].nees]
        print(f"{trial:>12}" + "".join(f"{value:>12.3f}" for value in values))
    summary["nees"] = [row.nees for row in checks]
    summary["optical_deg"] = float(np.rad2deg(noise.optical))
    summary["clock_offset_ms"] = 1e3 * float(calibration.clock_offset)
    summary["trials"] = arguments.test
    if held_out is not None:
        summary["held_out"] = held_out
    summary["seconds"] = round(time.perf_counter() - began, 1)
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
