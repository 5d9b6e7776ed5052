"""How JAX and its compiler are set for the filter's programs."""

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

KEEPS_BARRIERS = jax.__version_info__ >= (0, 11)
"""Whether XLA on a CPU fuses nothing across a barrier; before, it took barriers away first."""

_EXTRA = "xla_backend_extra_options"
_NO_UNROLLING = f"--{_EXTRA}=xla_cpu_disable_loop_unrolling"


def set_up() -> None:
    """Set JAX up for estimation: numbers of 64 bits, and on a CPU a compiler that leaves loops whole.

    Call it first, before JAX makes an array: XLA reads its flags, ``XLA_FLAGS``, once. It applies to every
    program of the process and to the processes that it starts. Without the flag results are the same but
    for rounding, and come later: a step of the filter is hundreds of loops over a few numbers of many runs
    each, and unrolled they take up to twice as long to compile and run up to 1.6 times as long. (To
    compare, run ``benchmarks/speed.py`` with ``XLA_FLAGS=--xla_backend_extra_options=xla_none``: flags that
    set this option are left as they are. XLA takes it from the flags only.)
    """
    jax.config.update("jax_enable_x64", True)
    flags = os.environ.get("XLA_FLAGS", "")
    if _EXTRA not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_NO_UNROLLING}".strip()


def jit(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit` with the compiler settings that suit the filter, and the same `options`.

    JAX takes compiler settings for outermost calls only: inside another `jit` use `jax.jit`.
    """
    settings: dict[str, Any] = {"compiler_options": _COMPILER_OPTIONS}
    return jax.jit(function, **(settings | options))
