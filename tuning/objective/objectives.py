"""Objectives of the tuner: one differentiable number over all runs at once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.compilation import require_float64
from jaxekf._support.errors import TuningError
from jaxekf.estimation import parameters
from jaxekf.estimation.batch import evaluate_outputs, sharing_devices
from jaxekf.filtering import arguments, ekf
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.smoother import run_smoother_batch
from jaxekf.geometry import manifold
from tuning.objective.data import Data
from tuning.parametrisation.truth_frame import TruthFrame, corrected

_WEIGHTS = ("likelihood", "truth", "prior")
_DEGREES_SQUARED = float(np.rad2deg(1.0) ** 2)


@dataclass(frozen=True)
class Objective:
    """A weighted sum of mean squared errors against truth and of innovation likelihood.

    ``sum(weight * mean |error|^2) - likelihood * mean(log-likelihood of a measured row)``, and the
    weighted likelihood of the truth and prior. Attitude errors are geodesic angles in degrees, rate errors
    in deg/s, position errors in mm. Add two objectives to combine them.

    Examples
    --------
    >>> import tuning
    >>> position = tuning.Objective(errors=(("position", 1.0),))
    >>> (tuning.attitude_error() + 0.1 * position).describe()
    '1 * mean squared attitude error + 0.1 * mean squared position error'
    """

    errors: tuple[tuple[str, float], ...] = ()
    likelihood: float = 0.0
    """Weight of the innovation likelihood."""
    truth: float = 0.0
    """Weight of the likelihood of the true attitude under the estimate."""
    prior: float = 0.0
    """Weight of the prior (see `Free.prior`), as a number of rows: 1 with a likelihood of 1 gives the most
    probable parameters."""
    smoothed: bool = False
    """Whether errors are those of the smoothed estimate."""

    def __post_init__(self) -> None:
        weights = [weight for _, weight in self.errors]
        weights += [self.likelihood, self.truth, self.prior]
        if not all(0.0 <= weight < float("inf") for weight in weights):
            raise TuningError(
                f"got the weights {weights}, expected numbers of at least 0; an objective is"
                " minimised, so that a negative weight asks for the worst estimate"
            )

    def __add__(self, other: "Objective") -> "Objective":
        sums = {name: getattr(self, name) + getattr(other, name) for name in _WEIGHTS}
        smoothed = self.smoothed or other.smoothed
        return Objective(self.errors + other.errors, **sums, smoothed=smoothed)

    def __mul__(self, factor: float) -> "Objective":
        scaled = tuple((name, weight * factor) for name, weight in self.errors)
        weights = {name: getattr(self, name) * factor for name in _WEIGHTS}
        return replace(self, errors=scaled, **weights)

    __rmul__ = __mul__

    def describe(self) -> str:
        """The sum in words."""
        terms = [f"{weight:g} * mean squared {name} error" for name, weight in self.errors]
        if self.likelihood:
            terms.append(f"{self.likelihood:g} * negative innovation log-likelihood")
        if self.truth:
            terms.append(f"{self.truth:g} * negative log-likelihood of the true attitude")
        if self.prior:
            terms.append(f"{self.prior:g} * prior")
        return " + ".join(terms) + (", smoothed" if self.smoothed else "")

    @property
    def errors_alone(self) -> bool:
        """Whether no likelihood counts, so that the scale of all covariances and much else is flat."""
        return bool(self.errors) and not self.likelihood and not self.truth

    @property
    def needs_truth(self) -> bool:
        """Whether an encoder is needed."""
        return bool(self.errors) or self.truth > 0.0


def attitude_error() -> Objective:
    """Mean squared geodesic angle to the encoder, deg^2.

    Examples
    --------
    >>> import tuning
    >>> (tuning.attitude_error() + 0.1 * tuning.innovation_likelihood()).describe()
    '1 * mean squared attitude error + 0.1 * negative innovation log-likelihood'
    """
    return Objective((("attitude", 1.0),))


def rate_error() -> Objective:
    """Mean squared rate error, (deg/s)^2.

    Examples
    --------
    >>> import tuning
    >>> (2.0 * tuning.rate_error()).describe(), tuning.rate_error().needs_truth
    ('2 * mean squared rate error', True)
    """
    return Objective((("rate", 1.0),))


def innovation_likelihood() -> Objective:
    """Negative log-likelihood of the innovations, per measured row; needs no truth.

    Examples
    --------
    >>> import tuning
    >>> tuning.innovation_likelihood().describe(), tuning.innovation_likelihood().needs_truth
    ('1 * negative innovation log-likelihood', False)
    """
    return Objective(likelihood=1.0)


NAMED = {
    "attitude": attitude_error(),
    "rate": rate_error(),
    "position": Objective((("position", 1.0),)),
    "likelihood": innovation_likelihood(),
    "truth": Objective(truth=1.0),
    "map": Objective(likelihood=1.0, prior=1.0),
    "prior": Objective(prior=1.0),
}
"""``truth`` is the likelihood of the true attitude, ``map`` gives the most probable parameters."""


def parse(text: str) -> Objective:
    """An objective from ``attitude``, or from a weighted sum such as ``attitude+0.1*likelihood``."""
    total = Objective()
    for term in text.split("+"):
        weight, _, name = term.strip().rpartition("*")
        try:
            total = total + NAMED[name.strip()] * (float(weight) if weight else 1.0)
        except (KeyError, ValueError):
            raise TuningError(
                f"got the objective '{text}', expected a sum of weight*name with the names"
                f" {sorted(NAMED)}; for instance attitude+0.1*likelihood"
            ) from None
    return total


def as_objective(given: Objective | str | None, *, smooth: bool = False) -> Objective:
    """An objective from itself or its text, the attitude error unless given; of the smoothed estimate with
    `smooth`."""
    aim = parse(given) if isinstance(given, str) else given or attitude_error()
    return replace(aim, smoothed=smooth or aim.smoothed)


def shared(params: Parameters, data: Data) -> Parameters:
    """The same parameters for each run of the data."""
    return parameters.for_runs(params, data.setup, data.steps.dt.shape[0])


def run_batch(
    model: Model, every: Parameters, data: Data, keep: ekf.Keep = "means", *, smooth: bool = False
) -> ekf.FilterOutput:
    """The filter over all runs, `every` with the parameters of each; with `smooth` the updated beliefs are
    the smoothed ones."""
    belief = Belief(data.means, jax.vmap(model.initial_covariance)(every))
    given, devices = (model, every, belief, data.steps), sharing_devices()
    if not smooth:
        return ekf.run_filter_batch(*given, keep=keep, devices=devices)
    found = run_smoother_batch(*given, devices=devices)
    return found.filtered._replace(
        instants=found.filtered.instants._replace(updated=found.smoothed)
    )


def output_values(model: Model, every: Parameters, output: ekf.FilterOutput, name: str) -> Any:
    """One of the model's outputs at every instant, leading axes (runs, K, S)."""

    def of_run(params: Parameters, means: Any, inputs: Any) -> Any:
        def value(x: Any, u: Any) -> Any:
            return model.output(name).value(x, u, params)

        return jax.vmap(jax.vmap(value))(means, inputs)

    return jax.vmap(of_run)(every, output.instants.updated.mean, output.inputs)


def evaluate(
    model: Model,
    objective: Objective,
    params: Parameters,
    data: Data,
    counts: dict[str, Array] | None = None,
) -> Array:
    """The objective of all runs with the same parameters, a scalar with a gradient to each of them.

    Samples of all runs are pooled, so that a longer run has more weight.

    Parameters
    ----------
    model, objective, params
        The model, the objective, and one set of parameters for all runs.
    data
        The runs, of `prepare`.
    counts
        If `data` is one group of several, those of `count` over all groups: the values of the groups
        then add up to that of all.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> model, aim = jaxekf.get_model("loose"), tuning.innovation_likelihood()
    >>> data = tuning.prepare(model, jaxekf.demo.paths(("free-1", "free-2")))
    >>> value = jaxekf.jit(lambda params: tuning.evaluate(model, aim, params, data))
    >>> small, large = (tuning.scaled(model.parameters, factor) for factor in (0.1, 10.0))
    >>> bool(value(model.parameters) < min(value(small), value(large)))
    True
    """
    require_float64()
    params = arguments.parameters(model, params, check_shapes=False)
    return evaluate_each(model, objective, shared(params, data), data, counts)


def evaluate_each(
    model: Model,
    objective: Objective,
    every: Parameters,
    data: Data,
    counts: dict[str, Array] | None = None,
) -> Array:
    """As `evaluate`, with the parameters of each run on the first axis of every leaf."""
    weights = weights_of(objective)
    found = terms_each(model, every, data, tuple(weights), counts, smooth=objective.smoothed)
    return sum((weight * found[name] for name, weight in weights.items()), jnp.zeros(()))


def weights_of(objective: Objective) -> dict[str, float]:
    """Weight of each term of an objective, by name."""
    weights: dict[str, float] = {}
    for name, weight in objective.errors:
        weights[name] = weights.get(name, 0.0) + weight
    others = {"likelihood": objective.likelihood, "truth": objective.truth}
    return weights | {name: weight for name, weight in others.items() if weight}


def count(data: Data, names: Sequence[str]) -> dict[str, Array]:
    """Number of samples that each term is the mean over: judged instants, visible rows for the likelihood.

    With NumPy arrays (`tuning.objective.data.on_host`) nothing is compiled.
    """
    found = {}
    for name in names:
        if name == "likelihood":
            found[name] = visible_rows(data)
        elif name == "truth" and "attitude" in data.truth:
            found[name] = data.truth["attitude"].judged.sum()
        elif name in data.truth:
            found[name] = data.truth[name].judged.sum()
    return found


def terms_each(
    model: Model,
    every: Parameters,
    data: Data,
    names: tuple[str, ...],
    counts: dict[str, Array] | None = None,
    *,
    smooth: bool = False,
) -> dict[str, Array]:
    """Single terms of an objective, unweighted, from one run of the filter.

    An output's name is its mean squared error, ``likelihood`` for the negative mean log-likelihood
    of a measured row, ``truth`` for that of the true attitude under the estimate. `counts` is as in
    `evaluate`.
    """
    keep: ekf.Keep = "estimates" if "truth" in names else "means"
    output = run_batch(model, every, data, keep, smooth=smooth)
    counts = count(data, names) if counts is None else counts
    found: dict[str, Array] = {}
    for name in names:
        if name == "likelihood":
            likelihood = jnp.where(data.counted, output.instants.log_likelihood, 0.0)
            total = -jnp.sum(likelihood)
        elif name == "truth":
            total = _truth_unlikelihood(model, every, output, data)
        else:
            error = output_error(model, every, output, data, name)
            judged = data.truth[name].judged
            squared = jnp.sum(jnp.where(judged, jnp.sum(error * error, axis=-1), 0.0))
            total = _scale(model, name) * squared
        found[name] = total / jnp.maximum(counts[name], 1)
    return found


def _truth_unlikelihood(
    model: Model, every: Parameters, output: ekf.FilterOutput, data: Data
) -> Array:
    """Sum of the negative log-likelihoods of the true attitudes under the estimated ones."""
    error, cov = error_and_covariance(model, every, output, data)
    judged = data.truth["attitude"].judged
    factor = jnp.linalg.cholesky(cov)
    white = jax.scipy.linalg.solve_triangular(factor, error[..., None], lower=True)[..., 0]
    logs = jnp.sum(jnp.log(jnp.diagonal(factor, axis1=-2, axis2=-1)), axis=-1)
    each = 0.5 * jnp.sum(white * white, axis=-1) + logs + 1.5 * jnp.log(2.0 * jnp.pi)
    return jnp.sum(jnp.where(judged, each, 0.0))


def error_and_covariance(
    model: Model, every: Parameters, output: ekf.FilterOutput, data: Data
) -> tuple[Array, Array]:
    """Attitude errors (runs, K, S, 3) and their covariances; the identity at other instants."""
    error = output_error(model, every, output, data, "attitude")
    _, cov = evaluate_outputs(model, every, output)["attitude"]
    judged = data.truth["attitude"].judged
    eye = jnp.broadcast_to(jnp.eye(cov.shape[-1]), cov.shape)
    return error, jnp.where(judged[..., None, None], cov, eye)


def output_error(
    model: Model, every: Parameters, output: ekf.FilterOutput, data: Data, name: str
) -> Array:
    """Error vector of an output against truth, (runs, K, S, d), in the output's own frame."""
    if name not in data.truth:
        raise TuningError(
            f"got an objective on '{name}', expected one of {sorted(data.truth)} that model"
            f" '{model.name}' puts out and the encoder knows; choose another objective"
        )
    space = model.output(name).space
    values, truth = output_values(model, every, output, name), data.truth[name]
    true = truth.value
    if every.truth:

        def there(frame: TruthFrame, *known: Array) -> Array:
            return corrected(frame, name, *known)

        over = jax.vmap(jax.vmap(there, in_axes=(None, 0, 0, 0)), in_axes=(None, 0, 0, 0))
        true = jax.vmap(over)(every.truth, truth.value, truth.first, truth.second)

    def error(value: Any, truth: Any) -> Array:
        return manifold.local(space, value, truth)

    return jax.vmap(jax.vmap(jax.vmap(error)))(values, true)


def _scale(model: Model, name: str) -> float:
    """From the squared unit of an output to deg^2, (deg/s)^2 or mm^2."""
    unit = manifold.error_units(model.output(name).space)[0]
    return _DEGREES_SQUARED if unit.startswith("rad") else 1e6 if unit == "m" else 1.0


def visible_rows(data: Data) -> Array:
    """Number of rows whose likelihood counts."""
    total: Any = np.zeros((), int)
    for name, rows in (data.steps.fast | data.steps.slow).items():
        counted = data.counted if name in data.steps.fast else data.counted[:, :, -1]
        total = total + (rows.mask & counted[..., None]).sum()
    return total
