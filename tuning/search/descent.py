"""The tuner's loop: step, validate, keep the best, and go on after a stop."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import optax

from jaxekf._support.errors import TuningError
from jaxekf.recordings.types import Flags, Floats
from tuning.objective.objectives import Objective
from tuning.results.tuned import Iteration, Progress
from tuning.search._line_search import LineSearch
from tuning.search.evaluation import Evaluation, on_host

_IMPROVEMENT = 1e-4
_STATE = (
    "last_improvement",
    "iterations",
    "evaluations",
    "filterings",
    "fixed",
    "stopped",
    "kept",
    "jumps",
)
_ERROR_SHARE = 5e-3
"""Share of a mean squared error that counts as one unit of log-likelihood."""
_LEAST_EVIDENCE = 3e-3
"""Gain of log-likelihood, of all rows together, that is not worth another step."""


class Best(NamedTuple):
    """Best point so far."""

    free: Any
    step: Iteration


class Trial(NamedTuple):
    """The search as it was before some numbers were fixed to see what that costs."""

    best: Best
    fixed: Flags
    last: int
    """The number that was added last."""


@dataclass
class Descent(Evaluation):
    """A search by gradient, or by Fisher scoring, from one start."""

    iterations: int
    """Largest number of iterations."""
    optimiser: optax.GradientTransformation | None = None
    """None for L-BFGS."""
    fisher: bool = False
    """Whether to step by Fisher scoring; for an objective of likelihood and prior."""
    keep: Callable[[dict[str, Any]], None] | None = None
    """Called after each step with the state of the search."""
    best: Best | None = None
    history: list[Iteration] = field(default_factory=list)
    stopped: str = ""
    """Reason for the end; empty before it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.line_search = self._line_search(self.start)
        self.last_improvement = 0
        self.fallback: Best | None = None
        self.trial: Trial | None = None
        self.kept = np.zeros(len(self.start), bool)
        self.jumps = 0

    def _line_search(self, free: Any) -> LineSearch:
        # A small part of the mean of a likelihood would be a large part of the evidence for a parameter.
        weight = self.objective.likelihood + self.objective.truth
        least = _LEAST_EVIDENCE * weight / self.rows if weight else None
        direction = self.scoring_step if self.fisher else None
        return LineSearch(on_host(free), self.optimiser, least, direction)

    def value_and_gradient(self, free: Any) -> tuple[float, Floats]:
        """Objective of the training runs and its gradient (n,), prior included."""
        return self.value_and_score(free) if self.fisher else super().value_and_gradient(free)

    def run(self, patience: int, progress: Progress | None) -> str:
        """Step to the end; return the reason for it."""
        try:
            self.stopped = self.stopped or self._step(patience, progress)
        except KeyboardInterrupt:
            self.interrupt()
        return self.stopped

    def interrupt(self) -> None:
        """Stop with the best so far; raises `KeyboardInterrupt` if there is none."""
        self.best = self.best or self.fallback
        if self.best is None:
            raise KeyboardInterrupt
        self.stopped = "interrupted; the best so far is kept"

    def warm(
        self,
        steps: int,
        keep: Callable[[dict[str, Any]], None] | None = None,
        state: dict[str, Any] | None = None,
    ) -> None:
        """Move the start by some steps of Fisher scoring on the likelihood.

        Errors are flat far from their minimum, but the likelihood still has a slope there. `keep` is called
        after each step with the state, which can be given back as `state`.
        """
        objective = Objective(likelihood=1.0, prior=1.0)
        problem = (self.model, objective, self.layout, self.base, self.training, None, steps)
        other = Descent(*problem, fisher=True, width=self.width)
        other.begin_at(self.line_search.candidate)
        other.keep = keep
        if state:
            other.restore(state)
        other.run(steps, None)
        if "interrupted" in other.stopped:
            raise KeyboardInterrupt
        assert other.best is not None
        self.begin_at(other.best.free)
        self.evaluations += other.evaluations
        self.filterings += other.filterings

    def begin_at(self, free: Any) -> None:
        """Begin at another point than the start; the prior stays about the start."""
        self.line_search = self._line_search(free)

    @property
    def evidence(self) -> float:
        """Change of the objective that is worth one unit of log-likelihood."""
        weight = (self.objective.likelihood + self.objective.truth) / self.rows
        if weight and not self.objective.errors:
            return weight
        value = 1.0 if self.best is None else abs(self.best.step.training)
        return max(weight, _ERROR_SHARE * value)

    def probe(self, free: Any) -> float:
        """Objective of the training runs at a point of no search, by a program that is compiled already."""
        if not self.fisher:
            return self.value_and_gradient(free)[0]
        self.filterings += 1
        return self.value(free)

    def jump(self, free: Any) -> None:
        """Go on from a point that is better than the best so far."""
        self.begin_at(free)
        self.jumps += 1
        self._go_on()

    def _go_on(self) -> None:
        self.last_improvement, self.stopped = len(self.history), ""
        # Enough to recover after a few numbers moved at once.
        self.iterations = max(self.iterations, len(self.history) + 10)

    def restart(self, fixed: Flags) -> None:
        """Go on from the best with more numbers fixed at their initial values."""
        assert self.best is not None
        self.fixed = fixed
        free = np.where(fixed, self.start, on_host(self.best.free))
        self.line_search = self._line_search(free)
        self.fallback = self.best._replace(free=free)
        self.best = None
        self._go_on()

    def try_fixing(self, fixed: Flags, last: int) -> None:
        """`restart`; `judge_trial` decides whether these numbers stay fixed."""
        assert self.best is not None
        self.trial = Trial(self.best, self.fixed, last)
        self.restart(fixed)

    def judge_trial(self, bound: Callable[[int], float]) -> None:
        """End a trial: keep its result, or go back if fixing its numbers cost more than `bound` of their
        count, in log-likelihood; the last of them is then kept."""
        if self.trial is None:
            return
        best, fixed, last = self.trial
        assert self.best is not None
        allowed = bound(int(self.fixed.sum() - fixed.sum())) * self.evidence
        self.trial = None
        if self.best.step.training - best.step.training > allowed:
            self.best, self.fixed = best, fixed
            self.kept[last] = True

    def _step(self, patience: int, progress: Progress | None) -> str:
        while len(self.history) < self.iterations:
            if not self.history and not self.fisher and self.validation is not None:
                value, gradient, held = self._first()
            else:
                value, gradient = self.value_and_gradient(self.line_search.candidate)
                held = None
            if reason := self.advance(value, gradient, patience, progress, held):
                return reason
            if self.keep is not None:
                self.keep(self.state_dict())
        if self.best is None:
            raise TuningError(
                f"got {self.iterations} iterations, expected at least one; ask for more"
            )
        return self.all_done

    def _first(self) -> tuple[float, Floats, float]:
        """Value, gradient and validation value of the first candidate, in two threads: the compiler takes
        most of the time, and can work on both programs at once."""
        candidate = self.line_search.candidate
        # Traced before the other thread begins, so that the compiler begins with the larger program.
        self.trace_gradient(candidate)
        with ThreadPoolExecutor(1) as other:
            held = other.submit(self.validation_value, candidate)
            value, gradient = self.value_and_gradient(candidate)
            return value, gradient, held.result()

    @property
    def all_done(self) -> str:
        """Reason for the end after the last iteration."""
        return f"the {self.iterations} iterations asked for are done"

    def advance(
        self,
        value: float,
        gradient: Floats,
        patience: int,
        progress: Progress | None,
        held: float | None = None,
    ) -> str:
        """Record the candidate with its value and gradient, and choose the next one.

        `held` is its validation value if that is known. Returns a reason to stop, or an empty string.
        """
        candidate = self.line_search.candidate
        finite = np.isfinite(value) and bool(np.all(np.isfinite(gradient)))
        if not finite:
            held = float("nan")
        elif held is None:
            held = self.validation_value(candidate)
        step = Iteration(len(self.history), value, held, not finite)
        self.record(step, candidate, progress)
        if step.number - self.last_improvement >= patience:
            return f"no improvement in {patience} iterations"
        return self.line_search.move(value, gradient, bool(finite))

    def record(self, step: Iteration, free: Any, progress: Progress | None) -> None:
        """Append a step to the history, and keep its point if it is the best."""
        self.history.append(step)
        if progress is not None:
            progress(step, self.iterations)
        value = self.selection_value(step)
        before = float("inf") if self.best is None else self.selection_value(self.best.step)
        if not step.rejected and value < before:
            least = self.line_search.least
            if value < before - (_IMPROVEMENT * abs(value) if least is None else least):
                self.last_improvement = step.number
            self.best = Best(on_host(free), step)
        if self.best is None:
            raise TuningError(
                f"got an objective of {value} or a gradient that is not finite at the start,"
                " expected finite ones; start from other noise or check the data"
            )

    def selection_value(self, step: Iteration) -> float:
        """Value by which the best step is chosen: of the validation runs if there are any."""
        return step.training if self.validation is None else step.validation

    def state_dict(self) -> dict[str, Any]:
        """State of the search as arrays by name."""
        assert self.best is not None
        found = {f"line_{name}": value for name, value in self.line_search.state_dict().items()}
        found |= {
            "history": np.array(self.history, float),
            "best_free": np.asarray(self.best.free),
            "best_number": np.array(self.best.step.number),
            **{name: np.array(getattr(self, name)) for name in _STATE},
        }
        if self.own_free is not None:
            found["own_free"] = np.asarray(self.own_free)
        if self.trial is not None:
            found["trial_free"] = np.asarray(self.trial.best.free)
            found["trial_number"] = np.array(self.trial.best.step.number)
            found["trial_fixed"] = np.asarray(self.trial.fixed)
            found["trial_last"] = np.array(self.trial.last)
        return found

    def beginning(self) -> dict[str, Any]:
        """State of a search before its first step: its start, and the work to find that."""
        return {
            "begin": on_host(self.line_search.candidate),
            "evaluations": np.array(self.evaluations),
            "filterings": np.array(self.filterings),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from the state that `state_dict` or `beginning` returned."""
        self.evaluations = int(state["evaluations"])
        self.filterings = float(state["filterings"])
        if "begin" in state:
            self.begin_at(state["begin"])
            return
        self.fixed = np.asarray(state["fixed"], bool)
        self.line_search.restore({k.removeprefix("line_"): v for k, v in state.items()})
        self.history = [
            Iteration(int(n), float(t), float(v), bool(r)) for n, t, v, r in state["history"]
        ]
        self.best = Best(state["best_free"], self.history[int(state["best_number"])])
        self.last_improvement = int(state["last_improvement"])
        self.iterations = int(state["iterations"])
        self.own_free = state.get("own_free")
        self.stopped = str(state["stopped"])
        self.kept, self.jumps = np.array(state["kept"], bool), int(state["jumps"])
        if "trial_free" in state:
            before = Best(state["trial_free"], self.history[int(state["trial_number"])])
            fixed = np.asarray(state["trial_fixed"], bool)
            self.trial = Trial(before, fixed, int(state["trial_last"]))
