"""The smoother: every instant given the whole run, on top of the filter of `jaxekf.filtering.ekf`.

Rauch, Tung, Striebel on the state space of the model, in the form of `jaxekf.filtering._smoother_pass`:
one pass back over what the filter left, linearised where the filter was. Compiled, batched and
differentiated like the filter.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxekf.filtering import _smoother_pass as smoother_pass
from jaxekf.filtering import ekf
from jaxekf.filtering._lowered_model import System
from jaxekf.filtering._recursion import First
from jaxekf.filtering._smoother_pass import Filtered
from jaxekf.filtering.ekf import FilterOutput
from jaxekf.filtering.lowering import batched_vjp
from jaxekf.filtering.lowering.reverse_only import reverse_only
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Steps


class SmootherOutput(NamedTuple):
    """A run filtered and smoothed."""

    filtered: FilterOutput
    """All that the filter left."""
    smoothed: Belief
    """At the end of each substep, leading axes (K, S)."""
    start: Belief
    """At the start of the run."""


def run_smoother(
    model: Model, params: Parameters, belief: Belief, steps: Steps, *, adjoint: bool = True
) -> SmootherOutput:
    """Filter and smooth one run from an initial belief; differentiable in everything.

    Samples that the filter's gates refused stay refused. Options and errors as in `run_filter`.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> run = jaxekf.jit(lambda params: jaxekf.run_smoother(model, params, belief, line.steps))
    >>> output = run(model.parameters)
    >>> smoothed, filtered = output.smoothed.cov, output.filtered.instants.updated.cov
    >>> bool(smoothed.trace(axis1=-2, axis2=-1).mean() < filtered.trace(axis1=-2, axis2=-1).mean())
    True
    """
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], (params, belief, steps))
    found = run_smoother_batch(model, *one, adjoint=adjoint)
    return jax.tree.map(lambda a: a[0], found)


def run_smoother_batch(
    model: Model,
    params: Parameters,
    belief: Belief,
    steps: Steps,
    *,
    adjoint: bool = True,
    devices: Sequence[Any] = (),
) -> SmootherOutput:
    """Filter and smooth many runs: every leaf of every argument carries the runs on its first axis.

    Equal to calls of `run_smoother` one by one; options and errors as in `run_filter_batch`.
    """
    params, belief, steps = jax.tree.map(jnp.asarray, (params, belief, steps))
    filtered = ekf.run_filter_batch(
        model, params, belief, steps, keep="everything", adjoint=adjoint, devices=devices
    )
    ready, prepared, given = ekf.made_ready(model, params, belief, steps)
    at: Any = filtered.instants
    trees = (prepared, First(belief), given, Filtered(at.predicted, at.updated, at.refused))
    if adjoint:
        smoothed, start = _lanes(ready, tuple(devices))(*reverse_only(trees))
    else:
        smoothed, start = batched_vjp.on_lanes(
            partial(smoother_pass.scan_back, ready, False), *trees
        )
    return SmootherOutput(filtered, smoothed, start)


@lru_cache(maxsize=64)
def _lanes(system: System, devices: tuple[Any, ...]) -> Any:
    scan = partial(smoother_pass.scan_back, system, True)
    return batched_vjp.with_own_derivative(devices, scan)
