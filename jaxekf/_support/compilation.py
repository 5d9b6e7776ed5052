"""How JAX and its compiler are set for the filter's programs."""

import gc
import os
from collections.abc import Callable
from typing import Any

import jax

KEEPS_BARRIERS = jax.__version_info__ >= (0, 11)
"""Whether XLA on a CPU fuses nothing across a barrier; before, it took barriers away first."""

# Before JAX 0.11 XLA makes each loop by MLIR, which takes twice as long and gives slower programs; later
# versions do not have the choice.
_COMMON: dict[str, Any] = {} if KEEPS_BARRIERS else {"xla_cpu_use_fusion_emitters": False}
# On a CPU less to compile than at level 3, and loops over runs 10 to 20 % quicker.
FAST: dict[str, Any] = _COMMON | {
    "xla_backend_optimization_level": 2,
    "xla_cpu_prefer_vector_width": 512,
}
# A third to two thirds less to compile, for slower programs: `JAXEKF_COMPILE=quick`.
QUICK: dict[str, Any] = _COMMON | {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
_COMPILER_OPTIONS = QUICK if os.environ.get("JAXEKF_COMPILE") == "quick" else FAST

_OBJECTS = 50_000
"""New objects at which Python looks for garbage."""
_EXTRA = "xla_backend_extra_options"
_NO_UNROLLING = f"--{_EXTRA}=xla_cpu_disable_loop_unrolling"


def set_up() -> None:
    """Set JAX up for estimation: numbers of 64 bits, on a CPU a compiler that leaves loops whole, and a
    garbage collector that looks less often.

    Call it first, before JAX makes an array: XLA reads its flags, ``XLA_FLAGS``, once. It applies to every
    program of the process and to the processes that it starts. Without the flag results are the same but
    for rounding, and come later: a step of the filter is hundreds of loops over a few numbers of many runs
    each, and unrolled they take up to twice as long to compile and run up to 1.6 times as long. (To
    compare, run ``benchmarks/speed.py`` with ``XLA_FLAGS=--xla_backend_extra_options=xla_none``: flags that
    set this option are left as they are. XLA takes it from the flags only.)

    Tracing makes many objects, none of them garbage; with Python's own thresholds looking at them takes a
    third of its time.
    """
    jax.config.update("jax_enable_x64", True)
    objects, *generations = gc.get_threshold()
    if 0 < objects < _OBJECTS:
        gc.set_threshold(_OBJECTS, *generations)
    flags = os.environ.get("XLA_FLAGS", "")
    if _EXTRA not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_NO_UNROLLING}".strip()


def jit(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit` with the compiler settings that suit the filter, and the same `options`.

    JAX takes compiler settings for outermost calls only: inside another `jit` use `jax.jit`.
    """
    settings: dict[str, Any] = {"compiler_options": _COMPILER_OPTIONS}
    return jax.jit(function, **(settings | options))
