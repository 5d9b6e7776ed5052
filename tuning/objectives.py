"""What the tuner minimises, as one differentiable number over all runs at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf import ekf, manifold, parameters
from jaxekf.errors import TuningError
from jaxekf.estimation import sharing_devices
from jaxekf.model import Belief, Model, Parameters
from tuning.data import Data

_DEGREES_SQUARED = float(np.rad2deg(1.0) ** 2)


@dataclass(frozen=True)
class Objective:
    """A weighted sum of mean squared errors against truth and of innovation likelihood.

    ``sum(weight * mean |error|^2) - likelihood * mean(log-likelihood of a measured row)``; attitude
    errors are geodesic angles in degrees, rate errors in deg/s, position errors in mm. Add two objectives
    to combine them.
    """

    errors: tuple[tuple[str, float], ...] = ()
    likelihood: float = 0.0

    def __post_init__(self) -> None:
        weights = [weight for _, weight in self.errors] + [self.likelihood]
        if not all(0.0 <= weight < float("inf") for weight in weights):
            raise TuningError(
                f"got the weights {weights}, expected numbers of at least 0; an objective is"
                " minimised, so that a negative weight asks for the worst estimate"
            )

    def __add__(self, other: "Objective") -> "Objective":
        return Objective(self.errors + other.errors, self.likelihood + other.likelihood)

    def __mul__(self, factor: float) -> "Objective":
        scaled = tuple((name, weight * factor) for name, weight in self.errors)
        return Objective(scaled, self.likelihood * factor)

    __rmul__ = __mul__

    def describe(self) -> str:
        """The sum in words."""
        terms = [f"{weight:g} * mean squared {name} error" for name, weight in self.errors]
        if self.likelihood:
            terms.append(f"{self.likelihood:g} * negative innovation log-likelihood")
        return " + ".join(terms)


def attitude_error() -> Objective:
    """Mean squared geodesic angle to the encoder, deg^2."""
    return Objective((("attitude", 1.0),))


def rate_error() -> Objective:
    """Mean squared rate error, (deg/s)^2."""
    return Objective((("rate", 1.0),))


def position_error() -> Objective:
    """Mean squared position error, mm^2."""
    return Objective((("position", 1.0),))


def innovation_likelihood() -> Objective:
    """Negative log-likelihood of the innovations, per measured row; needs no truth."""
    return Objective(likelihood=1.0)


NAMED = {
    "attitude": attitude_error,
    "rate": rate_error,
    "position": position_error,
    "likelihood": innovation_likelihood,
}


def parse(text: str) -> Objective:
    """An objective from ``attitude``, or from a weighted sum such as ``attitude+0.1*likelihood``."""
    total = Objective()
    for term in text.split("+"):
        weight, _, name = term.strip().rpartition("*")
        try:
            total = total + NAMED[name.strip()]() * (float(weight) if weight else 1.0)
        except (KeyError, ValueError):
            raise TuningError(
                f"got the objective '{text}', expected a sum of weight*name with the names"
                f" {sorted(NAMED)}; for instance attitude+0.1*likelihood"
            ) from None
    return total


def run_batch(
    model: Model, params: Parameters, data: Data, keep: ekf.Keep = "means"
) -> ekf.FilterOutput:
    """The filter over all runs with shared parameters."""
    runs = data.steps.dt.shape[0]
    every = parameters.for_runs(params, data.setup, runs)
    cov = jax.vmap(model.initial_covariance)(every)
    belief = Belief(data.means, cov)
    return ekf.run_filter_batch(
        model, every, belief, data.steps, keep=keep, devices=sharing_devices()
    )


def output_values(
    model: Model, params: Parameters, setup: Any, output: ekf.FilterOutput, name: str
) -> Any:
    """One of the model's outputs at every instant, leading axes (runs, K, S)."""

    def of_run(setup: Any, means: Any, inputs: Any) -> Any:
        def value(x: Any, u: Any) -> Any:
            return model.output(name).value(x, u, params._replace(setup=setup))

        return jax.vmap(jax.vmap(value))(means, inputs)

    runs = output.instants.log_likelihood.shape[0]
    return jax.vmap(of_run, axis_size=runs)(setup, output.instants.updated.mean, output.inputs)


def evaluate(
    model: Model,
    objective: Objective,
    params: Parameters,
    data: Data,
    counts: dict[str, Array] | None = None,
) -> Array:
    """The objective of all runs, a scalar with a gradient to every parameter.

    Samples of all runs are pooled, so that a longer run weighs more. Where `data` is one group of several,
    `counts` are those of `count` over all groups: the values of the groups then add up to that of all.
    """
    weights = weights_of(objective)
    found = terms(model, params, data, tuple(weights), counts)
    return sum((weight * found[name] for name, weight in weights.items()), jnp.zeros(()))


def weights_of(objective: Objective) -> dict[str, float]:
    """Weight of each term of an objective, by name."""
    weights: dict[str, float] = {}
    for name, weight in objective.errors:
        weights[name] = weights.get(name, 0.0) + weight
    if objective.likelihood:
        weights["likelihood"] = objective.likelihood
    return weights


def count(data: Data, names: Sequence[str]) -> dict[str, Array]:
    """What each term is the mean over: judged instants, and for the likelihood visible rows."""
    found = {}
    for name in names:
        if name == "likelihood":
            found[name] = _visible_rows(data)
        elif name in data.truth:
            found[name] = jnp.sum(data.truth[name].judged)
    return found


def terms(
    model: Model,
    params: Parameters,
    data: Data,
    names: tuple[str, ...],
    counts: dict[str, Array] | None = None,
) -> dict[str, Array]:
    """Single terms of an objective, unweighted, from one run of the filter.

    An output's name stands for its mean squared error, ``likelihood`` for the negative mean
    log-likelihood of a visible row. `counts` as in `evaluate`.
    """
    output = run_batch(model, params, data)
    counts = count(data, names) if counts is None else counts
    found: dict[str, Array] = {}
    for name in names:
        if name == "likelihood":
            likelihood = jnp.where(data.counted, output.instants.log_likelihood, 0.0)
            found[name] = -jnp.sum(likelihood) / jnp.maximum(counts[name], 1)
            continue
        error = output_error(model, params, output, data, name)
        judged = data.truth[name].judged
        squared = jnp.sum(jnp.where(judged, jnp.sum(error * error, axis=-1), 0.0))
        found[name] = _scale(model, name) * squared / jnp.maximum(counts[name], 1)
    return found


def output_error(
    model: Model, params: Parameters, output: ekf.FilterOutput, data: Data, name: str
) -> Array:
    """Error vector of an output against truth, (runs, K, S, d), in the output's own frame."""
    if name not in data.truth:
        raise TuningError(
            f"got an objective on '{name}', expected one of {sorted(data.truth)} that model"
            f" '{model.name}' puts out and the encoder knows; choose another objective"
        )
    space = model.output(name).space
    values = output_values(model, params, data.setup, output, name)

    def error(value: Any, truth: Any) -> Array:
        return manifold.local(space, value, truth)

    return jax.vmap(jax.vmap(jax.vmap(error)))(values, data.truth[name].value)


def _scale(model: Model, name: str) -> float:
    """From the squared unit of an output to deg^2, (deg/s)^2 or mm^2."""
    unit = manifold.error_units(model.output(name).space)[0]
    return _DEGREES_SQUARED if unit.startswith("rad") else 1e6 if unit == "m" else 1.0


def _visible_rows(data: Data) -> Array:
    """Number of rows whose likelihood counts."""
    total = jnp.zeros((), int)
    for name, rows in (data.steps.fast | data.steps.slow).items():
        counted = data.counted if name in data.steps.fast else data.counted[:, :, -1]
        total = total + jnp.sum(rows.mask & counted[..., None])
    return total
