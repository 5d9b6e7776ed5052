"""The smoother: the belief at every instant given the whole run.

A Rauch-Tung-Striebel smoother on the state space of the model, in the form of
`jaxekf.filtering._smoother_pass`: one backward pass over the results of the filter, linearised at the
filter's estimates. Compiled, batched and differentiated like the filter.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxekf.filtering import ekf
from jaxekf.filtering._epoch import ScanInit
from jaxekf.filtering._lowered_model import LoweredModel
from jaxekf.filtering._smoother_pass import FilteredBeliefs, smooth_backward
from jaxekf.filtering.arguments import for_filter
from jaxekf.filtering.ekf import FilterOutput
from jaxekf.filtering.lowering.batched_vjp import batched, batched_with_vjp
from jaxekf.filtering.lowering.reverse_only import reverse_only
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Steps


class SmootherOutput(NamedTuple):
    """A run filtered and smoothed, with leading axes (K, S): K epochs of S substeps.

    Examples
    --------
    The attitude at the start of the run, in deg, before and after all measurements:

    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> smoothed = jaxekf.jit(jaxekf.run_smoother, static_argnums=0)
    >>> output = smoothed(model, model.parameters, belief, line.steps)
    >>> for one in (belief, output.start):
    ...     print(np.rad2deg(np.sqrt(np.diagonal(one.cov)[:3])).round(2))
    [10. 10. 10.]
    [0.04 0.04 0.04]
    """

    filtered: FilterOutput
    """The filter's results, everything kept."""
    smoothed: Belief
    """At the end of each substep, leading axes (K, S)."""
    start: Belief
    """At the start of the run."""


def run_smoother(
    model: Model, params: Parameters, belief: Belief, steps: Steps, *, adjoint: bool = True
) -> SmootherOutput:
    """Filter and smooth one run from an initial belief; differentiable in everything.

    Parameters
    ----------
    model, params, belief, steps, adjoint
        As in `run_filter`. Samples that the filter's gates rejected stay rejected.

    Returns
    -------
    SmootherOutput
        Smoothed beliefs, and the filter's output, with leading axes (K, S).

    Raises
    ------
    ModelError
        As `run_filter`.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> smoothed = jaxekf.jit(jaxekf.run_smoother, static_argnums=0)
    >>> output = smoothed(model, model.parameters, belief, line.steps)
    >>> after, before = output.smoothed.cov, output.filtered.instants.updated.cov
    >>> bool(after.trace(axis1=-2, axis2=-1).mean() < before.trace(axis1=-2, axis2=-1).mean())
    True
    """
    given = for_filter(model, params, belief, steps)
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], given)
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

    Equal to calls of `run_smoother` one by one.

    Parameters
    ----------
    model, params, belief, steps, adjoint, devices
        As in `run_filter_batch`.

    Returns
    -------
    SmootherOutput
        With leading axes (runs, K, S).

    Raises
    ------
    ModelError
        As `run_filter_batch`.

    Examples
    --------
    The same run with two sizes of the tracker's noise, 0.3 and 3 deg:

    >>> import jax
    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> params, belief, steps = jax.tree.map(
    ...     lambda a: np.stack([a, a]), (model.parameters, belief, line.steps)
    ... )
    >>> params.noise.optical[1] *= 10.0
    >>> smoothed = jaxekf.jit(jaxekf.run_smoother_batch, static_argnums=0)
    >>> cov = smoothed(model, params, belief, steps).smoothed.cov
    >>> variance = cov.trace(axis1=-2, axis2=-1).mean(axis=(1, 2))
    >>> cov.shape, bool(variance[0] < variance[1])
    ((2, 1501, 2, 6, 6), True)
    """
    given = for_filter(model, params, belief, steps)
    params, belief, steps = jax.tree.map(jnp.asarray, given)
    filtered = ekf.run_filter_batch(
        model, params, belief, steps, keep="everything", adjoint=adjoint, devices=devices
    )
    lowered, prepared, inputs = ekf.lower_model(model, params, belief, steps)
    at: Any = filtered.instants
    beliefs = FilteredBeliefs(at.predicted, at.updated, at.rejecting_s)
    trees = (prepared, ScanInit(belief), inputs, beliefs)
    if adjoint:
        smoothed, start = _smooth_with_vjp(lowered, tuple(devices))(*reverse_only(trees))
    else:
        smoothed, start = batched(partial(smooth_backward, lowered, False), *trees)
    return SmootherOutput(filtered, smoothed, start)


@lru_cache(maxsize=64)
def _smooth_with_vjp(lowered: LoweredModel, devices: tuple[Any, ...]) -> Any:
    return batched_with_vjp(devices, partial(smooth_backward, lowered, True))
