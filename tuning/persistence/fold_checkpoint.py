"""Folds that go on after a stop: what is finished of one stands in a file, as arrays by name."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxekf.filtering.model import Model, Parameters
from tuning._tune import Tuned
from tuning.objective.fisher_information import Information
from tuning.persistence import checkpoint as resume
from tuning.search.derivative_free import Found, Lowered, Problem, Searched
from tuning.search.descent import Iteration
from tuning.search.multistart import Outcome

_SUFFIX = ".fold"
_RUNNING = ".running"


class Kept:
    """What is finished of one fold; in memory only where there is no file."""

    def __init__(self, path: Path | None, mark: str) -> None:
        self.path, self.mark = path, mark
        there = path is not None and path.exists()
        self.arrays = resume.read(path, mark) if path is not None and there else {}

    @property
    def running(self) -> Path | None:
        """Where the fold's tuning keeps its own state while it runs."""
        return None if self.path is None else self.path.with_name(self.path.name + _RUNNING)

    def once(self, name: str, make: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
        """What is kept under a name, or else what `make` gives, kept from then on."""
        prefix = f"{name}/"
        found = {k.removeprefix(prefix): v for k, v in self.arrays.items() if k.startswith(prefix)}
        if not found:
            found = {key: np.asarray(value) for key, value in make().items()}
            self.arrays |= {prefix + key: value for key, value in found.items()}
            if self.path is not None:
                told = {k: v for k, v in self.arrays.items() if "/" in k}
                resume.write(self.path, self.mark, told)
        return found


def fold_file(checkpoint: Path | str | None, number: int) -> Path | None:
    """Where a fold is kept, counted from one: ``NAME.fold1`` beside the checkpoint ``NAME``."""
    if checkpoint is None:
        return None
    path = Path(checkpoint)
    return path.with_name(f"{path.name}{_SUFFIX}{number}")


def forget_folds(checkpoint: Path | str) -> None:
    """Remove what `cross_validate` kept of its folds beside a checkpoint."""
    number = 1
    while (path := fold_file(checkpoint, number)) is not None and path.exists():
        path.unlink()
        path.with_name(path.name + _RUNNING).unlink(missing_ok=True)
        number += 1


def pack_found(found: Found, scale: float) -> dict[str, Any]:
    """A search without gradients as arrays."""
    return {
        "best": found.best,
        "value": found.value,
        "history": np.array(found.history, float),
        "evaluations": found.evaluations,
        "scale": scale,
    }


def unpack_found(kept: Mapping[str, Any], problem: Problem) -> Searched:
    """The search that `pack_found` was given."""
    history = tuple(Lowered(int(number), float(value)) for number, value in kept["history"])
    value, evaluations = float(kept["value"]), int(kept["evaluations"])
    return problem.searched(Found(kept["best"], value, history, evaluations), float(kept["scale"]))


def pack_tuned(tuned: Tuned) -> dict[str, Any]:
    """A tuning as arrays; what its runs and options tell anyway is left out."""
    found: dict[str, Any] = {
        "best": np.array(tuned.best, float),
        "history": np.array(tuned.history, float),
        "stopped": tuned.stopped,
        "scale": tuned.scale,
        "origin": json.dumps(tuned.origin),
        "inputs": json.dumps(tuned.inputs),
        "free": tuned.free,
        "fixed": tuned.fixed,
        "evaluations": tuned.evaluations,
        "filterings": tuned.filterings,
        "starts": json.dumps([one._asdict() for one in tuned.starts]),
    }
    trees: dict[str, Any] = {"params": tuned.params, "truth": tuned.truth}
    trees |= {f"each{i}": params for i, params in enumerate(tuned.each.values())}
    for name, tree in trees.items():
        found |= {f"{name}.{i}": leaf for i, leaf in enumerate(jax.tree.leaves(tree))}
    if tuned.information is not None:
        known = tuned.information
        found |= {"known.free": known.free, "matrix": known.matrix, "score": known.score}
    return found


def unpack_tuned(
    kept: Mapping[str, Any], model: Model, problem: Problem, runs: Sequence[str]
) -> Tuned:
    """The tuning that `pack_tuned` was given."""
    where, base = problem.layout, problem.base

    def tree(name: str, like: Any) -> Any:
        count = jax.tree.structure(like).num_leaves
        leaves = [jnp.asarray(kept[f"{name}.{i}"]) for i in range(count)]
        return jax.tree.unflatten(jax.tree.structure(like), leaves)

    plain: Parameters = base._replace(truth=())
    known = None
    if "matrix" in kept:
        known = Information(where, kept["known.free"], kept["matrix"], kept["score"])
    return Tuned(
        model=model,
        params=tree("params", plain),
        start=base,
        objective=problem.search.objective,
        best=_iteration(kept["best"]),
        history=tuple(map(_iteration, kept["history"])),
        stopped=str(kept["stopped"]),
        scale=float(kept["scale"]),
        layout=where,
        origin=json.loads(str(kept["origin"])),
        each={name: tree(f"each{i}", plain) for i, name in enumerate(runs)} if where.own else {},
        truth=tree("truth", base.truth) if base.truth else None,
        free=kept["free"],
        information=known,
        fixed=kept["fixed"],
        evaluations=int(kept["evaluations"]),
        filterings=float(kept["filterings"]),
        starts=tuple(Outcome(**one) for one in json.loads(str(kept["starts"]))),
        # What an earlier version kept does not tell.
        inputs=json.loads(str(kept.get("inputs", "{}"))),
    )


def _iteration(row: Any) -> Iteration:
    number, training, validation, rejected = row
    return Iteration(int(number), float(training), float(validation), bool(rejected))
