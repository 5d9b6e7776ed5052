"""Scans on the batch axis as functions of many runs, with JAX's reverse derivative, batch by batch.

The smoothers use `batched_with_vjp`; the filter has its own adjoint in `jaxekf.filtering._recursion`.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.lowering.batching import Devices, map_batches, vmap_as_more_runs


def batched_with_vjp(devices: Devices, scan: Callable[..., Any]) -> Callable[..., Any]:
    """A function of many runs on the first axis, from a scan of trees with lanes last.

    Its reverse derivative is JAX's own, taken batch by batch; `vmap` of both is the same
    function of more runs.
    """

    def run(_: None, *trees: Any) -> Any:
        return map_batches(devices, lambda _, *trees: (scan(*trees), None), None, *trees)

    def run_back(_: None, cotangents: Any, *trees: Any) -> Any:
        def one(_: None, cotangents: Any, *trees: Any) -> Any:
            floats, put = split_inexact(trees)
            return jax.vjp(lambda floats: scan(*put(floats)), floats)[1](cotangents)[0], None

        return map_batches(devices, one, None, cotangents, *trees)

    ahead, back = vmap_as_more_runs(devices, run), vmap_as_more_runs(devices, run_back)

    @jax.custom_vjp
    def function(*trees: Any) -> Any:
        return ahead(None, *trees)[0]

    def backward(trees: Any, cotangents: Any) -> Any:
        return cotangent_tree(trees, None, back(None, cotangents, *trees)[0])

    function.defvjp(lambda *trees: (function(*trees), trees), backward)
    return function


def batched(scan: Callable[..., Any], *trees: Any) -> Any:
    """Call a scan of trees with lanes last for many runs on the first axis; derivatives are JAX's own."""
    return map_batches((), lambda _, *trees: (scan(*trees), None), None, *trees)[0]


def split_inexact(tree: Any) -> tuple[list[Array], Callable[[list[Array]], Any]]:
    """The floating-point leaves of a tree, and a function that puts others in their place."""
    leaves, structure = jax.tree.flatten(tree)
    flags = [jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in leaves]

    def put(floats: list[Array]) -> Any:
        return jax.tree.unflatten(structure, merge_leaves(flags, floats, leaves))

    return [leaf for f, leaf in zip(flags, leaves, strict=True) if f], put


def merge_leaves(flags: Any, chosen: list[Any], others: list[Any]) -> list[Any]:
    """`others`, with those that have a flag replaced by `chosen` in order."""
    found = iter(chosen)
    return [next(found) if f else other for f, other in zip(flags, others, strict=True)]


def cotangent_tree(tree: Any, flags: Any, found: list[Array]) -> Any:
    """Cotangents in the structure of `tree`: `found` for leaves with a flag, none for the others.

    Without `flags` every floating-point leaf has one.
    """
    leaves, structure = jax.tree.flatten(tree)
    if flags is None:
        flags = [jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in leaves]
    others = [
        None if jnp.issubdtype(leaf.dtype, jnp.inexact) else np.zeros(leaf.shape, jax.dtypes.float0)
        for leaf in leaves
    ]
    merged = merge_leaves(flags, found, others)
    return jax.tree.unflatten(structure, merged)
