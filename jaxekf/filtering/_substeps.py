"""A scan over the substeps of one epoch: fast samples at every substep, slow samples at the last.

The smoothers use it; the filter has its own, `jaxekf.filtering._epoch`, which compiles the transition once.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def scan_substeps(
    substep: Callable[..., Any], carry: Any, inputs: tuple[Any, Any], slow: Any
) -> tuple[Any, Any]:
    """``substep(carry, (own, samples))`` over an epoch, in order of time.

    Parameters
    ----------
    substep
        Returns the carry and its output, as in `jax.lax.scan`.
    carry
        Before the first substep.
    inputs
        What each substep gets besides samples, and the fast samples; leading axis (S,).
    slow
        Slow samples, which come with the last substep.

    Returns
    -------
    The carry after the last substep, and the outputs, leading axis (S,).
    """
    own, fast = jax.tree.map(lambda a: a[-1], inputs)
    earlier = None
    if jax.tree.leaves(inputs)[0].shape[0] > 1:
        rest = jax.tree.map(lambda a: a[:-1], inputs)
        carry, earlier = lax.scan(substep, carry, rest)
    carry, last = substep(carry, (own, fast | slow))
    return carry, _with_last(earlier, last)


def scan_substeps_backward(
    substep: Callable[..., Any], carry: Any, inputs: tuple[Any, Any], slow: Any
) -> tuple[Any, Any]:
    """As `scan_substeps`, from the last substep to the first; outputs are in order of time."""
    own, fast = jax.tree.map(lambda a: a[-1], inputs)
    carry, last = substep(carry, (own, fast | slow))
    earlier = None
    if jax.tree.leaves(inputs)[0].shape[0] > 1:
        rest = jax.tree.map(lambda a: a[:-1], inputs)
        carry, earlier = lax.scan(substep, carry, rest, reverse=True)
    return carry, _with_last(earlier, last)


def _with_last(earlier: Any, last: Any) -> Any:
    if earlier is None:
        return jax.tree.map(lambda a: a[None], last)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), earlier, last)
