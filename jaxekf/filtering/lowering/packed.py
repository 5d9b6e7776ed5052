"""The arrays of a scan packed into one array per type, so that each step takes one slice.

Every slice of a scanned array is a loop in the compiled step. With many small arrays these loops cost more
than the numbers they copy, and time to compile. `jaxekf.filtering._recursion` packs its scans.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


class _Layout(NamedTuple):
    """Places of the leaves of a tree: packed array and first entry of each, and its shape in one step."""

    tree: Any
    places: tuple[tuple[int, int], ...]
    shapes: tuple[tuple[int, ...], ...]


@jax.tree_util.register_pytree_node_class
class Packed:
    """A tree of arrays packed into one array (..., entries) per type.

    It is a pytree: a scan slices it, and `vmap` maps it, along the leading axes.
    """

    def __init__(self, arrays: Sequence[Array], layout: _Layout) -> None:
        self._arrays, self._layout = tuple(arrays), layout

    def unpack(self) -> Any:
        """The tree, its arrays with the present leading axes."""
        tree, places, shapes = self._layout
        leaves = []
        for (which, start), shape in zip(places, shapes, strict=True):
            array = self._arrays[which]
            part = array[..., start : start + int(np.prod(shape, dtype=int))]
            leaves.append(part.reshape(*array.shape[:-1], *shape))
        return jax.tree.unflatten(tree, leaves)

    def tree_flatten(self) -> tuple[Any, Any]:
        return self._arrays, self._layout

    @classmethod
    def tree_unflatten(cls, layout: _Layout, arrays: Any) -> "Packed":
        return cls(arrays, layout)


def pack(tree: Any, axes: int = 0) -> Packed:
    """Pack the arrays of `tree`, whose first `axes` axes are equal."""
    leaves, structure = jax.tree.flatten(tree)
    parts: dict[Any, list[Array]] = {}
    places, shapes = [], []
    for leaf in leaves:
        before = parts.setdefault(leaf.dtype, [])
        places.append((list(parts).index(leaf.dtype), sum(p.shape[-1] for p in before)))
        shapes.append(leaf.shape[axes:])
        before.append(leaf.reshape(*leaf.shape[:axes], -1))
    arrays = [p[0] if len(p) == 1 else jnp.concatenate(p, axis=-1) for p in parts.values()]
    return Packed(arrays, _Layout(structure, tuple(places), tuple(shapes)))
