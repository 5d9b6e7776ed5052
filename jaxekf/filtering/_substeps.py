"""The substeps of an epoch one after the other: fast samples at each, slow ones at the last."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def over_substeps(
    substep: Callable[..., Any], carry: Any, every: Any, slow: Any
) -> tuple[Any, Any]:
    """``substep(carry, (what, samples))`` over an epoch; `every` is what it is given and fast samples, with
    a leading axis (S,), and slow samples come with the last."""
    what, fast = jax.tree.map(lambda a: a[-1], every)
    earlier = None
    if jax.tree.leaves(every)[0].shape[0] > 1:
        rest = jax.tree.map(lambda a: a[:-1], every)
        carry, earlier = lax.scan(substep, carry, rest)
    carry, last = substep(carry, (what, fast | slow))
    return carry, _with_last(earlier, last)


def over_substeps_back(
    substep: Callable[..., Any], carry: Any, every: Any, slow: Any
) -> tuple[Any, Any]:
    """As `over_substeps`, from the last to the first."""
    what, fast = jax.tree.map(lambda a: a[-1], every)
    carry, last = substep(carry, (what, fast | slow))
    earlier = None
    if jax.tree.leaves(every)[0].shape[0] > 1:
        rest = jax.tree.map(lambda a: a[:-1], every)
        carry, earlier = lax.scan(substep, carry, rest, reverse=True)
    return carry, _with_last(earlier, last)


def _with_last(earlier: Any, last: Any) -> Any:
    if earlier is None:
        return jax.tree.map(lambda a: a[None], last)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), earlier, last)
