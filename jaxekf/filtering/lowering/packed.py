"""Arrays that a loop reads or makes at every step, put together: one slice a step instead of one each.

Every slice is a loop of its own in the compiled step, which costs more than the few numbers it copies, and
more again to compile.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


class _Layout(NamedTuple):
    """Where the leaves of a tree lie: array and first number of each, and the shape of one step's."""

    tree: Any
    places: tuple[tuple[int, int], ...]
    shapes: tuple[tuple[int, ...], ...]


@jax.tree_util.register_pytree_node_class
class Packed:
    """A tree of arrays as one array for each of their types, (..., numbers).

    It is a tree itself: a scan slices it, and a `vmap` maps it, along the leading axes.
    """

    def __init__(self, arrays: Sequence[Array], layout: _Layout) -> None:
        self._arrays, self._layout = tuple(arrays), layout

    def opened(self) -> Any:
        """The tree, its arrays with the leading axes that there are now."""
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


def packed(tree: Any, axes: int = 0) -> Packed:
    """The arrays of `tree` together, whose first `axes` axes are the same."""
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
