"""Time of the visual-inertial filter with 30 correspondences in an image: ``python benchmarks/vision.py``.

One run, everything on one core. Beside the filter, its smoother and the gradient of the likelihood to all
parameters stands the same filter in textbook JAX (Jacobians by `jacfwd`, all rows in one Cholesky factor,
under `lax.cond`), which must agree. Prints a table, and last one line of JSON.
"""

import argparse
import json
import os
from functools import partial
from typing import Any

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from clock import timed  # noqa: E402
from jax import Array, lax  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from textbook import correct, linearise, predict  # noqa: E402

from jaxekf import jit, robust, run_filter, run_smoother, timeline  # noqa: E402
from jaxekf.model import Belief, Model, Parameters  # noqa: E402
from jaxekf.models import visual  # noqa: E402
from jaxekf.parameters import as_arrays  # noqa: E402
from jaxekf.recording import Recording  # noqa: E402
from jaxekf.simulate_camera import CameraGrade, camera_recording  # noqa: E402
from jaxekf.timeline import Rows, Steps  # noqa: E402

POINTS = 30


def textbook(model: Model, params: Parameters, belief: Belief, steps: Any) -> tuple[Any, Array]:
    """Updated means at every instant of `flattened` steps, and the likelihood of all samples."""

    def updated(samples: dict[str, Rows], ahead: Belief) -> tuple[Belief, Array]:
        h, e, r = linearise(model, params, ahead.mean, None, samples)
        mask = jnp.concatenate([rows.mask for rows in samples.values()])
        # Rows that are masked say nothing.
        h, e = jnp.where(mask[:, None], h, 0.0), jnp.where(mask, e, 0.0)
        r = jnp.where(mask[:, None] & mask, r, jnp.diag(jnp.where(mask, 0.0, 1.0)))
        return correct(model, ahead, h, e, r, jnp.sum(mask))

    def step(belief: Belief, given: Any) -> Any:
        valid, dt, fast, camera = given
        ahead = predict(model, params, belief, None, dt)
        found, gained = lax.cond(
            camera.mask.any(),
            partial(updated, fast | {"camera": camera}),
            partial(updated, fast),
            ahead,
        )
        kept = jax.tree.map(lambda a, b: jnp.where(valid, a, b), found, belief)
        return kept, (kept.mean, jnp.where(valid, gained, 0.0))

    _, (means, gained) = lax.scan(step, belief, steps)
    return means, jnp.sum(gained)


def flattened(steps: Steps) -> Any:
    """One instant after the other; images, which are at the ends of epochs, masked elsewhere."""
    epochs, substeps = np.shape(steps.dt)

    def flat(a: Any) -> Array:
        return jnp.reshape(a, (epochs * substeps, *np.shape(a)[2:]))

    images = jax.tree.map(lambda a: np.repeat(a, substeps, axis=0), steps.slow["camera"])
    last = np.arange(epochs * substeps) % substeps == substeps - 1
    images = images._replace(mask=images.mask & last[:, None])
    given = (flat(steps.valid), flat(steps.dt), jax.tree.map(flat, steps.fast), images)
    return jax.tree.map(jnp.asarray, given)


def recorded(seconds: float) -> Recording:
    """The eight, 30 landmarks in (nearly) every image."""
    return camera_recording("run", seed=1, duration_s=seconds, grade=CameraGrade(points=POINTS))


def race(run: Recording, least_s: float) -> dict[str, tuple[float, float]]:
    """Seconds of the first call of each, and of one like it later."""
    model = visual.adapt(False, [run])
    plain = robust(model, "none")
    line = timeline.build(model, run)
    given = as_arrays(model.parameters)._replace(setup=line.setup)
    steps = jax.tree.map(jnp.asarray, line.steps)
    every = flattened(line.steps)
    belief = Belief(as_arrays(model.initial_mean(line.first)), model.initial_covariance(given))
    free = given._replace(setup=())

    # Steps are arguments: as constants they would be folded into the program for minutes.
    def filtered(model: Model, free: Any, steps: Steps) -> tuple[Any, Array]:
        own = free._replace(setup=given.setup)
        output = run_filter(model, own, belief, steps, keep="means")
        return output.instants.updated.mean, jnp.sum(output.instants.log_likelihood)

    def smoothed(free: Any, steps: Steps) -> Any:
        return run_smoother(model, free._replace(setup=given.setup), belief, steps).smoothed

    def by_textbook(free: Any, every: Any) -> tuple[Any, Array]:
        return textbook(plain, free._replace(setup=given.setup), belief, every)

    ours, theirs = jit(partial(filtered, plain))(free, steps), jax.jit(by_textbook)(free, every)
    valid = np.asarray(steps.valid)
    for one, other in zip(jax.tree.leaves(ours[0]), jax.tree.leaves(theirs[0]), strict=True):
        np.testing.assert_allclose(one[valid], other[valid.ravel()], atol=1e-8)
    np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-8)
    work = {
        "filter": jit(partial(filtered, model)),
        "filter without gates": jit(partial(filtered, plain)),
        "smoother": jit(smoothed),
        "gradient": jit(jax.value_and_grad(lambda f, s: filtered(model, f, s)[1])),
        "textbook JAX without gates": jax.jit(by_textbook),
        "textbook JAX's gradient": jax.jit(jax.value_and_grad(lambda f, s: by_textbook(f, s)[1])),
    }
    found = {}
    for name, function in work.items():
        own = every if name.startswith("textbook") else steps
        found[name] = timed(function, free, own, seconds=least_s)
    return found


def main() -> None:
    """Race, and say what came of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the run")
    parser.add_argument("--timing", type=float, default=3.0, help="seconds that each is timed for")
    arguments = parser.parse_args()
    run = recorded(arguments.seconds)
    times = race(run, arguments.timing)
    camera, imu = run.need_camera(), run.need_imu()
    images, samples = len(camera.time_ns), len(imu.time_ns)
    points = float(camera.usable.sum()) / images
    table = Table(
        *("", "first call, s", "us per image", "us per step", "times real time"),
        title=f"{images} images of {points:.1f} points, {samples} IMU samples, one core",
    )
    found = {}
    for name, (first, median) in times.items():
        found[name] = {
            "first_call_s": round(first, 2),
            "us_per_image": round(1e6 * median / images, 2),
            "us_per_step": round(1e6 * median / samples, 2),
            "times_real_time": round(arguments.seconds / median, 1),
        }
        table.add_row(name, *(f"{value:g}" for value in found[name].values()))
    Console(width=110).print(table)
    print("all filters agree: means and likelihood within 1e-8")
    print(json.dumps({"points": round(points, 2), "times": found}))


if __name__ == "__main__":
    main()
