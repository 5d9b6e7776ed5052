"""The iterated smoother: the most probable path of a whole run, by Gauss-Newton.

It minimises over the start and all process noise

    |local(x0, start)|^2 / P0 + sum |w|^2 / Q + sum |local(h(x), z)|^2 / R

with ``x = transition(x before, u, dt, w)``. Each iteration is a linear Kalman filter and a backward pass
about the present path. The path may miss the transition while the iteration runs (its defect is not zero),
and satisfies it at convergence. Rows that the filter's gates rejected do not count.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf._support.errors import ModelError
from jaxekf.filtering import _covariance_prediction as covariance_prediction
from jaxekf.filtering import _smoother_pass as smoother_pass
from jaxekf.filtering import _step as step
from jaxekf.filtering import _substeps as substeps
from jaxekf.filtering import ekf, smoother
from jaxekf.filtering._covariance_update import UpdateAccumulator
from jaxekf.filtering._epoch import ScanInputs
from jaxekf.filtering._lowered_model import ABOUT_PATH, BoundModel, LoweredModel
from jaxekf.filtering._smoother_pass import Information
from jaxekf.filtering._step import SubstepInput
from jaxekf.filtering.arguments import for_filter
from jaxekf.filtering.lowering import structured_matrix
from jaxekf.filtering.lowering.batched_products import congruence, diagonal_matrix, multiply_vector
from jaxekf.filtering.lowering.batched_vjp import batched, batched_with_vjp
from jaxekf.filtering.lowering.lanes import materialise
from jaxekf.filtering.lowering.reverse_only import reverse_only
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.smoother import SmootherOutput
from jaxekf.filtering.steps import Steps
from jaxekf.geometry import linalg


class Path(NamedTuple):
    """A path through a run; leading axes (K, S) except for the start."""

    start: Any
    """State at the start of the run."""
    mean: Any
    """State at the end of each substep."""
    noise: Array
    """(K, S, n_w) process noise of the transition that ends there."""


class IteratedOutput(NamedTuple):
    """A run smoothed by iteration, with leading axes (K, S): K epochs of S substeps.

    Examples
    --------
    The iteration has converged:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> path = jaxekf.jit(jaxekf.run_iterated_smoother, static_argnums=0)
    >>> output = path(model, model.parameters, belief, line.steps)
    >>> output.smoothed.mean.bias.shape, output.noise.shape
    ((1501, 2, 3), (1501, 2, 6))
    >>> bool(output.moved[-1] < 1e-6)
    True
    """

    filtered: Any
    """The filter's results, linearised at its own estimates."""
    smoothed: Belief
    """At the end of each substep, leading axes (K, S)."""
    start: Belief
    """At the start of the run."""
    noise: Array
    """(K, S, n_w) the process noise that carries the path from each substep to the next."""
    moved: Array
    """(iterations,) the largest step of a state in each iteration, in standard deviations of the smoothed
    state: small in the last ones if the iteration has converged."""


class _ForwardOutput(NamedTuple):
    """The forward pass at one substep: errors relative to the path."""

    prior: UpdateAccumulator
    delta: Array
    """(n, lanes) after the update."""
    cov: Array
    """(n, n, lanes) after the update."""


def run_iterated_smoother(
    model: Model,
    params: Parameters,
    belief: Belief,
    steps: Steps,
    *,
    iterations: int = 5,
    adjoint: bool = True,
) -> IteratedOutput:
    """The most probable path of one run, from an initial belief; differentiable in everything.

    The iteration starts at the smoothed path; samples that the filter's gates rejected stay rejected.

    Parameters
    ----------
    model, params, belief, steps, adjoint
        As in `run_smoother`.
    iterations
        Number of Gauss-Newton steps; 3 to 5 suffice for a tracker.

    Returns
    -------
    IteratedOutput
        The path and its covariances; `moved` has the last step sizes.

    Raises
    ------
    ModelError
        For a model with robust weighting, and as `run_smoother`.

    Examples
    --------
    The first step is small, since the smoother's path is already close to the most probable one:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> path = jaxekf.jit(jaxekf.run_iterated_smoother, static_argnums=0)
    >>> output = path(model, model.parameters, belief, line.steps)
    >>> bool(output.moved[0] < 0.1)  # standard deviations
    True
    """
    given = for_filter(model, params, belief, steps)
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], given)
    found = run_iterated_smoother_batch(model, *one, iterations=iterations, adjoint=adjoint)
    return jax.tree.map(lambda a: a[0], found)


def run_iterated_smoother_batch(
    model: Model,
    params: Parameters,
    belief: Belief,
    steps: Steps,
    *,
    iterations: int = 5,
    adjoint: bool = True,
    devices: Sequence[Any] = (),
) -> IteratedOutput:
    """The most probable paths of many runs: every leaf of every argument and result carries the runs first.

    Raises
    ------
    ModelError
        For a model with robust weighting (`jaxekf.robust` with huber or student), and as
        `run_smoother_batch`.

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
    >>> paths = jaxekf.jit(jaxekf.run_iterated_smoother_batch, static_argnums=0)
    >>> moved = paths(model, params, belief, steps).moved
    >>> moved.shape, bool((moved[:, -1] < 1e-6).all())
    ((2, 5), True)
    """
    if any(sensor.weighting is not None for sensor in model.sensors):
        raise ModelError(
            f"model '{model.name}': got a sensor with heavy tails, expected gates or none, for least"
            " squares know no tails; take run_smoother, or jaxekf.robust(model, 'gate')"
        )
    given = for_filter(model, params, belief, steps)
    params, belief, steps = jax.tree.map(jnp.asarray, given)
    first = smoother.run_smoother_batch(
        model, params, belief, steps, adjoint=adjoint, devices=devices
    )
    inputs = _used_inputs(first, steps)
    lowered, prepared = ekf.lower_for_inputs(model, params, belief, inputs, ABOUT_PATH)
    noise_dim = lowered.transition.g_pattern.shape[1]
    dtype = belief.cov.dtype
    path = Path(
        first.start.mean, first.smoothed.mean, jnp.zeros((*steps.dt.shape, noise_dim), dtype)
    )
    trees = (prepared, belief, inputs)
    if adjoint:
        function = _gauss_newton_with_vjp(lowered, tuple(devices))
        trees = reverse_only(trees)
    else:
        function = partial(batched, partial(_gauss_newton_step, lowered, False))

    def iterate(carry: Any, _: None) -> Any:
        path, smoothed, start, largest = function(*trees, carry[0])
        return (path, smoothed, start), largest

    begun = (path, Belief(*first.smoothed), Belief(*first.start))
    (path, smoothed, start), moved = lax.scan(iterate, begun, None, length=iterations)
    return IteratedOutput(first.filtered, smoothed, start, path.noise, jnp.moveaxis(moved, 0, 1))


def _used_inputs(first: SmootherOutput, steps: Steps) -> ScanInputs:
    """The filter's inputs, with only the rows visible that entered its updates."""
    used = first.filtered.innovations

    def mask_unused(sensors: Any) -> Any:
        return {name: rows._replace(mask=used[name].used) for name, rows in sensors.items()}

    own = SubstepInput(steps.dt, first.filtered.inputs, steps.excess)
    return ScanInputs(own, mask_unused(steps.fast), mask_unused(steps.slow))


@lru_cache(maxsize=64)
def _gauss_newton_with_vjp(lowered: LoweredModel, devices: tuple[Any, ...]) -> Any:
    return batched_with_vjp(devices, partial(_gauss_newton_step, lowered, True))


# --- one batch of runs, on the batch axis -------------------------------------------------------------


class _PathSubstep(NamedTuple):
    """One substep of the path."""

    substep: SubstepInput
    before: Any
    """State at the end of the substep before."""
    after: Any
    """State at its own end."""
    noise: Array
    """(n_w, lanes) process noise."""


def _gauss_newton_step(
    lowered: LoweredModel,
    adjoint: bool,
    prepared: Any,
    belief: Belief,
    inputs: ScanInputs,
    path: Path,
) -> tuple[Path, Belief, Belief, Array]:
    """One iteration: the new path, the beliefs about it at every substep and at the start, and the largest
    step (lanes,)."""
    bound = lowered.bind(prepared, adjoint=adjoint)
    error, jacobian = bound.prior(belief.mean, path.start)
    delta = -materialise(multiply_vector(jacobian, error))
    cov = congruence(jacobian, belief.cov)
    before = jax.tree.map(smoother_pass.shift_by_one, path.start, path.mean)
    own = _PathSubstep(inputs.substeps, before, path.mean, path.noise)
    filter_epoch = partial(_filter_epoch, bound)
    _, forward = lax.scan(filter_epoch, (delta, cov), (own, inputs.fast, inputs.slow))
    nothing = Information(jnp.zeros_like(delta), jnp.zeros_like(cov))
    smooth_epoch = partial(_smooth_epoch, bound)
    epochs = (own, inputs.fast, inputs.slow, forward)
    info, (found, noise, largest) = lax.scan(smooth_epoch, nothing, epochs, reverse=True)
    start, first = _move_state(bound, path.start, delta, cov, info)
    largest = jnp.maximum(jnp.max(largest, axis=(0, 1)), first)
    return Path(start.mean, found.mean, noise), found, start, largest


def _linearise_transition(bound: BoundModel, own: _PathSubstep) -> Any:
    """The defect of the path, the bands of F and G, and the process noise."""
    sigma = bound.process_noise(own.substep.dt)
    found = bound.transition(own.before, own.after, own.noise, own.substep.u, own.substep.dt)
    return *found, sigma


def _filter_substep(
    bound: BoundModel, carry: Any, own: _PathSubstep, samples: Any
) -> tuple[Any, _ForwardOutput]:
    """The linear filter over one substep."""
    delta, cov = carry
    transition = bound.lowered.transition
    defect, f, g, sigma = _linearise_transition(bound, own)
    forth = materialise(structured_matrix.multiply(transition.f_pattern, f, delta))
    back = materialise(structured_matrix.multiply(transition.g_pattern, g, own.noise))
    patterns = (transition.f_pattern, transition.g_pattern)
    cov = covariance_prediction.predicted_covariance(patterns, f, g, cov, sigma)
    if own.substep.excess is not None:
        cov = cov + diagonal_matrix(own.substep.excess)
    prior = UpdateAccumulator(cov, defect + forth - back, jnp.zeros_like(delta[0]))
    accumulator = prior
    linear = step.linearise(bound, own.after, own.substep.u, samples)
    for one in linear.values():
        accumulator, _ = step.apply_sensor(one, accumulator, adjoint=False)
    cov = linalg.symmetrise(accumulator.cov)
    return (accumulator.delta, cov), _ForwardOutput(prior, accumulator.delta, cov)


def _filter_epoch(bound: BoundModel, carry: Any, epoch_inputs: Any) -> tuple[Any, _ForwardOutput]:
    own, fast, slow = epoch_inputs

    def substep(carry: Any, substep_inputs: Any) -> tuple[Any, _ForwardOutput]:
        return _filter_substep(bound, carry, *substep_inputs)

    return substeps.scan_substeps(substep, carry, (own, fast), slow)


def _smooth_epoch(
    bound: BoundModel, info: Information, epoch_inputs: Any
) -> tuple[Information, Any]:
    own, fast, slow, forward = epoch_inputs

    def substep(info: Information, substep_inputs: Any) -> tuple[Information, Any]:
        (own, forward), samples = substep_inputs
        belief, largest = _move_state(bound, own.after, forward.delta, forward.cov, info)
        accumulator = forward.prior
        applied = []
        for one in step.linearise(bound, own.after, own.substep.u, samples).values():
            accumulator, saved = step.apply_sensor_saving(one, accumulator)
            applied.append(saved)
        for saved in reversed(applied):
            info = smoother_pass.information_before_rows(saved, info)
        info, noise = _information_before_transition(bound, own, info)
        return info, (belief, noise, largest)

    return substeps.scan_substeps_backward(substep, info, ((own, forward), fast), slow)


def _information_before_transition(
    bound: BoundModel, own: _PathSubstep, info: Information
) -> tuple[Information, Array]:
    """The information before a transition, and the most probable process noise of it, ``Q G' a``."""
    transition = bound.lowered.transition
    _, f, g, sigma = _linearise_transition(bound, own)
    transposed = structured_matrix.transpose_bands(g)
    back = transition.g_pattern.transposed
    drawn = materialise(structured_matrix.multiply(back, transposed, info.vector))
    is_diagonal = transition.has_diagonal_noise
    noise = sigma * drawn if is_diagonal else materialise(multiply_vector(sigma, drawn))
    return smoother_pass.pull_back(transition.f_pattern, f, info), noise


def _move_state(
    bound: BoundModel, mean: Any, delta: Array, cov: Array, info: Information
) -> tuple[Belief, Array]:
    """A state of the path moved to its most probable value, with its covariance there; and the size of the
    step in standard deviations, (lanes,)."""
    delta = delta + materialise(multiply_vector(cov, info.vector))
    cov = smoother_pass.smoothed_covariance(cov, info.matrix)
    deviations = jnp.abs(delta) / jnp.sqrt(linalg.diagonal(cov))
    largest = lax.stop_gradient(jnp.max(deviations, axis=0))
    moved, reset = bound.retraction(mean, delta)
    return Belief(moved, congruence(reset, cov)), largest
