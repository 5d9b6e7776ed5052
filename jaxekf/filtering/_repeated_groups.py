"""Samples that are made of many like groups, such as the points of an image: taken one group at a time.

On lanes such a sample's arrays have the groups on the first axis, then rows, then lanes. All groups are
linearised at the same state, so that the result is that of all rows at once; what is compiled is one
group, whatever their number.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxekf.filtering.steps import Rows


def apart(rows: Rows, count: int) -> dict[str, Any]:
    """Value, mask and `aux` of a sample (rows, lanes), the groups on the first axis: (count, r, lanes)."""
    value, mask = (a.reshape(count, -1, a.shape[-1]) for a in (rows.value, rows.mask))
    return {"value": value, "mask": mask, "aux": rows.aux}


def one_of(rows: Rows, count: int) -> Rows:
    """Shapes and types of one of the groups of a sample without lanes."""

    def first(spec: Any, share: int) -> Any:
        shape = (spec.shape[0] // share, *spec.shape[1:])
        return jax.ShapeDtypeStruct(shape, spec.dtype)

    value, mask = (first(spec, count) for spec in (rows.value, rows.mask))
    aux = jax.tree.map(lambda spec: jax.ShapeDtypeStruct(spec.shape[1:], spec.dtype), rows.aux)
    return rows._replace(value=value, mask=mask, aux=aux)


def are_many(mask: Array) -> bool:
    """Whether rows with this mask have groups on their first axis."""
    return mask.ndim == 3


def flat(values: Array) -> Array:
    """(groups, rows, lanes) as (all rows, lanes); (rows, lanes) as it is."""
    return values.reshape(-1, values.shape[-1])


def any_row(mask: Array) -> Array:
    """(lanes,) where any row counts."""
    if not are_many(mask):
        found = mask[0]
        for i in range(1, mask.shape[0]):
            found = found | mask[i]
        return found

    def one(found: Array, mask: Array) -> tuple[Array, None]:
        return found | any_row(mask), None

    return lax.scan(one, jnp.zeros(mask.shape[-1], bool), mask)[0]
