"""Samples that are made of many equal groups, such as the points of an image, applied group by group.

On the batch axis their arrays are (groups, rows of a group, lanes). All groups are linearised at the same
state, so that the result is that of all rows at once; one group is compiled, whatever their number. See
`jaxekf.filtering.model.repeated`.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf.filtering.steps import Rows


def split_groups(rows: Rows, count: int) -> dict[str, Any]:
    """Value, mask and `aux` of a sample (rows, lanes), with the groups first: (count, r, lanes)."""
    value, mask = (a.reshape(count, -1, a.shape[-1]) for a in (rows.value, rows.mask))
    return {"value": value, "mask": mask, "aux": rows.aux}


def single_group_spec(rows: Rows, count: int) -> Rows:
    """Shapes and types of one of the `count` groups of a sample, without a batch axis."""

    def first(spec: Any, share: int) -> Any:
        shape = (spec.shape[0] // share, *spec.shape[1:])
        return jax.ShapeDtypeStruct(shape, spec.dtype)

    value, mask = (first(spec, count) for spec in (rows.value, rows.mask))
    aux = jax.tree.map(lambda spec: jax.ShapeDtypeStruct(spec.shape[1:], spec.dtype), rows.aux)
    return rows._replace(value=value, mask=mask, aux=aux)


def has_group_axis(rows: Array) -> bool:
    """Whether an array of rows, such as a mask, is (groups, rows, lanes) instead of (rows, lanes)."""
    return rows.ndim == 3


def flatten_groups(values: Array) -> Array:
    """(groups, rows, lanes) as (all rows, lanes); (rows, lanes) as it is."""
    return values.reshape(-1, values.shape[-1])


def any_row(mask: Array) -> Array:
    """(lanes,) True where any row is."""
    if not has_group_axis(mask):
        found = mask[0]
        for i in range(1, mask.shape[0]):
            found = found | mask[i]
        return found

    def one(found: Array, mask: Array) -> tuple[Array, None]:
        return found | any_row(mask), None

    return lax.scan(one, jnp.zeros(mask.shape[-1], bool), mask)[0]
