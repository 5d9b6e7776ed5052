"""Runs in blocks of lanes: a function of one block made one of any number of runs, on several devices.

Functions take and give trees with the runs on the first axis; inside they see a block of runs on the last.
`vmap` of such a function is the same function of more runs.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_batching import custom_vmap

from jaxekf._support.compilation import KEEPS_BARRIERS

LANES = 8 if KEEPS_BARRIERS else 16
"""Runs in a block. Eight numbers fill a vector register of AVX-512, and with more of them the covariances
of 15 states leave the first cache. Where barriers are not kept each stage is the call of a function, whose
cost more runs share."""


class Blocks(NamedTuple):
    """Arrays as the scans leave them: (blocks, ..., lanes), the last block filled up.

    They stay so from the forward to the backward pass; to put the runs first and back would cost as
    much as the filter. `runs` (runs,) says how many runs they are, and of which `vmap`.
    """

    arrays: Any
    runs: Array


Devices = tuple[Any, ...]
"""Devices that share the runs; none for the one that JAX chooses."""


def shape_of(runs: int, devices: Devices) -> tuple[int, int]:
    """Number of blocks, the same for each device, and their width."""
    size = min(runs, LANES)
    count = -(-runs // size)
    return count + -count % max(_shared(count, devices), 1), size


def _shared(count: int, devices: Devices) -> int:
    """How many of the devices share `count` blocks; 0 where there is nothing to share."""
    return min(count, len(devices)) if count > 1 and len(devices) > 1 else 0


def _cut_runs(tree: Any, devices: Devices) -> Any:
    """Arrays (runs, ...) as (blocks, lanes, ...), the last run repeated to fill the last blocks."""

    def cut(a: Array) -> Array:
        count, size = shape_of(a.shape[0], devices)
        more = count * size - a.shape[0]
        if more:
            a = jnp.concatenate([a, jnp.broadcast_to(a[-1:], (more, *a.shape[1:]))])
        return a.reshape(count, size, *a.shape[1:])

    return jax.tree.map(cut, tree)


def _join_runs(tree: Any, runs: int) -> Any:
    """The inverse of `_cut_runs`."""
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:runs], tree)


def _lanes_last(tree: Any) -> Any:
    return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), tree)


def _lanes_first(tree: Any) -> Any:
    return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), tree)


def in_blocks(
    devices: Devices, function: Callable[..., Any], blocked: Any, *trees: Any
) -> tuple[Any, Any]:
    """``function`` of trees with lanes last, for runs on the first axis in blocks of `LANES`.

    It is called with `blocked`, which is in blocks already, and `trees`; of its two results the first is
    put back to runs, the second is left in blocks.
    """
    runs = jax.tree.leaves(trees)[0].shape[0]

    def one(given: Any) -> Any:
        blocked, trees = given
        first, second = function(blocked, *_lanes_last(trees))
        return _lanes_first(first), second

    given = (blocked, _cut_runs(trees, devices))
    count = shape_of(runs, devices)[0]
    shared = _shared(count, devices)
    if count == 1:
        found = one(jax.tree.map(lambda a: a[0], given))
        first, second = jax.tree.map(lambda a: a[None], found)
    elif shared:
        mesh = jax.sharding.Mesh(np.array(devices[:shared]), ("runs",))
        along = jax.sharding.PartitionSpec("runs")
        split = jax.shard_map(
            partial(lax.map, one), mesh=mesh, in_specs=along, out_specs=along, check_vma=False
        )
        first, second = split(given)
    else:
        first, second = lax.map(one, given)
    return _join_runs(first, runs), second


def over_more_runs(devices: Devices, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of runs on the first axis, whose `vmap` is the same function of more runs.

    It is called with None or `Blocks` and with trees; it returns a tree and None or `Blocks`.
    """

    @cache
    def mapped(tree: Any) -> Any:
        # Arguments are leaves: the derivative of `custom_vmap` takes no None among them.
        flat = custom_vmap(lambda leaves: function(*jax.tree.unflatten(tree, leaves)))
        flat.def_vmap(partial(rule, tree))
        return flat

    def call(blocks: Blocks | None, *trees: Any) -> Any:
        leaves, tree = jax.tree.flatten((blocks, *trees))
        return mapped(tree)(leaves)

    def rule(tree: Any, size: int, batched: Any, leaves: Any) -> Any:
        blocks, *trees = jax.tree.unflatten(tree, leaves)
        if not any(jax.tree.leaves(batched)):
            # A derivative is taken in several directions at once: the runs are as many as before.
            found = function(blocks, *trees)
            return found, jax.tree.map(lambda _: False, found)
        blocks_batched, *trees_batched = jax.tree.unflatten(tree, *batched)

        def merge(flag: bool, a: Array) -> Array:
            if not flag:
                a = jnp.broadcast_to(a, (size, *a.shape))
            return a.reshape(-1, *a.shape[2:])

        merged = jax.tree.map(merge, trees_batched, trees)
        if blocks is not None:
            blocks = _merge_blocks(devices, size, blocks_batched, blocks)
        found, left = call(blocks, *merged)
        found = jax.tree.map(lambda a: a.reshape(size, -1, *a.shape[1:]), found)
        flags = jax.tree.map(lambda _: True, found)
        if left is None:
            return (found, None), (flags, None)
        runs = left.runs.reshape(size, -1)
        unbatched = jax.tree.map(lambda _: False, left.arrays)
        batched_runs: Any = True
        return (found, Blocks(left.arrays, runs)), (flags, Blocks(unbatched, batched_runs))

    return call


def _merge_blocks(devices: Devices, size: int, batched: Blocks, blocks: Blocks) -> Blocks:
    """Blocks of all runs of a `vmap` of the given size."""
    runs = blocks.runs.reshape(-1) if batched.runs else jnp.tile(blocks.runs, size)
    if batched.runs and not any(jax.tree.leaves(batched.arrays)):
        # Made under the same `vmap`: the blocks hold the runs of all its members already.
        return Blocks(blocks.arrays, runs)
    count = runs.shape[0] // size

    def merge(flag: bool, a: Array) -> Array:
        def spread(a: Array) -> Array:
            return _join_runs(jnp.moveaxis(a, -1, 1), count)

        a = (
            jax.vmap(spread)(a)
            if flag
            else jnp.broadcast_to(spread(a), (size, count, *a.shape[1:-1]))
        )
        return jnp.moveaxis(_cut_runs(a.reshape(-1, *a.shape[2:]), devices), 1, -1)

    return Blocks(jax.tree.map(merge, batched.arrays, blocks.arrays), runs)
