"""Batches of runs: a function of one batch as a function of any number of runs, on several devices.

`map_batches` takes and returns trees with the runs on the first axis; the mapped function gets batches of
`LANES` runs on the last axis. With `vmap_as_more_runs`, `vmap` of such a function is the same function of
more runs.
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
"""Runs in a batch. Eight numbers fill a vector register of AVX-512; with more, the covariances of 15 states
do not fit into the first cache. Where XLA does not keep barriers, each materialised value costs a function
call, which more runs share."""


class BatchedArrays(NamedTuple):
    """Arrays in batches, from the forward to the backward pass.

    They are not rearranged between the passes, since that would cost as much as the filter.
    """

    arrays: Any
    """(batches, ..., lanes), the last batch filled with copies of the last run."""
    runs: Array
    """(runs,) zeros: its length is the number of runs, its `vmap` axis the one that they belong to."""


Devices = tuple[Any, ...]
"""Devices that share the runs; empty for JAX's default device."""


def batch_shape(runs: int, devices: Devices) -> tuple[int, int]:
    """Number of batches, a multiple of the number of devices, and the lanes of each."""
    size = min(runs, LANES)
    count = -(-runs // size)
    return count + -count % max(_device_count(count, devices), 1), size


def _device_count(count: int, devices: Devices) -> int:
    """Number of devices that share `count` batches; 0 if one device does all."""
    return min(count, len(devices)) if count > 1 and len(devices) > 1 else 0


def _split_runs(tree: Any, devices: Devices) -> Any:
    """Arrays (runs, ...) as (batches, lanes, ...), the last run repeated to fill the last batches."""

    def split(a: Array) -> Array:
        count, size = batch_shape(a.shape[0], devices)
        more = count * size - a.shape[0]
        if more:
            a = jnp.concatenate([a, jnp.broadcast_to(a[-1:], (more, *a.shape[1:]))])
        return a.reshape(count, size, *a.shape[1:])

    return jax.tree.map(split, tree)


def _merge_runs(tree: Any, runs: int) -> Any:
    """The inverse of `_split_runs`."""
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:runs], tree)


def _lanes_last(tree: Any) -> Any:
    return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), tree)


def _lanes_first(tree: Any) -> Any:
    return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), tree)


def map_batches(
    devices: Devices, function: Callable[..., Any], batches: Any, *trees: Any
) -> tuple[Any, Any]:
    """Call ``function(batch, *trees)`` for every batch of runs.

    Parameters
    ----------
    devices
        Devices that share the batches.
    function
        Gets trees with the lanes last and returns two results.
    batches
        Trees that are in batches already, the batches first.
    *trees
        Trees with the runs on the first axis.

    Returns
    -------
    The first results with the runs on the first axis, and the second results left in batches.
    """
    runs = jax.tree.leaves(trees)[0].shape[0]

    def one(batch_inputs: Any) -> Any:
        batches, trees = batch_inputs
        first, second = function(batches, *_lanes_last(trees))
        return _lanes_first(first), second

    batch_inputs = (batches, _split_runs(trees, devices))
    count = batch_shape(runs, devices)[0]
    shared = _device_count(count, devices)
    if count == 1:
        found = one(jax.tree.map(lambda a: a[0], batch_inputs))
        first, second = jax.tree.map(lambda a: a[None], found)
    elif shared:
        mesh = jax.sharding.Mesh(np.array(devices[:shared]), ("runs",))
        along = jax.sharding.PartitionSpec("runs")
        split = jax.shard_map(
            partial(lax.map, one), mesh=mesh, in_specs=along, out_specs=along, check_vma=False
        )
        first, second = split(batch_inputs)
    else:
        first, second = lax.map(one, batch_inputs)
    return _merge_runs(first, runs), second


def vmap_as_more_runs(devices: Devices, function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function of runs on the first axis, with a `vmap` that is a call for more runs.

    The function takes None or `BatchedArrays`, and trees; it returns a tree, and None or `BatchedArrays`.
    """

    @cache
    def mapped(tree: Any) -> Any:
        # The arguments are leaves, since the derivative of `custom_vmap` does not accept None.
        flat = custom_vmap(lambda leaves: function(*jax.tree.unflatten(tree, leaves)))
        flat.def_vmap(partial(rule, tree))
        return flat

    def call(batches: BatchedArrays | None, *trees: Any) -> Any:
        leaves, tree = jax.tree.flatten((batches, *trees))
        return mapped(tree)(leaves)

    def rule(tree: Any, size: int, batched: Any, leaves: Any) -> Any:
        batches, *trees = jax.tree.unflatten(tree, leaves)
        if not any(jax.tree.leaves(batched)):
            # No argument is batched, as in a derivative in several directions: the runs stay as they are.
            found = function(batches, *trees)
            return found, jax.tree.map(lambda _: False, found)
        batched_flags, *trees_batched = jax.tree.unflatten(tree, *batched)

        def merge(flag: bool, a: Array) -> Array:
            if not flag:
                a = jnp.broadcast_to(a, (size, *a.shape))
            return a.reshape(-1, *a.shape[2:])

        merged = jax.tree.map(merge, trees_batched, trees)
        if batches is not None:
            batches = _merge_batches(devices, size, batched_flags, batches)
        found, left = call(batches, *merged)
        found = jax.tree.map(lambda a: a.reshape(size, -1, *a.shape[1:]), found)
        flags = jax.tree.map(lambda _: True, found)
        if left is None:
            return (found, None), (flags, None)
        runs = left.runs.reshape(size, -1)
        unbatched = jax.tree.map(lambda _: False, left.arrays)
        batched_runs: Any = True
        merged_left = BatchedArrays(left.arrays, runs)
        return (found, merged_left), (flags, BatchedArrays(unbatched, batched_runs))

    return call


def _merge_batches(
    devices: Devices, size: int, batched: BatchedArrays, batches: BatchedArrays
) -> BatchedArrays:
    """The batches of all runs of a `vmap` of the batch_inputs size; `batched` are its flags."""
    runs = batches.runs.reshape(-1) if batched.runs else jnp.tile(batches.runs, size)
    if batched.runs and not any(jax.tree.leaves(batched.arrays)):
        # Made under the same `vmap`: the batches hold the runs of all its members already.
        return BatchedArrays(batches.arrays, runs)
    count = runs.shape[0] // size

    def merge(flag: bool, a: Array) -> Array:
        def spread(a: Array) -> Array:
            return _merge_runs(jnp.moveaxis(a, -1, 1), count)

        a = (
            jax.vmap(spread)(a)
            if flag
            else jnp.broadcast_to(spread(a), (size, count, *a.shape[1:-1]))
        )
        return jnp.moveaxis(_split_runs(a.reshape(-1, *a.shape[2:]), devices), 1, -1)

    return BatchedArrays(jax.tree.map(merge, batched.arrays, batches.arrays), runs)
