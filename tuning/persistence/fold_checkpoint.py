"""Checkpoints of a cross-validation: finished parts of each fold in a file, as arrays by name."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxekf.filtering.model import Model, Parameters
from tuning.objective.fisher_information import Information
from tuning.persistence import checkpoint
from tuning.results.searched import Found, Lowered, Searched
from tuning.results.tuned import Iteration, Outcome, Tuned
from tuning.search.derivative_free import Problem

_SUFFIX = ".fold"
_RUNNING = ".running"
_PLAIN = (
    "best",
    "history",
    "stopped",
    "scale",
    "origin",
    "evaluations",
    "filterings",
    "starts",
    "inputs",
)
"""Parts of `Tuned` that are kept as JSON."""


class FoldCheckpoint:
    """Finished parts of one fold; in memory only if there is no file."""

    def __init__(self, path: Path | None, mark: str) -> None:
        self.path, self.mark = path, mark
        self.arrays = checkpoint.read(path, mark) if path is not None and path.exists() else {}

    @property
    def running(self) -> Path | None:
        """Checkpoint of the fold's tuning while it runs."""
        return None if self.path is None else self.path.with_name(self.path.name + _RUNNING)

    def once(self, name: str, make: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
        """Arrays of a finished part; `make` computes them the first time."""
        prefix = f"{name}/"
        found = {k.removeprefix(prefix): v for k, v in self.arrays.items() if k.startswith(prefix)}
        if not found:
            found = {key: np.asarray(value) for key, value in make().items()}
            self.arrays |= {prefix + key: value for key, value in found.items()}
            if self.path is not None:
                parts = {k: v for k, v in self.arrays.items() if "/" in k}
                checkpoint.write(self.path, self.mark, parts)
        return found


def fold_file(file: Path | str | None, number: int) -> Path | None:
    """Checkpoint of a fold, counted from one: ``NAME.fold1`` next to ``NAME``."""
    if file is None:
        return None
    path = Path(file)
    return path.with_name(f"{path.name}{_SUFFIX}{number}")


def forget_folds(checkpoint: Path | str) -> None:
    """Remove the checkpoints of folds that `cross_validate` has written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import tuning
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "state"  # the `checkpoint` of `cross_validate`
    ...     file.with_name("state.fold1").touch()
    ...     tuning.forget_folds(file)
    ...     print(list(Path(folder).iterdir()))
    []
    """
    number = 1
    while (path := fold_file(checkpoint, number)) is not None and path.exists():
        path.unlink()
        path.with_name(path.name + _RUNNING).unlink(missing_ok=True)
        number += 1


def pack_found(found: Found, scale: float) -> dict[str, Any]:
    """Result of a search without gradients as arrays."""
    return {
        "best": found.best,
        "value": found.value,
        "history": np.array(found.history, float),
        "evaluations": found.evaluations,
        "scale": scale,
    }


def unpack_found(state: Mapping[str, Any], problem: Problem) -> Searched:
    """Result that `pack_found` was given."""
    history = tuple(Lowered(int(number), float(value)) for number, value in state["history"])
    value, evaluations = float(state["value"]), int(state["evaluations"])
    return problem.searched(
        Found(state["best"], value, history, evaluations), float(state["scale"])
    )


def pack_tuned(tuned: Tuned) -> dict[str, Any]:
    """A tuning as arrays, without the parts that follow from runs and options."""
    plain = {name: getattr(tuned, name) for name in _PLAIN}
    found: dict[str, Any] = {"plain": json.dumps(plain), "free": tuned.free, "fixed": tuned.fixed}
    trees: dict[str, Any] = {"params": tuned.params, "truth": tuned.truth}
    trees |= {f"each{i}": params for i, params in enumerate(tuned.each.values())}
    for name, tree in trees.items():
        found |= {f"{name}.{i}": leaf for i, leaf in enumerate(jax.tree.leaves(tree))}
    if tuned.information is not None:
        known = tuned.information
        found |= {"known.free": known.free, "matrix": known.matrix, "score": known.score}
    return found


def unpack_tuned(
    state: Mapping[str, Any], model: Model, problem: Problem, runs: Sequence[str]
) -> Tuned:
    """The tuning that `pack_tuned` was given."""
    where, base = problem.layout, problem.base

    def tree(name: str, like: Any) -> Any:
        count = jax.tree.structure(like).num_leaves
        leaves = [jnp.asarray(state[f"{name}.{i}"]) for i in range(count)]
        return jax.tree.unflatten(jax.tree.structure(like), leaves)

    own: Parameters = base._replace(truth=())
    known = None
    if "matrix" in state:
        known = Information(where, state["known.free"], state["matrix"], state["score"])
    plain = json.loads(str(state["plain"]))
    plain["best"] = Iteration(*plain["best"])
    plain["history"] = tuple(Iteration(*step) for step in plain["history"])
    plain["starts"] = tuple(Outcome(*one) for one in plain["starts"])
    return Tuned(
        model=model,
        params=tree("params", own),
        start=base,
        objective=problem.evaluation.objective,
        layout=where,
        each={name: tree(f"each{i}", own) for i, name in enumerate(runs)} if where.own else {},
        truth=tree("truth", base.truth) if base.truth else None,
        free=state["free"],
        information=known,
        fixed=state["fixed"],
        **plain,
    )
