"""What a tuning is set beside on the same runs: noise by Allan deviation alone, and searches without
gradients."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxekf._support.errors import TuningError
from jaxekf.estimation.parameters import leaf_names
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Recording
from tuning.comparison.allan_only import allan_only
from tuning.comparison.cost import Work
from tuning.parametrisation.free_vector import Layout, Leaf
from tuning.persistence.fold_checkpoint import Kept, pack_found, unpack_found
from tuning.results import Fit, Fitted
from tuning.search.derivative_free import Found, Problem, Searched

BESIDE = ("allan", "coordinates", "nelder-mead")


def ordered(beside: Sequence[str]) -> list[str]:
    """What is asked for in the order of `BESIDE`. Raises `TuningError` for what is none of it."""
    unknown = [name for name in beside if name not in BESIDE]
    if isinstance(beside, str) or unknown:
        raise TuningError(
            f"got {beside!r} to set beside a tuning, expected a list of some of {BESIDE}; choose of these"
        )
    return [name for name in BESIDE if name in beside]


def by_allan(
    model: Model,
    start: Parameters,
    layout: Layout,
    runs: Sequence[Recording],
    log: Recording | None,
) -> Fit:
    """The start with the noise that the runs' static heads, or a static log, tell."""
    params = allan_only(model, start, runs, log).params
    values = dict(zip(leaf_names(params), jax.tree.leaves(params), strict=True))
    # The truth's leaves are not among them, and no held-out run has any of its own.
    leaves = [_as(leaf, values[leaf.name]) for leaf in layout.leaves if leaf.name in values]
    return Fit(model, params, Layout(tuple(leaves)))


def _as(leaf: Leaf, value: Any) -> Leaf:
    """A leaf for a value that may have another shape: Allan deviation tells each axis."""
    kind = "factor" if jnp.ndim(value) == 2 else "log"
    return replace(leaf, shape=jnp.shape(value), kind="linear" if leaf.kind == "linear" else kind)


def by_search(
    name: str, problem: Problem, kept: Kept, sweeps: int, evaluations: int | None
) -> Searched:
    """What a search without gradients comes to, searched for once."""
    # As many as coordinate search makes where it tries both directions each time.
    most = 2 * len(problem.start) * sweeps + 1 if evaluations is None else evaluations
    searches = {
        "coordinates": partial(problem.by_coordinates, sweeps),
        "nelder-mead": partial(problem.by_nelder_mead, most),
    }

    def search() -> dict[str, Any]:
        found: Found = searches[name]()
        return pack_found(found, problem.scale(found))

    return unpack_found(kept.once(name, search), problem)


def work_of(fitted: Fitted) -> Work:
    """What a search took; nothing where there was none."""
    if isinstance(fitted, Searched):
        return Work(float(fitted.filterings), 0.0)
    return Work(0.0, 0.0)


def in_one_shape(params: Sequence[Parameters]) -> list[Parameters]:
    """Parameters of runs with the same shapes throughout, one deviation for all axes told three times
    where another run has three."""

    def alike(*leaves: Any) -> list[Any]:
        shape = jnp.broadcast_shapes(*(jnp.shape(leaf) for leaf in leaves))
        return [jnp.broadcast_to(jnp.asarray(leaf), shape) for leaf in leaves]

    flat = [jax.tree.leaves(one) for one in params]
    columns = [alike(*leaves) for leaves in zip(*flat, strict=True)]
    structure = jax.tree.structure(params[0])
    return [jax.tree.unflatten(structure, list(row)) for row in zip(*columns, strict=True)]
