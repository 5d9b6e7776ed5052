"""A recorded run of `visual` and its filter, also in textbook JAX, for `vision.py` and `models.py`."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from textbook import correct, linearise, predict

from jaxekf import robust, run_filter
from jaxekf.estimation import timeline
from jaxekf.estimation.parameters import as_arrays
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Rows, Steps
from jaxekf.models import visual
from jaxekf.recordings.types import Recording
from jaxekf.simulation.camera_runs import CameraGrade, camera_recording

POINTS = 30
"""Landmarks in (nearly) every image."""


class Prepared(NamedTuple):
    """A run ready to be filtered."""

    model: Model
    plain: Model
    """The model without gates, which textbook JAX does not have."""
    params: Parameters
    belief: Belief
    steps: Steps
    flat: Any
    """The steps of the run in the form for textbook JAX."""

    @property
    def free(self) -> Parameters:
        """The parameters without the setup, which comes from the recording."""
        return self.params._replace(setup=())


def recorded(seconds: float, points: int = POINTS) -> Recording:
    """A figure eight of `seconds`, with this number of landmarks in (nearly) every image."""
    return camera_recording("run", seed=1, duration_s=seconds, grade=CameraGrade(points=points))


def prepare(run: Recording) -> Prepared:
    """The arguments of both filters of a recording."""
    model = visual.adapt(False, [run])
    line = timeline.build(model, run)
    params = as_arrays(model.parameters)._replace(setup=line.setup)
    belief = Belief(as_arrays(model.initial_mean(line.first)), model.initial_covariance(params))
    steps = jax.tree.map(jnp.asarray, line.steps)
    return Prepared(model, robust(model, "none"), params, belief, steps, flattened(line.steps))


# Steps are arguments, because constant folding would take minutes.
def filtered(run: Prepared, model: Model, free: Parameters, steps: Steps) -> tuple[Any, Array]:
    """Updated means of the run by the package, and the likelihood of all samples."""
    params = free._replace(setup=run.params.setup)
    output = run_filter(model, params, run.belief, steps, keep="means")
    return output.instants.updated.mean, jnp.sum(output.instants.log_likelihood)


def by_textbook(run: Prepared, free: Parameters, flat: Any) -> tuple[Any, Array]:
    """The same in textbook JAX, without gates."""
    return textbook(run.plain, free._replace(setup=run.params.setup), run.belief, flat)


def textbook(model: Model, params: Parameters, belief: Belief, flat: Any) -> tuple[Any, Array]:
    """Updated means at every instant of `flattened` steps, and the likelihood of all samples."""

    def updated(samples: dict[str, Rows], ahead: Belief) -> tuple[Belief, Array]:
        h, e, r = linearise(model, params, ahead.mean, None, samples)
        mask = jnp.concatenate([rows.mask for rows in samples.values()])
        # Masked rows have zero Jacobian, zero innovation and unit noise, and so no effect.
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

    _, (means, gained) = lax.scan(step, belief, flat)
    return means, jnp.sum(gained)


def flattened(steps: Steps) -> Any:
    """Steps with one leading axis of instants; images are masked except at the ends of epochs."""
    epochs, substeps = np.shape(steps.dt)

    def flat(a: Any) -> Array:
        return jnp.reshape(a, (epochs * substeps, *np.shape(a)[2:]))

    images = jax.tree.map(lambda a: np.repeat(a, substeps, axis=0), steps.slow["camera"])
    last = np.arange(epochs * substeps) % substeps == substeps - 1
    images = images._replace(mask=images.mask & last[:, None])
    given = (flat(steps.valid), flat(steps.dt), jax.tree.map(flat, steps.fast), images)
    return jax.tree.map(jnp.asarray, given)


def of_many(flat: Any, runs: int) -> tuple[Any, Any]:
    """`flattened` steps with the values repeated for each run on a new first axis, and axes for `vmap`.

    Only values have that axis. Masks are shared, so that `lax.cond` still skips the instants without an
    image.
    """

    def each(rows: Rows) -> Rows:
        return rows._replace(value=jnp.broadcast_to(rows.value, (runs, *rows.value.shape)))

    valid, dt, fast, camera = flat
    axes = Rows(0, None, None, None)
    repeated = valid, dt, {name: each(rows) for name, rows in fast.items()}, each(camera)
    return repeated, (None, None, dict.fromkeys(fast, axes), axes)
