"""Baselines of a tuning: noise by Allan deviation alone, and searches without gradients."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxekf._support.errors import TuningError
from jaxekf.estimation.parameters import leaves_by_name
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Recording
from tuning.comparison.allan_only import allan_only
from tuning.parametrisation.free_vector import Layout
from tuning.parametrisation.leaf import Leaf
from tuning.persistence.fold_checkpoint import FoldCheckpoint, pack_found, unpack_found
from tuning.results.fitted import FittedParameters
from tuning.results.searched import Found, Searched
from tuning.search.derivative_free import Problem

BASELINES = ("allan", "coordinates", "nelder-mead")


def ordered(baselines: Sequence[str]) -> list[str]:
    """Baselines in the order of `BASELINES`. Raises `TuningError` for an unknown one."""
    unknown = [name for name in baselines if name not in BASELINES]
    if isinstance(baselines, str) or unknown:
        raise TuningError(
            f"got the baselines {baselines!r}, expected a list of some of {BASELINES}; choose of these"
        )
    return [name for name in BASELINES if name in baselines]


def by_allan(
    model: Model,
    start: Parameters,
    layout: Layout,
    runs: Sequence[Recording],
    log: Recording | None,
) -> FittedParameters:
    """The start with the sensor noise of the runs' static intervals, or of a static log."""
    params = allan_only(model, start, runs, log).params
    values = leaves_by_name(params)
    # Leaves of the encoder are left out: no held-out run has any for itself.
    leaves = [_as(leaf, values[leaf.name]) for leaf in layout.leaves if leaf.name in values]
    return FittedParameters(model, params, Layout(tuple(leaves)))


def _as(leaf: Leaf, value: Any) -> Leaf:
    """A leaf for a value that may have another shape: Allan deviations are those of each axis."""
    kind = "factor" if jnp.ndim(value) == 2 else "log"
    return replace(leaf, shape=jnp.shape(value), kind="linear" if leaf.kind == "linear" else kind)


def by_search(
    name: str, problem: Problem, checkpoint: FoldCheckpoint, sweeps: int, evaluations: int | None
) -> Searched:
    """Result of a search without gradients, from the checkpoint if it is finished."""
    # As many as coordinate search makes if it tries both directions each time.
    most = 2 * len(problem.start) * sweeps + 1 if evaluations is None else evaluations
    searches = {
        "coordinates": partial(problem.by_coordinates, sweeps),
        "nelder-mead": partial(problem.by_nelder_mead, most),
    }

    def search() -> dict[str, Any]:
        found: Found = searches[name]()
        return pack_found(found, problem.scale(found))

    return unpack_found(checkpoint.once(name, search), problem)


def in_one_shape(params: Sequence[Parameters]) -> list[Parameters]:
    """Parameters of runs in the same shapes: one for all axes is repeated if another run has three."""

    def alike(*leaves: Any) -> list[Any]:
        shape = jnp.broadcast_shapes(*(jnp.shape(leaf) for leaf in leaves))
        return [jnp.broadcast_to(jnp.asarray(leaf), shape) for leaf in leaves]

    flat = [jax.tree.leaves(one) for one in params]
    columns = [alike(*leaves) for leaves in zip(*flat, strict=True)]
    structure = jax.tree.structure(params[0])
    return [jax.tree.unflatten(structure, list(row)) for row in zip(*columns, strict=True)]
