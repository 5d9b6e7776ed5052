"""The iterated smoother: the most probable path of a whole run, by Gauss-Newton.

It minimises over the start and all process noise

    |local(x0, start)|^2 / P0 + sum |w|^2 / Q + sum |local(h(x), z)|^2 / R

with ``x = transition(x before, u, dt, w)``. Each iteration is one linear Kalman filter and one pass back
about the path so far; the path may miss the transition while it is on its way, and does not where it has
arrived. Rows that the filter's gates refused count no more.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf._support.errors import ModelError
from jaxekf.filtering import _covariance_algebra as covariance_algebra
from jaxekf.filtering import _lowered_path as lowered_path
from jaxekf.filtering import _smoother_pass as smoother_pass
from jaxekf.filtering import _step as step
from jaxekf.filtering import _substeps as substeps
from jaxekf.filtering import ekf, smoother
from jaxekf.filtering._covariance_algebra import Gained
from jaxekf.filtering._gating import Linear
from jaxekf.filtering._iterated_update import turned
from jaxekf.filtering._lowered_path import AboutSystem
from jaxekf.filtering._recursion import Given
from jaxekf.filtering._smoother_pass import Information
from jaxekf.filtering._step import Moment
from jaxekf.filtering.lowering import batched_vjp, structured_matrix
from jaxekf.filtering.lowering.lanes import stage
from jaxekf.filtering.lowering.reverse_only import reverse_only
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.smoother import SmootherOutput
from jaxekf.filtering.steps import Steps
from jaxekf.geometry import linalg


class Path(NamedTuple):
    """A path through a run: the start, and at every substep, leading axes (K, S), state and noise."""

    start: Any
    mean: Any
    noise: Array
    """(K, S, n_w) process noise of the transition that ends there."""


class IteratedOutput(NamedTuple):
    """A run smoothed by iteration."""

    filtered: Any
    """All that the filter left, linearised at its own estimates."""
    smoothed: Belief
    """At the end of each substep, leading axes (K, S)."""
    start: Belief
    """At the start of the run."""
    noise: Array
    """(K, S, n_w) the process noise that carries the path from each substep to the next."""
    moved: Array
    """(iterations,) the longest move of a state in each, in standard deviations of the smoothed one:
    small at the end where the iteration has converged."""


class _Forward(NamedTuple):
    """What the pass ahead leaves at a substep: errors counted from the path."""

    prior: Gained
    delta: Array
    cov: Array


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

    It begins at the smoothed path; samples that the filter's gates refused stay refused. Of the
    `iterations` of Gauss and Newton 3 to 5 are plenty for a tracker: look at `moved`. Options as in
    `run_smoother`.
    """
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], (params, belief, steps))
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
    """Many runs: every leaf of every argument carries the runs on its first axis, `moved` too.

    Raises `ModelError` for a model with heavy-tailed sensors (`jaxekf.robust`), and as
    `run_smoother_batch`.
    """
    if any(sensor.weighting is not None for sensor in model.sensors):
        raise ModelError(
            f"model '{model.name}': got a sensor with heavy tails, expected gates or none, for least"
            " squares know no tails; take run_smoother, or jaxekf.robust(model, 'gate')"
        )
    params, belief, steps = jax.tree.map(jnp.asarray, (params, belief, steps))
    first = smoother.run_smoother_batch(
        model, params, belief, steps, adjoint=adjoint, devices=devices
    )
    given = _used(first, steps)
    sample: Any = ekf.one_sample((given.moments.u, given.fast), 3)
    rows = sample[1] | ekf.one_sample(given.slow, 2)
    sizes: Any = ekf.one_sample((params, belief.mean), 1)
    ready = lowered_path.build(model, sizes[0], sizes[1], sample[0], rows)
    prepared = jax.vmap(ready.prepare, axis_size=steps.dt.shape[0])(params)
    noise_dim = ready.transition.noise.shape[1]
    dtype = belief.cov.dtype
    path = Path(
        first.start.mean, first.smoothed.mean, jnp.zeros((*steps.dt.shape, noise_dim), dtype)
    )
    trees = (prepared, belief, given)
    if adjoint:
        function = _lanes(ready, tuple(devices))
        trees = reverse_only(trees)
    else:
        function = partial(batched_vjp.on_lanes, partial(_iteration, ready, False))

    def iterate(carry: Any, _: None) -> Any:
        path, smoothed, start, longest = function(*trees, carry[0])
        return (path, smoothed, start), longest

    begun = (path, Belief(*first.smoothed), Belief(*first.start))
    (path, smoothed, start), moved = lax.scan(iterate, begun, None, length=iterations)
    return IteratedOutput(first.filtered, smoothed, start, path.noise, jnp.moveaxis(moved, 0, 1))


def _used(first: SmootherOutput, steps: Steps) -> Given:
    """What the filter was driven with, only rows that entered an update visible."""
    used = first.filtered.innovations

    def seen(sensors: Any) -> Any:
        return {name: rows._replace(mask=used[name].used) for name, rows in sensors.items()}

    moments = Moment(steps.dt, first.filtered.inputs)
    return Given(moments, seen(steps.fast), seen(steps.slow))


@lru_cache(maxsize=64)
def _lanes(system: AboutSystem, devices: tuple[Any, ...]) -> Any:
    return batched_vjp.with_own_derivative(devices, partial(_iteration, system, True))


# --- one block of runs, on lanes ----------------------------------------------------------------------


class _Place(NamedTuple):
    """A substep of the path."""

    moment: Moment
    before: Any
    after: Any
    noise: Array


def _iteration(
    system: AboutSystem, adjoint: bool, prepared: Any, belief: Belief, given: Given, path: Path
) -> tuple[Path, Belief, Belief, Array]:
    """One step of Gauss and Newton: the path after it, the beliefs about it, and the longest move."""
    away, changed = system.start(prepared["start"], belief.mean, path.start, adjoint=adjoint)
    delta = -stage(covariance_algebra.apply(changed, away))
    cov = turned(changed, belief.cov)
    before = jax.tree.map(smoother_pass.one_earlier, path.start, path.mean)
    places = _Place(given.moments, before, path.mean, path.noise)
    ahead = partial(_epoch_ahead, system, adjoint, prepared)
    _, forward = lax.scan(ahead, (delta, cov), (places, given.fast, given.slow))
    nothing = Information(jnp.zeros_like(delta), jnp.zeros_like(cov))
    back = partial(_epoch_back, system, adjoint, prepared)
    every = (places, given.fast, given.slow, forward)
    info, (found, noise, longest) = lax.scan(back, nothing, every, reverse=True)
    start, first = _moved(system, prepared, path.start, delta, cov, info, adjoint)
    farthest = jnp.maximum(jnp.max(longest, axis=(0, 1)), first)
    return Path(start.mean, found.mean, noise), found, start, farthest


def _linear(
    system: AboutSystem, prepared: Any, place: _Place, samples: Any, adjoint: bool
) -> list[Linear]:
    """The samples of an instant linearised at the path."""
    linear = {}
    for name, sample in samples.items():
        measurement = system.measurements[name]
        found = measurement(
            prepared[f"sensor {name}"], place.after, place.moment.u, sample, adjoint=adjoint
        )
        linear[name] = step.hide(measurement, *found, sample.mask)
    return list(linear.values())


def _transition(system: AboutSystem, prepared: Any, place: _Place, adjoint: bool) -> Any:
    """How far the path misses the transition, the bands of F and G, and the noise."""
    dt = place.moment.dt
    (sigma,) = system.transition.sigma(prepared["process noise"], dt, adjoint=adjoint)
    found = system.transition.piece(
        prepared["transition"],
        place.before,
        place.after,
        place.noise,
        place.moment.u,
        dt,
        adjoint=adjoint,
    )
    return *found, sigma


def _ahead(
    system: AboutSystem, prepared: Any, carry: Any, place: _Place, samples: Any, adjoint: bool
) -> tuple[Any, _Forward]:
    """The linear filter over one substep."""
    delta, cov = carry
    transition = system.transition
    missed, f, g, sigma = _transition(system, prepared, place, adjoint)
    forth = stage(structured_matrix.multiply(transition.state, f, delta))
    back = stage(structured_matrix.multiply(transition.noise, g, place.noise))
    cov = covariance_algebra.predicted(transition.state, transition.noise, f, g, cov, sigma)
    prior = Gained(cov, missed + forth - back, jnp.zeros_like(delta[0]))
    gained = prior
    for one in _linear(system, prepared, place, samples, adjoint):
        gained = step.take_block(one.slope, gained, one.rows, False)[0]
    cov = linalg.symmetrise(gained.cov)
    return (gained.delta, cov), _Forward(prior, gained.delta, cov)


def _epoch_ahead(
    system: AboutSystem, adjoint: bool, prepared: Any, carry: Any, at: Any
) -> tuple[Any, _Forward]:
    places, fast, slow = at

    def substep(carry: Any, at: Any) -> tuple[Any, _Forward]:
        place, samples = at
        return _ahead(system, prepared, carry, place, samples, adjoint)

    return substeps.over_substeps(substep, carry, (places, fast), slow)


def _epoch_back(
    system: AboutSystem, adjoint: bool, prepared: Any, info: Information, at: Any
) -> tuple[Information, Any]:
    places, fast, slow, forward = at

    def substep(info: Information, at: Any) -> tuple[Information, Any]:
        (place, forward), samples = at
        found = _moved(system, prepared, place.after, forward.delta, forward.cov, info, adjoint)
        gained = forward.prior
        taken = []
        for one in _linear(system, prepared, place, samples, adjoint):
            gained, kept = step.take_keeping(one.slope, gained, one.rows)
            taken.append((covariance_algebra.pattern_taken(one.slope, one.rows), kept))
        for slope, kept in reversed(taken):
            info = smoother_pass.before_rows(slope, kept, info)
        info, noise = _before(system, prepared, place, info, adjoint)
        return info, (found[0], noise, found[1])

    return substeps.over_substeps_back(substep, info, ((places, forward), fast), slow)


def _before(
    system: AboutSystem, prepared: Any, place: _Place, info: Information, adjoint: bool
) -> tuple[Information, Array]:
    """The information before a transition, and the most probable process noise of it, ``Q G' a``."""
    transition = system.transition
    _, f, g, sigma = _transition(system, prepared, place, adjoint)
    turned = structured_matrix.transpose(g)
    drawn = stage(structured_matrix.multiply(transition.noise.transposed, turned, info.vector))
    noise = sigma * drawn if transition.diagonal else stage(covariance_algebra.apply(sigma, drawn))
    return smoother_pass.carried(transition.state, f, info), noise


def _moved(
    system: AboutSystem,
    prepared: Any,
    mean: Any,
    delta: Array,
    cov: Array,
    info: Information,
    adjoint: bool,
) -> tuple[Belief, Array]:
    """A state of the path moved to where it is most probable, its covariance counted from there, and how
    many standard deviations it moved."""
    delta = delta + stage(covariance_algebra.apply(cov, info.vector))
    cov = smoother_pass.lessened(cov, info.matrix)
    longest = lax.stop_gradient(jnp.max(jnp.abs(delta) / jnp.sqrt(linalg.diagonal(cov)), axis=0))
    moved, reset = system.move(prepared["move"], mean, delta, adjoint=adjoint)
    return Belief(moved, turned(reset, cov)), longest
