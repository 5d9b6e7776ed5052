"""The extended Kalman filter on a state space: one `lax.scan` over epochs, Jacobians by autodiff.

The covariance is that of the error vector, ``x_true = retract(x, error)``. All rows of all sensors at
one instant are linearised at the same predicted state, so that their order does not matter, and applied
in Joseph's form, which keeps the covariance definite. A model is written for one run; the filter runs
it for many, see `jaxekf.filtering._recursion`.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf._support.compilation import require_float64
from jaxekf._support.deprecations import renamed_arguments, warn_renamed
from jaxekf._support.errors import ModelError
from jaxekf.filtering import _gating as gating
from jaxekf.filtering import _lowered_model as lowered_model
from jaxekf.filtering import _recursion as recursion
from jaxekf.filtering._epoch import SaveSpec, ScanInit, ScanInputs, ScanOutputs
from jaxekf.filtering._iterated_update import with_iterated_update
from jaxekf.filtering._linearisation import linearise_sensor
from jaxekf.filtering._lowered_model import ABOUT_PATH, AT_ESTIMATE, Linearisation, LoweredModel
from jaxekf.filtering._step import SubstepInput
from jaxekf.filtering.arguments import float_leaves, for_filter, parameters
from jaxekf.filtering.interpolation import InputSample, sample
from jaxekf.filtering.lowering import batching
from jaxekf.filtering.lowering.reverse_only import reverse_only
from jaxekf.filtering.model import Belief, Model, Parameters, Sensor
from jaxekf.filtering.steps import Rows, Steps
from jaxekf.geometry import linalg

_MANY_ROWS = 12
Keep = Literal["everything", "estimates", "means"]
_SAVE_SPECS: dict[str, SaveSpec] = {
    "everything": SaveSpec(prior=True, cov=True, used=True),
    "estimates": SaveSpec(prior=False, cov=True, used=False),
    "means": SaveSpec(prior=False, cov=False, used=False),
}
RUNS_AT_ONCE = batching.LANES
"""Number of runs that one processor filters at once."""


class Innovation(NamedTuple):
    """The innovations of one sensor: measured against predicted samples."""

    residual: Array
    """(..., rows) measured minus predicted, in the sensor's error vector; 0 where not used."""
    cov: Array
    """(..., rows, rows) predicted covariance of the residual, hidden rows as in the identity."""
    used: Array
    """(..., rows) rows that entered the update."""
    gated: Array
    """(..., rows) visible rows that the chi-square gate rejected."""
    nis: Array
    """(...) normalised innovation squared of the visible rows, gated ones included, none weighted."""
    weight: Array | None
    """(..., rows) factor by which the noise of a row was divided: 1 for full weight, 0 where not used; None
    for a sensor without weighting."""


class Updated(NamedTuple):
    """The belief after the samples of a substep, without the covariance if that was not kept."""

    mean: Any
    cov: Array | None


class Instant(NamedTuple):
    """The filter's results at the end of each substep; leading axes (K, S)."""

    predicted: Belief | None
    """None if only estimates or means were kept."""
    updated: Any
    """`Belief`, or `Updated` if only means were kept."""
    log_likelihood: Array
    """Log density of the rows used, given all rows before them."""
    healthy: Array
    """False where a covariance is not finite or not definite."""
    recovered: Array | None
    """True where the belief was reset because all samples contradicted it (see `Model.gate_reset_after_s`);
    None if the model is never reset, or if not kept."""
    rejecting_s: Array | None
    """(K, S, groups) seconds of samples outside their chi-square bounds since the last one inside, for each
    group of sensors that observe common states; None likewise."""

    @property
    def refused(self) -> Array | None:
        """Deprecated name of `rejecting_s`."""
        warn_renamed("the field refused of Instant", "rejecting_s")
        return self.rejecting_s


class FilterOutput(NamedTuple):
    """The results of the filter for a run, with leading axes (K, S): K epochs of S substeps.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> filtered = jaxekf.jit(jaxekf.run_filter, static_argnums=0)
    >>> output = filtered(model, model.parameters, belief, line.steps)
    >>> output.instants.updated.mean.bias.shape, output.instants.updated.cov.shape
    ((1501, 2, 3), (1501, 2, 6, 6))
    >>> nis = output.innovations["optical"].nis
    >>> print(f"{nis.sum() / output.innovations['optical'].used.sum():.2f}")
    0.98
    """

    instants: Instant
    """Beliefs, log-likelihood and flags at the end of each substep."""
    inputs: InputSample | None
    """The input of each substep, leading axes (K, S)."""
    innovations: dict[str, Innovation]
    """By sensor: leading axes (K, S) for fast sensors, (K,) for slow ones. Empty unless kept."""


def initial_belief(model: Model, params: Parameters, first: Mapping[str, Any]) -> Belief:
    """The belief at the start of a run.

    Parameters
    ----------
    model, params
        The model and its parameters.
    first
        First visible sample of each sensor by name (`Timeline.first`).

    Returns
    -------
    Belief
        Mean from the first samples, covariance (n, n) from ``params.initial``.

    Examples
    --------
    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> print(np.rad2deg(np.sqrt(np.diagonal(belief.cov))).round(1))  # deg and deg/s
    [10. 10. 10.  1.  1.  1.]
    """
    require_float64()
    given = parameters(model, params, check_shapes=False)
    mean = model.initial_mean(float_leaves("first", dict(first)))
    return Belief(mean, model.initial_covariance(given))


@renamed_arguments(refused="rejecting_s")
def run_filter(
    model: Model,
    params: Parameters,
    belief: Belief,
    steps: Steps,
    *,
    keep: Keep = "everything",
    adjoint: bool = True,
    checkpoint: bool = True,
    rejecting_s: Array | None = None,
    relinearise: int = 0,
) -> FilterOutput:
    """Filter one run from an initial belief; differentiable in everything, and fast under `vmap`.

    Parameters
    ----------
    model, params, belief, steps
        The model, its parameters, the belief at the start, and the samples and inputs of the run.
    keep
        Results of each substep besides log-likelihoods: ``everything``, ``estimates`` (updated beliefs) or
        ``means``. Results that are not kept cost neither time nor memory.
    adjoint
        Whether reverse derivatives are the closed-form adjoint, several times faster than JAX's own. The
        adjoint has no forward mode (forward over reverse is fine). False takes JAX's own derivatives.
    checkpoint
        Whether the reverse pass keeps a few beliefs and computes the others again. False keeps all.
    rejecting_s
        `Instant.rejecting_s` at the end of an earlier part of the run.
    relinearise
        Number of further linearisations of every update, each about the result of the one before, with the
        prediction's covariance as the prior (iterated extended Kalman filter). Gates, weights, innovations
        and likelihood are those of the first.

    Returns
    -------
    `FilterOutput`, leading axes (K, S).

    Raises
    ------
    ModelError
        For an unknown `keep`, and for a forward-mode derivative of the adjoint.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> filtered = jaxekf.jit(jaxekf.run_filter, static_argnums=0)
    >>> output = filtered(model, model.parameters, belief, line.steps)
    >>> bool(output.instants.healthy.all())
    True
    """
    given = *for_filter(model, params, belief, steps), rejecting_s
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], given)
    options = {"keep": keep, "adjoint": adjoint, "checkpoint": checkpoint, "rejecting_s": one[3]}
    options |= {"relinearise": relinearise}
    return jax.tree.map(lambda a: a[0], run_filter_batch(model, *one[:3], **options))


@renamed_arguments(refused="rejecting_s")
def run_filter_batch(
    model: Model,
    params: Parameters,
    belief: Belief,
    steps: Steps,
    *,
    keep: Keep = "everything",
    adjoint: bool = True,
    checkpoint: bool = True,
    rejecting_s: Array | None = None,
    relinearise: int = 0,
    devices: Sequence[Any] = (),
) -> FilterOutput:
    """Filter many runs side by side: every leaf of every argument carries the runs on its first axis.

    Equal to `vmap` of `run_filter`, and to calls of it one by one.

    Parameters
    ----------
    model, params, belief, steps, keep, adjoint, checkpoint, rejecting_s, relinearise
        As in `run_filter`.
    devices
        Devices that share the runs. CPU cores are devices if JAX's `jax_num_cpu_devices` was set before its
        first use.

    Returns
    -------
    `FilterOutput`, leading axes (runs, K, S).

    Raises
    ------
    ModelError
        As `run_filter`, and for no run or no step.

    Examples
    --------
    The same run with two sizes of the tracker's noise, 0.3 and 3 deg:

    >>> import jax
    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> params, belief, steps = jax.tree.map(
    ...     lambda a: np.stack([a, a]), (model.parameters, belief, line.steps)
    ... )
    >>> params.noise.optical[1] *= 10.0
    >>> filtered = jaxekf.jit(jaxekf.run_filter_batch, static_argnums=0)
    >>> output = filtered(model, params, belief, steps)
    >>> log_likelihood = output.instants.log_likelihood.sum(axis=(1, 2))
    >>> bool(log_likelihood[0] > log_likelihood[1])
    True
    """
    if keep not in _SAVE_SPECS:
        raise ModelError(
            f"got keep='{keep}', expected one of {sorted(_SAVE_SPECS)}; choose one of these"
        )
    given = for_filter(model, params, belief, steps)
    params, belief, steps = jax.tree.map(jnp.asarray, given)
    lowered, prepared, inputs = lower_model(model, params, belief, steps, relinearise)
    u = inputs.substeps.u
    save, first = _SAVE_SPECS[keep], ScanInit(belief, rejecting_s)
    if adjoint:
        runs, epochs, substeps = steps.dt.shape
        belief_bytes = sum(a.size * a.dtype.itemsize for a in jax.tree.leaves(belief)) // runs
        lanes = min(runs, batching.LANES)
        segment = recursion.segment_length(epochs, substeps, belief_bytes * lanes)
        if not checkpoint:
            segment = 1
        trees = reverse_only((prepared, first, inputs))
        kept = recursion.filter_with_adjoint(lowered, save, segment, tuple(devices), *trees)
    else:
        kept = recursion.filter_with_jax_derivatives(
            lowered, save, checkpoint, prepared, first, inputs
        )
    updated: Any = Updated(kept.mean, kept.cov) if kept.cov is None else Belief(kept.mean, kept.cov)
    instants = Instant(
        kept.prior, updated, kept.log_likelihood, kept.healthy, kept.recovered, kept.rejecting_s
    )
    innovations = _innovations(model, params, u, steps, kept) if save.used else {}
    return FilterOutput(instants, u, innovations)


def count_reset_groups(model: Model, params: Parameters, belief: Belief, steps: Steps) -> int:
    """Number of groups in `Instant.rejecting_s`, for the arguments of `run_filter`."""
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], (params, belief, steps))
    return len(lower_model(model, *one)[0].reset_groups)


def lower_model(
    model: Model, params: Parameters, belief: Belief, steps: Steps, relinearise: int = 0
) -> tuple[LoweredModel, Any, ScanInputs]:
    """Prepare a model and many runs for the scan; arguments carry the runs on the first axis.

    Returns
    -------
    lowered
        The model on the batch axis.
    prepared
        The result of `LoweredModel.prepare`, runs first.
    inputs
        The scan's inputs, runs first.

    Raises
    ------
    ModelError
        For no run, no step, or a negative number of linearisations.
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
    u = jax.vmap(partial(inputs_of, model))(params, steps)
    inputs = ScanInputs(SubstepInput(steps.dt, u, steps.excess), steps.fast, steps.slow)
    return *lower_for_inputs(model, params, belief, inputs, AT_ESTIMATE, relinearise), inputs


def lower_for_inputs(
    model: Model,
    params: Parameters,
    belief: Belief,
    inputs: ScanInputs,
    linearise: Linearisation,
    relinearise: int = 0,
) -> tuple[LoweredModel, Any]:
    """`lowered` and `prepared` as in `lower_model`, for any linearisation."""
    sizes: Any = _one_sample((params, belief.mean), 1)
    u, fast = _one_sample((inputs.substeps.u, inputs.fast), 3)
    spec = (model, sizes[0], sizes[1], u, fast | _one_sample(inputs.slow, 2))
    lowered = lowered_model.build(*spec, linearise)
    if relinearise:
        about_path = lowered_model.build(*spec, ABOUT_PATH)
        lowered = with_iterated_update(lowered, about_path, relinearise)
    runs = inputs.substeps.dt.shape[0]
    return lowered, jax.vmap(lowered.prepare, axis_size=runs)(params)


def _one_sample(tree: Any, axes: int) -> Any:
    """Shape and type of one sample of arrays with `axes` leading axes."""
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[axes:], a.dtype), tree)


def inputs_of(model: Model, params: Parameters, steps: Steps) -> InputSample | None:
    """The input of every substep of one run, its clock shifted by the calibration; None without input."""
    if model.input is None or steps.knots is None:
        return None
    shift = partial(model.input.shift, params)
    return sample(steps.knots, steps.time, steps.dt, shift)


def _innovations(
    model: Model, params: Parameters, inputs: Any, steps: Steps, kept: ScanOutputs
) -> dict[str, Innovation]:
    """The innovations of every sensor from the predicted beliefs, for all runs and instants at once."""
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
        found[name] = jax.vmap(one)(params, prior, u, rows, kept.used[name], kept.gated[name])
    return found


def _nis(residual: Array, cov: Array) -> Array:
    """``r' inv(S) r``; many rows by LAPACK, since unrolled arithmetic would take minutes to compile."""
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
    """The innovation of one sensor at one instant of one run."""
    residual, jacobian, noise = linearise_sensor(model, sensor, params, prior.mean, u, rows)
    jacobian = jnp.where(rows.mask[:, None], jacobian, 0.0)
    spread = linalg.multiply_transposed(linalg.multiply(jacobian, prior.cov), jacobian)
    noise = linalg.mask_covariance(noise, rows.mask)
    cov = linalg.symmetrise(spread + noise)
    nis = _nis(residual, cov)
    weight = gating.row_weights(sensor, residual, cov, rows.mask)
    if weight is not None:
        weight = jnp.where(used, weight, 0.0)
    return Innovation(jnp.where(used, residual, 0.0), cov, used, gated, nis, weight)
