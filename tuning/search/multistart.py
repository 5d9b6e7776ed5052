"""Several searches from different starts, side by side in one program; the worse half is dropped early."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import TuningError
from jaxekf.filtering.lowering.batching import LANES
from jaxekf.recordings.types import Floats
from tuning.objective.data import Data
from tuning.parametrisation.free_vector import Layout
from tuning.search.descent import Descent, Progress

_SPREAD = 1.5
"""Prior deviations that a start may lie off: of a logarithm with a weak prior one and a half decades."""
_NEAR = 0.5
"""The same of calibration, of which one knows more."""
_DECADES = 1.5 * float(np.log(10.0))
RUNGS = (8, 16, 32)
"""Iterations after which the worse half of the searches is dropped."""
_TRIES = 5


class Outcome(NamedTuple):
    """What became of one start."""

    value: float
    """The best it came to, by validation where there is any; infinite where it could not begin."""
    iterations: int
    ending: str
    """Why it ended, in words."""


def draw(where: Layout, start: Floats, count: int, seed: int) -> list[Floats]:
    """Free vectors to start from: the given one, and others about it, uniform within 1.5 deviations of the
    prior for logarithms (at most 1.5 decades), half a deviation for calibration; the truth's stay."""
    wide = np.minimum(_SPREAD * where.prior, _DECADES)
    reach = np.where(where.is_logarithm, wide, _NEAR * where.prior)
    reach = np.where(where.is_truth, 0.0, reach)
    rng = np.random.default_rng(seed)
    others = start + reach * rng.uniform(-1.0, 1.0, (count - 1, len(start)))
    return [start, *others]


def points_at_once(groups: Sequence[Data], starts: int, devices: int | None = None) -> int:
    """Points that fill the lanes of all processors with the runs of the largest group."""
    runs = max(len(data.place) for data in groups)
    lanes = LANES * ((os.cpu_count() or 1) if devices is None else devices)
    return min(starts, max(1, lanes // runs))


@dataclass
class Race:
    """Searches that step together. Each is a `Descent` of the same problem, with the same `width`."""

    searches: list[Descent]
    keep: Callable[[dict[str, Any]], None] | None = None
    """As `Descent.keep`, for all of them together."""
    dropped: dict[int, str] = field(default_factory=dict)
    """Searches that are out, and why."""
    round: int = 0
    won: int = -1
    """The search that is gone on with, once it is over: judged anew, it may look worse than others."""

    def __post_init__(self) -> None:
        self.tries = [0] * len(self.searches)
        self.warmed: set[int] = set()
        self._warming: dict[str, Any] = {}
        for search in self.searches:
            search.keep = self._keep_all

    @property
    def running(self) -> list[int]:
        """Searches that go on."""
        return [
            i for i, one in enumerate(self.searches) if i not in self.dropped and not one.stopped
        ]

    def warm(self, steps: int) -> None:
        """As `Descent.warm`, for each that has not begun."""
        for i, search in enumerate(self.searches):
            if search.history or i in self.warmed:
                continue
            try:
                search.warm(steps, self._keep_warming, self._warming)
            except TuningError:
                # Nothing is finite there: a drawn start begins as drawn, and `_advance` brings it nearer.
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
        """What became of each start."""
        found = []
        for i, one in enumerate(self.searches):
            ending = self.dropped.get(i, one.stopped)
            found.append(Outcome(self._reached(i), len(one.history), ending))
        return tuple(found)

    @property
    def evaluations(self) -> int:
        """Of the objective with its gradient, all searches together."""
        return sum(one.evaluations for one in self.searches)

    @property
    def filterings(self) -> float:
        """As `Descent.filterings`, of all searches together."""
        return sum(one.filterings for one in self.searches)

    def run(self, patience: int, progress: Progress | None) -> Descent:
        """Step all until one is left or all have stopped; the one with the best step."""
        if self.won >= 0:
            return self.searches[self.won]
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
        self.won = self._leader
        return self.winner

    def _round(self, patience: int) -> None:
        """One step of each."""
        running = self.running
        width = self.searches[0].width
        for first in range(0, len(running), width):
            chosen = running[first : first + width]
            points = [np.asarray(self.searches[i].walk.candidate) for i in chosen]
            if width > 1:
                plain = self.searches[0].plain_values_and_gradients(points)
                told = [
                    self.searches[i].completed(point, *each)
                    for i, point, each in zip(chosen, points, plain, strict=True)
                ]
            else:
                told = [self.searches[chosen[0]].value_and_gradient(points[0])]
            for i, (value, gradient) in zip(chosen, told, strict=True):
                self._advance(i, value, gradient, patience)
        self.round += 1

    def _advance(self, i: int, value: float, gradient: Any, patience: int) -> None:
        search = self.searches[i]
        finite = np.isfinite(value) and bool(np.all(np.isfinite(gradient)))
        if i and search.best is None and not finite:
            # Where it should begin nothing is finite: begin half as far from the given start.
            self.tries[i] += 1
            if self.tries[i] >= _TRIES:
                self.dropped[i] = "dropped: the objective is not finite where it should begin"
            else:
                search.begin_at(0.5 * (search.start + np.asarray(search.walk.candidate)))
            return
        search.stopped = search.advance(value, gradient, patience, None)
        if not search.stopped and len(search.history) >= search.iterations:
            search.stopped = search.all_done

    def _drop_half(self) -> None:
        """The worse half ends; one that has stopped stays in the comparison."""
        running = set(self.running)
        left = [i for i in range(len(self.searches)) if i not in self.dropped]
        order = sorted(left, key=self._reached)
        for i in running.intersection(order[(len(order) + 1) // 2 :]):
            self.dropped[i] = f"dropped after {self.round} iterations: others had come further"

    def _reached(self, i: int) -> float:
        search = self.searches[i]
        return float("inf") if search.best is None else search.judged(search.best.step)

    def _keep_warming(self, state: dict[str, Any]) -> None:
        self._warming = state
        self._keep_all({})

    def _keep_all(self, _: dict[str, Any]) -> None:
        if self.keep is not None:
            self.keep(self.state_dict())

    def state_dict(self) -> dict[str, Any]:
        """All that the race, and the search that goes on after it, go on from."""
        found: dict[str, Any] = {"round": np.array(self.round), "tries": np.array(self.tries)}
        found["won"] = np.array(self.won)
        found["out"] = np.array(list(self.dropped), int)
        found["why_out"] = np.array(list(self.dropped.values()), str)
        found["warmed"] = np.array(sorted(self.warmed), int)
        found |= {f"warming_{name}": v for name, v in self._warming.items()}
        for i, search in enumerate(self.searches):
            state = search.state_dict() if search.best is not None else search.beginning()
            found |= {f"start{i}_{name}": v for name, v in state.items()}
        return found

    def restore(self, kept: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.round, self.tries = int(kept["round"]), [int(n) for n in kept["tries"]]
        self.won = int(kept["won"])
        self.dropped = {
            int(i): str(why) for i, why in zip(kept["out"], kept["why_out"], strict=True)
        }
        self.warmed = {int(i) for i in kept["warmed"]}
        self._warming = _under("warming_", kept)
        for i, search in enumerate(self.searches):
            search.restore(_under(f"start{i}_", kept))


def _under(prefix: str, kept: dict[str, Any]) -> dict[str, Any]:
    """What stands under names with a prefix, by the rest of the name."""
    return {k.removeprefix(prefix): v for k, v in kept.items() if k.startswith(prefix)}


def line_up(make: Callable[..., Descent], count: int, seed: int) -> Race:
    """Searches of one problem, which `make` gives, from the given start and drawn ones."""
    searches = [make() for _ in range(count)]
    first = searches[0]
    width = 1 if first.fisher else points_at_once(first.training, count)
    points = draw(first.layout, first.start, count, seed)
    for search, point in zip(searches, points, strict=True):
        search.width = width
        search.begin_at(point)
    return Race(searches)
