"""Time of the visual-inertial filter with 30 correspondences in an image: ``python benchmarks/vision.py``.

Times of one run on one core: the filter, the smoother, the gradient of the likelihood with respect to all
parameters, and the same filter in textbook JAX (Jacobians by `jacfwd`, all rows in one Cholesky factor,
under `lax.cond`), which must agree. Prints a table and, as the last line, JSON. ``--smoke`` times only the
filter on half a second.
"""

import argparse
import json
import os
from functools import partial
from typing import Any

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax

import jaxekf

jaxekf.set_up()

import numpy as np
from clock import timed
from landmarks import POINTS, Prepared, by_textbook, filtered, prepare, recorded
from rich.console import Console
from rich.table import Table

from jaxekf import jit, run_smoother
from jaxekf.filtering.steps import Steps
from jaxekf.recordings.types import Recording

PLAIN, TEXTBOOK = "filter without gates", "textbook JAX without gates"


def work(one: Prepared) -> dict[str, Any]:
    """The timed functions by name; those of textbook JAX have other steps."""

    def smoothed(free: Any, steps: Steps) -> Any:
        params = free._replace(setup=one.params.setup)
        return run_smoother(one.model, params, one.belief, steps).smoothed

    own, plain = partial(filtered, one, one.model), partial(by_textbook, one)
    return {
        "filter": jit(own),
        PLAIN: jit(partial(filtered, one, one.plain)),
        "smoother": jit(smoothed),
        "gradient": jit(jax.value_and_grad(lambda free, steps: own(free, steps)[1])),
        TEXTBOOK: jax.jit(plain),
        "textbook JAX's gradient": jax.jit(jax.value_and_grad(lambda f, s: plain(f, s)[1])),
    }


def race(run: Recording, least_s: float, *, smoke: bool) -> dict[str, tuple[float, float]]:
    """Seconds of the first call and median seconds of later calls of each function."""
    one = prepare(run)
    chosen = work(one)
    if smoke:
        chosen = {name: chosen[name] for name in (PLAIN, TEXTBOOK)}
    found: dict[str, tuple[float, float]] = {}
    results: dict[str, Any] = {}
    for name, function in chosen.items():
        steps = one.flat if name.startswith("textbook") else one.steps
        first, median, results[name] = timed(function, one.free, steps, seconds=least_s)
        found[name] = first, median
    valid = np.asarray(one.steps.valid)
    ours, theirs = results[PLAIN], results[TEXTBOOK]
    for a, b in zip(jax.tree.leaves(ours[0]), jax.tree.leaves(theirs[0]), strict=True):
        np.testing.assert_allclose(a[valid], b[valid.ravel()], atol=1e-8)
    np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-8)
    return found


def main() -> None:
    """Time the filters, check that they agree, and print the times."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the run, s (60)")
    parser.add_argument("--timing", type=float, default=3.0, help="time for each function, s (3)")
    parser.add_argument("--smoke", action="store_true", help="filter only, half a second, 6 points")
    arguments = parser.parse_args()
    seconds, least_s, points = arguments.seconds, arguments.timing, POINTS
    if arguments.smoke:
        seconds, least_s, points = 0.5, 0.0, 6
    run = recorded(seconds, points)
    times = race(run, least_s, smoke=arguments.smoke)
    camera, imu = run.need_camera(), run.need_imu()
    images, samples = len(camera.time_ns), len(imu.time_ns)
    seen = float(camera.usable.sum()) / images
    table = Table(
        *("", "first call, s", "us per image", "us per step", "times real time"),
        title=f"{images} images of {seen:.1f} points, {samples} IMU samples, one core",
    )
    found = {}
    for name, (first, median) in times.items():
        found[name] = {
            "first_call_s": round(first, 2),
            "us_per_image": round(1e6 * median / images, 2),
            "us_per_step": round(1e6 * median / samples, 2),
            "times_real_time": round(seconds / median, 1),
        }
        table.add_row(name, *(f"{value:g}" for value in found[name].values()))
    Console(width=110).print(table)
    print("all filters agree: means and likelihood within 1e-8")
    print(json.dumps({"points": round(seen, 2), "times": found}))


if __name__ == "__main__":
    main()
