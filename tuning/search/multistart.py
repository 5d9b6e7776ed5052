"""Several starts, evaluated at once in one program, with successive halving."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxekf._support.errors import TuningError
from jaxekf.filtering.ekf import RUNS_AT_ONCE
from jaxekf.recordings.types import Floats
from tuning.objective.data import Data
from tuning.parametrisation.free_vector import Layout
from tuning.results.tuned import Outcome, Progress
from tuning.search.descent import Descent

_SPREAD = 1.5
"""Reach of a drawn start in prior deviations; for a logarithm with a weak prior one and a half decades."""
_NEAR = 0.5
"""Reach for calibration, which is known better."""
_DECADES = 1.5 * float(np.log(10.0))
RUNGS = (8, 16, 32)
"""Iterations after which the worse half of the searches is dropped."""
_TRIES = 5


def draw(where: Layout, start: Floats, count: int, seed: int) -> list[Floats]:
    """Free vectors (n,) to start from: the given one, and uniform samples about it.

    They are within 1.5 prior deviations for logarithms (at most 1.5 decades) and half a deviation for
    calibration; the numbers of the encoder are not changed.
    """
    wide = np.minimum(_SPREAD * where.prior, _DECADES)
    reach = np.where(where.is_logarithm, wide, _NEAR * where.prior)
    reach = np.where(where.is_truth, 0.0, reach)
    rng = np.random.default_rng(seed)
    others = start + reach * rng.uniform(-1.0, 1.0, (count - 1, len(start)))
    return [start, *others]


def points_at_once(groups: Sequence[Data], starts: int, devices: int | None = None) -> int:
    """Number of points that, with the runs of the largest group, fill all processors."""
    runs = max(len(data.place) for data in groups)
    lanes = RUNS_AT_ONCE * ((os.cpu_count() or 1) if devices is None else devices)
    return min(starts, max(1, lanes // runs))


@dataclass
class MultiStart:
    """Searches of one problem with the same `width` that step together."""

    searches: list[Descent]
    keep: Callable[[dict[str, Any]], None] | None = None
    """Called after each step with the state of all searches."""
    dropped: dict[int, str] = field(default_factory=dict)
    """Searches that were dropped, with the reason."""
    round: int = 0
    winner_index: int = -1
    """The search that goes on once the others ended; with numbers fixed it may look worse than others."""

    def __post_init__(self) -> None:
        self.tries = [0] * len(self.searches)
        self.warmed: set[int] = set()
        self._warming: dict[str, Any] = {}
        for search in self.searches:
            search.keep = self._keep_all

    @property
    def running(self) -> list[int]:
        """Searches that have not ended."""
        return [
            i for i, one in enumerate(self.searches) if i not in self.dropped and not one.stopped
        ]

    def warm(self, steps: int) -> None:
        """Call `Descent.warm` for each search that has not begun."""
        for i, search in enumerate(self.searches):
            if search.history or i in self.warmed:
                continue
            try:
                search.warm(steps, self._keep_warming, self._warming)
            except TuningError:
                # Nothing is finite there: the drawn start is kept, and `_advance` brings it nearer.
                if i == 0:
                    raise
            self.warmed.add(i)
            self._keep_warming({})

    @property
    def _leader(self) -> int:
        return min(range(len(self.searches)), key=self._reached)

    @property
    def winner(self) -> Descent:
        """The search with the best step so far."""
        return self.searches[self._leader]

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """Result of each start."""
        found = []
        for i, one in enumerate(self.searches):
            ending = self.dropped.get(i, one.stopped)
            found.append(Outcome(self._reached(i), len(one.history), ending))
        return tuple(found)

    @property
    def evaluations(self) -> int:
        """Evaluations of the objective with its gradient, by all searches."""
        return sum(one.evaluations for one in self.searches)

    @property
    def filterings(self) -> float:
        """Filterings without a gradient, by all searches (see `Evaluation`)."""
        return sum(one.filterings for one in self.searches)

    def run(self, patience: int, progress: Progress | None) -> Descent:
        """Step all until one is left or all have stopped; return the one with the best step."""
        if self.winner_index >= 0:
            return self.searches[self.winner_index]
        try:
            while self.running and self.running != [self._leader]:
                self._round(patience)
                if progress is not None:
                    best = self.winner.best
                    assert best is not None
                    progress(best.step._replace(number=self.round - 1), self.searches[0].iterations)
                if self.round in RUNGS:
                    self._drop_half()
                self._keep_all({})
        except KeyboardInterrupt:
            self.winner.interrupt()
            for i in self.running:
                self.dropped[i] = self.winner.stopped
        self.winner_index = self._leader
        return self.winner

    def _round(self, patience: int) -> None:
        """Take one step of each search."""
        running = self.running
        width = self.searches[0].width
        for first in range(0, len(running), width):
            chosen = running[first : first + width]
            points = [np.asarray(self.searches[i].line_search.candidate) for i in chosen]
            if width > 1:
                plain = self.searches[0].plain_values_and_gradients(points)
                found = [
                    self.searches[i].completed(point, *each)
                    for i, point, each in zip(chosen, points, plain, strict=True)
                ]
            else:
                found = [self.searches[chosen[0]].value_and_gradient(points[0])]
            for i, (value, gradient) in zip(chosen, found, strict=True):
                self._advance(i, value, gradient, patience)
        self.round += 1

    def _advance(self, i: int, value: float, gradient: Any, patience: int) -> None:
        search = self.searches[i]
        finite = np.isfinite(value) and bool(np.all(np.isfinite(gradient)))
        if i and search.best is None and not finite:
            # The objective is not finite at this start: begin half as far from the given one.
            self.tries[i] += 1
            if self.tries[i] >= _TRIES:
                self.dropped[i] = "dropped: the objective is not finite where it should begin"
            else:
                search.begin_at(0.5 * (search.start + np.asarray(search.line_search.candidate)))
            return
        search.stopped = search.advance(value, gradient, patience, None)
        if not search.stopped and len(search.history) >= search.iterations:
            search.stopped = search.all_done

    def _drop_half(self) -> None:
        """Drop the worse half of the running searches, compared with the stopped ones too."""
        running = set(self.running)
        left = [i for i in range(len(self.searches)) if i not in self.dropped]
        order = sorted(left, key=self._reached)
        for i in running.intersection(order[(len(order) + 1) // 2 :]):
            self.dropped[i] = f"dropped after {self.round} iterations: others had come further"

    def _reached(self, i: int) -> float:
        search = self.searches[i]
        return float("inf") if search.best is None else search.selection_value(search.best.step)

    def _keep_warming(self, state: dict[str, Any]) -> None:
        self._warming = state
        self._keep_all({})

    def _keep_all(self, _: dict[str, Any]) -> None:
        if self.keep is not None:
            self.keep(self.state_dict())

    def state_dict(self) -> dict[str, Any]:
        """State of all searches as arrays by name."""
        found: dict[str, Any] = {"round": np.array(self.round), "tries": np.array(self.tries)}
        found["winner"] = np.array(self.winner_index)
        found["dropped"] = np.array(list(self.dropped), int)
        found["reasons"] = np.array(list(self.dropped.values()), str)
        found["warmed"] = np.array(sorted(self.warmed), int)
        found |= {f"warming_{name}": v for name, v in self._warming.items()}
        for i, search in enumerate(self.searches):
            state = search.state_dict() if search.best is not None else search.beginning()
            found |= {f"start{i}_{name}": v for name, v in state.items()}
        return found

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from the state that `state_dict` returned."""
        self.round, self.tries = int(state["round"]), [int(n) for n in state["tries"]]
        self.winner_index = int(state["winner"])
        dropped = zip(state["dropped"], state["reasons"], strict=True)
        self.dropped = {int(i): str(reason) for i, reason in dropped}
        self.warmed = {int(i) for i in state["warmed"]}
        self._warming = _under("warming_", state)
        for i, search in enumerate(self.searches):
            search.restore(_under(f"start{i}_", state))


def _under(prefix: str, state: dict[str, Any]) -> dict[str, Any]:
    """Entries with a prefix, by the rest of their name."""
    return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}


def start_searches(make: Callable[..., Descent], count: int, seed: int) -> MultiStart:
    """Searches of one problem, each made by `make`, from the given start and drawn ones."""
    if count < 1:
        raise TuningError(f"got {count} starts, expected at least one; ask for more")
    searches = [make() for _ in range(count)]
    first = searches[0]
    width = 1 if first.fisher else points_at_once(first.training, count)
    points = draw(first.layout, first.start, count, seed)
    for search, point in zip(searches, points, strict=True):
        search.width = width
        search.begin_at(point)
    return MultiStart(searches)
