"""How the filter's arithmetic is cut into compiled loops.

On a CPU, XLA either computes a small product again for each of its uses or pays for a launch at each
small loop. Both go away when the cuts are chosen here: what is wrapped in `loop` is computed once and
kept, and what is wrapped in `block` is compiled into one piece of code without launches. Both only
say how to compile; what is computed is the same.
"""

import os
from collections.abc import Callable
from typing import Any

import jax
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata

# On a CPU less to compile than at level 3, and loops over runs 10 to 20 % quicker.
FAST: dict[str, Any] = {"xla_backend_optimization_level": 2, "xla_cpu_prefer_vector_width": 512}
_QUICK: dict[str, Any] = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
# `JAXEKF_COMPILE=quick` takes a third less to compile, for slower programs.
_COMPILER_OPTIONS = _QUICK if os.environ.get("JAXEKF_COMPILE") == "quick" else FAST
_INLINE = {"inlineable": "true", "xla_cpu_small_call": "false"}
_LOOP = {"inlineable": "false", "xla_cpu_small_call": "false"}
_BLOCK = {"inlineable": "false", "xla_cpu_small_call": "true"}


def jit(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit` with the compiler settings that suit the filter, and the same `options`.

    JAX takes compiler settings for outermost calls only: inside another `jit` use `jax.jit`.
    """
    settings: dict[str, Any] = {"compiler_options": _COMPILER_OPTIONS}
    return jax.jit(function, **(settings | options))


def loop(function: Callable[..., Any], *args: Any) -> Any:
    """``function(*args)``, not merged with what comes before or after."""
    return _called(function, args, _LOOP)


def block(function: Callable[..., Any], *args: Any) -> Any:
    """``function(*args)`` as one piece of code; it must be plain arithmetic, loops and rearrangements."""

    # XLA (jaxlib 0.10 to 0.12) aborts where such a call has an operand that nothing in it reads: so each
    # is read, and kept behind a barrier, for a constant would be moved inside and leave it unread.
    def touching(*args: Any) -> Any:
        corners = [
            lax.slice(a, (0,) * a.ndim, (1,) * a.ndim) for a in jax.tree.leaves(args) if a.size
        ]
        return function(*args), corners

    return _called(touching, lax.optimization_barrier(args), _BLOCK)[0]


def _called(function: Callable[..., Any], args: Any, how: dict[str, str]) -> Any:
    if jax.default_backend() != "cpu":
        return function(*args)

    def inner(*args: Any) -> Any:
        with set_xla_metadata(**_INLINE):
            return function(*args)

    with set_xla_metadata(**how):
        return jax.jit(inner)(*args)
