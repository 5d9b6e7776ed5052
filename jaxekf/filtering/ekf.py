"""The extended Kalman filter on a state space: one `lax.scan` over epochs, Jacobians by autodiff.

The covariance is that of the error vector, ``x_true = retract(x, error)``. All rows of all sensors at
one instant are linearised at the same predicted state, so that their order does not matter, and taken
in Joseph's form, which keeps the covariance definite. A model is written for one run; it is filtered
over many, see `jaxekf.filtering._recursion`.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf._support.errors import ModelError
from jaxekf.filtering import _gating as gating
from jaxekf.filtering import _lowered_model as lowered_model
from jaxekf.filtering import _lowered_path as lowered_path
from jaxekf.filtering import _recursion as recursion
from jaxekf.filtering._iterated_update import again, with_again
from jaxekf.filtering._linearisation import linearise_sensor
from jaxekf.filtering._recursion import First, Given, Kept, What
from jaxekf.filtering._step import Moment
from jaxekf.filtering.interpolation import InputSample, sample
from jaxekf.filtering.lowering import blocks
from jaxekf.filtering.lowering.reverse_only import reverse_only
from jaxekf.filtering.model import Belief, Model, Parameters, Sensor
from jaxekf.filtering.steps import Rows, Steps
from jaxekf.geometry import linalg

_MANY_ROWS = 12
Keep = Literal["everything", "estimates", "means"]
_KEPT: dict[str, What] = {
    "everything": What(prior=True, cov=True, used=True),
    "estimates": What(prior=False, cov=True, used=False),
    "means": What(prior=False, cov=False, used=False),
}
RUNS_AT_ONCE = blocks.LANES
"""Number of runs that one processor filters at once."""


class Innovation(NamedTuple):
    """What one sensor said at each of its instants, against what was predicted."""

    residual: Array
    """(..., rows) measured minus predicted, in the sensor's error vector; 0 where not used."""
    cov: Array
    """(..., rows, rows) predicted covariance of the residual, hidden rows as in the identity."""
    used: Array
    """(..., rows) rows that entered the update."""
    gated: Array
    """(..., rows) visible rows that the chi-square gate kept out."""
    nis: Array
    """(...) normalised innovation squared of the visible rows, gated ones included, none weighted."""
    weight: Array | None
    """(..., rows) what the noise of a row was divided by: 1 where it counted in full, 0 where it was not
    used; None for a sensor without weighting."""


class Updated(NamedTuple):
    """The belief after the samples of a substep; a covariance of None was not kept."""

    mean: Any
    cov: Array | None


class Instant(NamedTuple):
    """The filter at the end of each substep; leading axes (K, S)."""

    predicted: Belief | None
    """None where only estimates or means were kept."""
    updated: Any
    """`Belief`, or `Updated` where only means were kept."""
    log_likelihood: Array
    """Log density of the rows used, given all rows before them."""
    healthy: Array
    """False where a covariance lost finiteness or definiteness."""
    recovered: Array | None
    """Where gates that let nothing in were opened and the belief widened (see `Model.patience_s`); None
    without gates, or where not kept."""
    refused: Array | None
    """Seconds of samples that gates have refused since they last let one in; None likewise."""


class FilterOutput(NamedTuple):
    """Everything a run of the filter produces."""

    instants: Instant
    inputs: InputSample | None
    """The input as each substep saw it, leading axes (K, S)."""
    innovations: dict[str, Innovation]
    """By sensor: leading axes (K, S) for fast sensors, (K,) for slow ones. Empty unless kept."""


def initial_belief(model: Model, params: Parameters, first: Mapping[str, Any]) -> Belief:
    """The belief a run starts from: mean from its first samples, covariance from the parameters."""
    return Belief(model.initial_mean(first), model.initial_covariance(params))


def run_filter(
    model: Model,
    params: Parameters,
    belief: Belief,
    steps: Steps,
    *,
    keep: Keep = "everything",
    adjoint: bool = True,
    checkpoint: bool = True,
    refused: Array | None = None,
    relinearise: int = 0,
) -> FilterOutput:
    """Filter one run from an initial belief; differentiable in everything, and fast under `vmap`.

    `keep` says what is kept of each substep: ``everything``, ``estimates`` (updated beliefs) or
    ``means``, besides log-likelihoods; what is not kept costs neither time nor memory. Reverse
    derivatives are taken by the closed-form adjoint, several times faster than JAX's own; it has no
    forward mode (forward over reverse is fine). With ``adjoint=False`` all derivatives are JAX's own.
    For the reverse pass a few beliefs are kept and the others computed again, unless `checkpoint` is
    False, which keeps all. `refused` is `Instant.refused` of where an earlier part of the run ended.
    `relinearise` further linearisations of every update go about where it arrived, with the
    prediction's covariance as the prior throughout (iterated extended Kalman filter,
    `jaxekf.filtering._iterated_update`); gates, weights, innovations and likelihood are those of the
    first.

    Raises `ModelError` for an unknown `keep`, and where forward mode meets the adjoint.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> run = jaxekf.jit(lambda params: jaxekf.run_filter(model, params, belief, line.steps))
    >>> bool(run(model.parameters).instants.healthy.all())
    True
    """
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], (params, belief, steps, refused))
    options = {"keep": keep, "adjoint": adjoint, "checkpoint": checkpoint, "refused": one[3]}
    options |= {"relinearise": relinearise}
    return jax.tree.map(lambda a: a[0], run_filter_batch(model, *one[:3], **options))


def run_filter_batch(
    model: Model,
    params: Parameters,
    belief: Belief,
    steps: Steps,
    *,
    keep: Keep = "everything",
    adjoint: bool = True,
    checkpoint: bool = True,
    refused: Array | None = None,
    relinearise: int = 0,
    devices: Sequence[Any] = (),
) -> FilterOutput:
    """Filter many runs side by side: every leaf of every argument carries the runs on its first axis.

    Equal to `vmap` of `run_filter`, and to calls of it one by one; options as there. With several
    `devices` the runs are shared among them; CPU cores are devices where JAX's `jax_num_cpu_devices`
    was set before its first use.

    Raises `ModelError` as `run_filter` does, and where there is no run or no step.
    """
    if keep not in _KEPT:
        raise ModelError(
            f"got keep='{keep}', expected one of {sorted(_KEPT)}; choose what is to be kept"
        )
    params, belief, steps = jax.tree.map(jnp.asarray, (params, belief, steps))
    ready, prepared, given = made_ready(model, params, belief, steps, relinearise)
    inputs = given.moments.u
    what = _KEPT[keep]
    if adjoint:
        runs, epochs, substeps = steps.dt.shape
        kept_bytes = sum(a.size * a.dtype.itemsize for a in jax.tree.leaves(belief)) // runs
        lanes = min(runs, blocks.LANES)
        segment = recursion.segment_length(epochs, substeps, kept_bytes * lanes)
        if not checkpoint:
            segment = 1
        moving = reverse_only((prepared, First(belief, refused), given))
        kept = recursion.filter_with_adjoint(ready, what, segment, tuple(devices), *moving)
    else:
        first = First(belief, refused)
        kept = recursion.filter_plainly(ready, what, checkpoint, prepared, first, given)
    updated: Any = Updated(kept.mean, kept.cov) if kept.cov is None else Belief(kept.mean, kept.cov)
    instants = Instant(
        kept.prior, updated, kept.log_likelihood, kept.healthy, kept.recovered, kept.refused
    )
    innovations = _innovations(model, params, inputs, steps, kept) if what.used else {}
    return FilterOutput(instants, inputs, innovations)


def made_ready(
    model: Model, params: Parameters, belief: Belief, steps: Steps, relinearise: int = 0
) -> tuple[lowered_model.System, Any, Given]:
    """The model on lanes, what its steps need of the parameters, and what they are driven with; all
    arguments and the last two results carry the runs on the first axis.

    Raises `ModelError` where there is no run or no step, or for a negative number of linearisations.
    """
    if relinearise < 0:
        raise ModelError(
            f"got relinearise={relinearise}, expected 0 or more; 0 linearises every update once"
        )
    if 0 in steps.dt.shape:
        raise ModelError(
            f"got steps of shape {steps.dt.shape} (runs, epochs, substeps), expected at least one of"
            " each; leave out runs without data"
        )
    inputs = jax.vmap(partial(inputs_of, model))(params, steps)
    sizes: Any = one_sample((params, belief.mean), 1)
    u, fast = one_sample((inputs, steps.fast), 3)
    spec = (model, sizes[0], sizes[1], u, fast | one_sample(steps.slow, 2))
    ready = lowered_model.build(*spec)
    if relinearise:
        more = again(lowered_path.build(*spec), relinearise)
        ready = with_again(ready, more)
    prepared = jax.vmap(ready.prepare, axis_size=steps.dt.shape[0])(params)
    return ready, prepared, Given(Moment(steps.dt, inputs), steps.fast, steps.slow)


def one_sample(tree: Any, axes: int) -> Any:
    """Shape and type of one sample of arrays with `axes` leading axes."""
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[axes:], a.dtype), tree)


def inputs_of(model: Model, params: Parameters, steps: Steps) -> InputSample | None:
    """The input of every substep of one run, its clock shifted as the calibration says."""
    if model.input is None or steps.knots is None:
        return None
    shift = partial(model.input.shift, params)
    return sample(steps.knots, steps.time, steps.dt, shift)


def _innovations(
    model: Model, params: Parameters, inputs: Any, steps: Steps, kept: Kept
) -> dict[str, Innovation]:
    """Every sensor's innovations from the predicted beliefs, for all runs and instants at once."""
    found = {}
    for name, rows in (steps.fast | steps.slow).items():
        fast = name in steps.fast
        prior: Any = kept.prior
        u: Any = inputs
        if not fast:
            prior, u = jax.tree.map(lambda a: a[:, :, -1], (prior, u))
        one = partial(_innovation, model, model.sensor(name))
        for _ in range(2 if fast else 1):
            one = jax.vmap(one, in_axes=(None, 0, 0, 0, 0, 0))
        given = (prior, u, rows, kept.used[name], kept.gated[name])
        found[name] = jax.vmap(one)(params, *given)
    return found


def _nis(residual: Array, cov: Array) -> Array:
    """``r' inv(S) r``; of many rows by LAPACK, for written out they would take minutes to compile."""
    if residual.shape[0] <= _MANY_ROWS:
        return linalg.squared_distance(residual, cov)
    white = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(cov), residual, lower=True)
    return jnp.sum(white * white)


def _innovation(
    model: Model,
    sensor: Sensor,
    params: Parameters,
    prior: Belief,
    u: Any,
    rows: Rows,
    used: Array,
    gated: Array,
) -> Innovation:
    """One sensor's innovation at one instant."""
    residual, jacobian, noise = linearise_sensor(model, sensor, params, prior.mean, u, rows)
    jacobian = jnp.where(rows.mask[:, None], jacobian, 0.0)
    spread = linalg.multiply_transposed(linalg.multiply(jacobian, prior.cov), jacobian)
    noise = linalg.mask_covariance(noise, rows.mask)
    cov = linalg.symmetrise(spread + noise)
    nis = _nis(residual, cov)
    weight = gating.weights(sensor, residual, cov, rows.mask)
    if weight is not None:
        weight = jnp.where(used, weight, 0.0)
    return Innovation(jnp.where(used, residual, 0.0), cov, used, gated, nis, weight)
