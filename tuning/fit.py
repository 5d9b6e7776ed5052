"""The tuner: gradient steps over all training runs at once, judged on runs it does not learn from."""

import datetime
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from jaxekf import parameters
from jaxekf.errors import TuningError
from jaxekf.estimation import Run, provenance, read, require_float64
from jaxekf.kernels import jit
from jaxekf.model import Model, Parameters
from jaxekf.models import adapted, get_model
from jaxekf.parameters import as_arrays
from jaxekf.recording import Recording
from tuning import consistency
from tuning.data import Data, prepare_groups
from tuning.noise import Layout, layout, scaled, with_axes
from tuning.objectives import Objective, attitude_error, count, evaluate, parse, weights_of

_MOST_REJECTIONS = 10
_IMPROVEMENT = 1e-4
_SMALL_GAIN = 1e-5
_LONGEST_STEP = 1.0


class Iteration(NamedTuple):
    """One step of the tuner."""

    number: int
    training: float
    validation: float
    """NaN without validation runs."""
    rejected: bool
    """The objective or its gradient was not finite; the step was shortened."""


Progress = Callable[[Iteration, int], None]


@dataclass(frozen=True)
class Tuned:
    """What came out of a tuning."""

    model: Model
    params: Parameters
    """The best parameters, by validation where there is one."""
    start: Parameters
    objective: Objective
    best: Iteration
    history: tuple[Iteration, ...]
    stopped: str
    """Why the tuner stopped, in words."""
    scale: float
    """Factor by which all covariances were scaled after the fit so that errors match them."""
    layout: Layout
    origin: dict[str, Any] = field(default_factory=dict)

    @property
    def rejections(self) -> int:
        """Steps that were rejected because they were not finite."""
        return sum(step.rejected for step in self.history)

    def save(self, folder: Path | str) -> None:
        """Write `noise.toml` and `calibration.toml`, with units and where they came from."""
        parameters.save(folder, self.model, self.params, self.origin)


def _objective_value(
    model: Model,
    objective: Objective,
    where: Layout,
    free: Array,
    base: Parameters,
    data: Data,
    counts: dict[str, Array],
) -> Array:
    return evaluate(model, objective, where.from_free(free, base), data, counts)


_value = jit(_objective_value, static_argnums=(0, 1, 2))
_value_and_gradient = jit(jax.value_and_grad(_objective_value, 3), static_argnums=(0, 1, 2))


def tune(
    runs: Sequence[Run],
    *,
    validate: Sequence[Run] = (),
    model: str | Model = "loose",
    objective: Objective | str | None = None,
    free: Sequence[str] | None = None,
    start: Parameters | None = None,
    axes: str | None = None,
    iterations: int = 60,
    patience: int = 15,
    burn_in_s: float = 0.0,
    rescale: bool | None = None,
    optimiser: optax.GradientTransformation | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Tune noise, and calibration where asked, by gradient over all runs in one compiled call.

    `objective` is the attitude error unless given. `free` names what may change (default: all noise);
    `axes` gives what is free one deviation for all axes (`tied`), one for `each`, or a `full` matrix;
    None leaves it as the start has it. L-BFGS is the optimiser unless an optax one is given. The best
    parameters so far are kept, by the validation runs where there are any; the tuner stops when they
    have not improved for `patience` iterations. Steps that are not finite are rejected, shortened and
    counted. Ctrl-C ends the search and keeps the best so far.

    The error alone does not fix the common scale of Q, R and P0; with `rescale` (the default when the
    likelihood is not in the objective) they are scaled afterwards so that the training errors match
    their covariances.

    Raises `TuningError` where the problem is ill-posed, and what `estimate` raises for bad data.
    """
    require_float64()
    learnt, judging = read(runs), read(validate)
    chosen = adapted(get_model(model), [*learnt, *judging])
    aim = parse(objective) if isinstance(objective, str) else objective or attitude_error()
    base = as_arrays(chosen.parameters if start is None else start)
    if axes is not None:
        base = with_axes(chosen, base, axes, free)
    where = layout(chosen, base, free)
    _check_runs(runs, validate)
    need_truth = bool(aim.errors)
    training = prepare_groups(chosen, learnt, burn_in_s=burn_in_s, need_truth=need_truth)
    held_out = None
    if validate:
        held_out = prepare_groups(chosen, judging, burn_in_s=burn_in_s, need_truth=need_truth)
    search = _Search(chosen, aim, where, base, training, held_out)
    best_free, best, history, stopped = search.run(optimiser, iterations, patience, progress)
    params = where.from_free(best_free, base)
    scale = 1.0
    if rescale if rescale is not None else not aim.likelihood and "attitude" in training[0].truth:
        scale = consistency.scale(chosen, params, training)
        params = scaled(params, scale)
    origin = {
        "runs": [_name(run) for run in runs],
        "validation_runs": [_name(run) for run in validate],
        "objective": aim.describe(),
        "free": [leaf.name for leaf in where.leaves],
        "iterations": len(history),
        "best_iteration": best.number,
        "training_value": best.training,
        "covariance_scale": scale,
        "date": datetime.date.today().isoformat(),
        **provenance(),
    }
    if validate:
        origin["validation_value"] = best.validation
    return Tuned(chosen, params, base, aim, best, tuple(history), stopped, scale, where, origin)


def on_host(free: Array) -> Any:
    """The vector without its place: a gradient comes back shared among the devices, and a point found
    from it would be another argument to compile for."""
    return np.asarray(free)


def total_counts(groups: Sequence[Data], objective: Objective) -> dict[str, Array]:
    """What each term of the objective is the mean over, of all groups together."""
    found = [count(data, tuple(weights_of(objective))) for data in groups]
    return {name: sum((f[name] for f in found), jnp.zeros((), int)) for name in found[0]}


def _check_runs(runs: Sequence[Run], validate: Sequence[Run]) -> None:
    """A run that is learnt from cannot judge what was learnt."""
    both = sorted({_name(run) for run in runs} & {_name(run) for run in validate})
    if both:
        raise TuningError(
            f"got {both} among the training and the validation runs, expected different runs;"
            " leave each in one of them"
        )


def _name(run: Run) -> str:
    return run.name if isinstance(run, Recording) else Path(run).name


@dataclass
class _Search:
    """The optimiser's loop and what it works on."""

    model: Model
    objective: Objective
    layout: Layout
    base: Parameters
    training: tuple[Data, ...]
    validation: tuple[Data, ...] | None
    found: tuple[Array, Iteration, list[Iteration]] | None = None
    """The best so far, for an interrupted search."""

    @cached_property
    def training_counts(self) -> dict[str, Array]:
        """What the terms are the means over."""
        return total_counts(self.training, self.objective)

    @cached_property
    def validation_counts(self) -> dict[str, Array]:
        """The same of the validation runs."""
        return total_counts(self.validation or (), self.objective)

    def value_and_gradient(self, free: Array) -> tuple[float, Array]:
        counts, plain = self.training_counts, on_host(free)
        found = [
            _value_and_gradient(
                self.model, self.objective, self.layout, plain, self.base, data, counts
            )
            for data in self.training
        ]
        gradient = sum((np.asarray(gradient) for _, gradient in found), np.zeros(free.shape))
        return float(sum(value for value, _ in found)), jnp.asarray(gradient)

    def validation_value(self, free: Array) -> float:
        if self.validation is None:
            return float("nan")
        counts, plain = self.validation_counts, on_host(free)
        return float(
            sum(
                _value(self.model, self.objective, self.layout, plain, self.base, data, counts)
                for data in self.validation
            )
        )

    def run(
        self,
        optimiser: optax.GradientTransformation | None,
        iterations: int,
        patience: int,
        progress: Progress | None,
    ) -> tuple[Array, Iteration, list[Iteration], str]:
        """Step until done; the best free vector, its iteration, the history and why it stopped."""
        try:
            return self._step(optimiser, iterations, patience, progress)
        except KeyboardInterrupt:
            if self.found is None:
                raise
            return *self.found, "interrupted; the best so far is kept"

    def _step(
        self,
        optimiser: optax.GradientTransformation | None,
        iterations: int,
        patience: int,
        progress: Progress | None,
    ) -> tuple[Array, Iteration, list[Iteration], str]:
        walk = _Walk(self.layout.to_free(self.base), optimiser)
        history: list[Iteration] = []
        best_judged, since = float("inf"), 0
        stopped = f"the {iterations} iterations asked for are done"
        for number in range(iterations):
            value, gradient = self.value_and_gradient(walk.candidate)
            finite = np.isfinite(value) and bool(jnp.all(jnp.isfinite(gradient)))
            held = self.validation_value(walk.candidate) if finite else float("nan")
            step = Iteration(number, value, held, not finite)
            history.append(step)
            if progress is not None:
                progress(step, iterations)
            judged = value if self.validation is None else held
            if finite and judged < best_judged:
                if judged < best_judged - _IMPROVEMENT * abs(judged):
                    since = number
                best_judged = judged
                self.found = (walk.candidate, step, history)
            if self.found is None:
                raise TuningError(
                    f"got an objective of {judged} or a gradient that is not finite at the start,"
                    " expected finite ones; start from other noise or check the data"
                )
            if number - since >= patience:
                stopped = f"no improvement in {patience} iterations"
                break
            if reason := walk.move(value, gradient, finite):
                stopped = reason
                break
        if self.found is None:
            raise TuningError(f"got {iterations} iterations, expected at least one; ask for more")
        return *self.found, stopped


class _Walk:
    """Where the optimiser stands and where it looks next.

    The default is L-BFGS with backtracking: the direction is optax's, a step is halved until the
    objective falls, and no number moves by more than `_LONGEST_STEP` (an e-fold for a logarithm). An
    optax optimiser of the caller's own is followed as it is, but for steps that are not finite.
    """

    def __init__(self, free: Array, optimiser: optax.GradientTransformation | None) -> None:
        self.monotone = optimiser is None
        self.optimiser = optimiser or optax.chain(optax.scale_by_lbfgs(), optax.scale(-1.0))
        self.state = self.optimiser.init(free)
        self.candidate = self.stand = free
        self.value = float("inf")
        self.gradient = self.change = jnp.zeros_like(free)
        self.rejections = self.small_gains = 0

    def move(self, value: float, gradient: Array, finite: bool) -> str:
        """Take or refuse the candidate and choose the next; a reason to stop, or nothing."""
        if not finite or (self.monotone and not self._falls(value)):
            self.rejections += 1
            if self.rejections >= _MOST_REJECTIONS:
                return (
                    "no step along the gradient lowers the objective any more"
                    if finite
                    else f"{_MOST_REJECTIONS} steps in a row failed"
                )
            self.change = (0.5 if finite else 0.25) * self.change
            self.candidate = self.stand + self.change
            return ""
        small = self.value - value < _SMALL_GAIN * max(abs(value), _SMALL_GAIN)
        self.small_gains = self.small_gains + 1 if small and self.monotone else 0
        if self.small_gains >= 2:
            return "converged"
        self.rejections = 0
        self.stand, self.value, self.gradient = self.candidate, value, gradient
        update, self.state = self.optimiser.update(gradient, self.state, self.stand)
        self.change = jnp.asarray(update)
        if self.monotone:
            if float(self.change @ gradient) >= 0.0:
                self.change = -gradient
            longest = float(jnp.max(jnp.abs(self.change)))
            if longest == 0.0:
                return "converged"
            self.change = self.change * min(1.0, _LONGEST_STEP / longest)
        self.candidate = self.stand + self.change
        return ""

    def _falls(self, value: float) -> bool:
        """Armijo's condition of sufficient decrease."""
        if not np.isfinite(self.value):
            return True
        return value <= self.value + 1e-4 * float(self.change @ self.gradient)
