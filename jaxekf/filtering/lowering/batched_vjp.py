"""Scans on lanes as functions of many runs whose reverse derivative is JAX's own, block by block."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.lowering.blocks import Devices, in_blocks, over_more_runs


def with_own_derivative(devices: Devices, scan: Callable[..., Any]) -> Callable[..., Any]:
    """A scan of trees with lanes last as a function of many runs, on the first axis.

    Its reverse derivative is JAX's own, taken block by block on lanes; `vmap` of both is the same for more
    runs.
    """

    def run(_: None, *trees: Any) -> Any:
        return in_blocks(devices, lambda _, *trees: (scan(*trees), None), None, *trees)

    def run_back(_: None, cotangents: Any, *trees: Any) -> Any:
        def one(_: None, cotangents: Any, *trees: Any) -> Any:
            floats, put = inexact(trees)
            return jax.vjp(lambda floats: scan(*put(floats)), floats)[1](cotangents)[0], None

        return in_blocks(devices, one, None, cotangents, *trees)

    ahead, back = over_more_runs(devices, run), over_more_runs(devices, run_back)

    @jax.custom_vjp
    def function(*trees: Any) -> Any:
        return ahead(None, *trees)[0]

    def backward(trees: Any, cotangents: Any) -> Any:
        return unfilled(trees, None, back(None, cotangents, *trees)[0])

    function.defvjp(lambda *trees: (function(*trees), trees), backward)
    return function


def on_lanes(scan: Callable[..., Any], *trees: Any) -> Any:
    """A scan of trees with lanes last, for many runs, with JAX's own derivatives in both modes."""
    return in_blocks((), lambda _, *trees: (scan(*trees), None), None, *trees)[0]


def inexact(tree: Any) -> tuple[list[Array], Callable[[list[Array]], Any]]:
    """The floating-point leaves of a tree, and how to put others in their place."""
    leaves, structure = jax.tree.flatten(tree)
    flags = [jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in leaves]

    def put(floats: list[Array]) -> Any:
        return jax.tree.unflatten(structure, merge(flags, floats, leaves))

    return [leaf for f, leaf in zip(flags, leaves, strict=True) if f], put


def merge(flags: Any, chosen: list[Any], others: list[Any]) -> list[Any]:
    found = iter(chosen)
    return [next(found) if f else other for f, other in zip(flags, others, strict=True)]


def unfilled(tree: Any, flags: Any, found: list[Array]) -> Any:
    """Cotangents in the structure of `tree`: those found, and zeros for the others."""
    leaves, structure = jax.tree.flatten(tree)
    if flags is None:
        flags = [jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in leaves]
    others = [
        None if jnp.issubdtype(leaf.dtype, jnp.inexact) else np.zeros(leaf.shape, jax.dtypes.float0)
        for leaf in leaves
    ]
    merged = merge(flags, found, others)
    return jax.tree.unflatten(structure, merged)
