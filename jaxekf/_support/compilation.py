"""Settings of JAX and of its compiler for the filter's programs."""

import gc
import os
from collections.abc import Callable
from typing import Any

import jax

from jaxekf._support.errors import PrecisionError

KEEPS_BARRIERS = jax.__version_info__ >= (0, 11)
"""Whether XLA on a CPU respects optimisation barriers in fusion; older versions remove them first."""

# Before JAX 0.11 XLA can generate loops with or without MLIR; with it, compilation takes twice as long and
# programs are slower. Later versions have no such option.
_COMMON: dict[str, Any] = {} if KEEPS_BARRIERS else {"xla_cpu_use_fusion_emitters": False}
# On a CPU, compilation is faster than at level 3, and loops over runs are 10 to 20 % faster.
FAST: dict[str, Any] = _COMMON | {
    "xla_backend_optimization_level": 2,
    "xla_cpu_prefer_vector_width": 512,
}
# Compilation takes a third to two thirds less time, for slower programs: `JAXEKF_COMPILE=quick`.
QUICK: dict[str, Any] = _COMMON | {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
_COMPILER_OPTIONS = QUICK if os.environ.get("JAXEKF_COMPILE") == "quick" else FAST

_OBJECTS = 50_000
"""Number of new objects after which Python runs its garbage collector."""
_EXTRA = "xla_backend_extra_options"
_NO_UNROLLING = f"--{_EXTRA}=xla_cpu_disable_loop_unrolling"


def set_up() -> None:
    """Set up JAX for estimation: float64, no loop unrolling on a CPU, and less frequent garbage collection.

    Call it before the first JAX array, because XLA reads the environment variable ``XLA_FLAGS`` only once.
    It applies to the whole process and to the processes that it starts.

    Notes
    -----
    Loop unrolling changes results only by rounding. A step of the filter has hundreds of short loops;
    unrolled, they take up to twice as long to compile and 1.6 times as long to run. To compare, run
    ``benchmarks/speed.py`` with ``XLA_FLAGS=--xla_backend_extra_options=xla_none``: flags that already set
    this option are not changed. XLA reads it from the flags only.

    Tracing creates many objects, none of them garbage; with Python's default threshold the garbage
    collector takes a third of the time of tracing.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> jnp.zeros(3).dtype
    dtype('float64')
    """
    jax.config.update("jax_enable_x64", True)
    objects, *generations = gc.get_threshold()
    if 0 < objects < _OBJECTS:
        gc.set_threshold(_OBJECTS, *generations)
    flags = os.environ.get("XLA_FLAGS", "")
    if _EXTRA not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_NO_UNROLLING}".strip()


def require_float64() -> None:
    """Raise `PrecisionError` if JAX is not set to float64."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise PrecisionError(
            "got JAX in float32, expected float64; call jaxekf.set_up() before the first array, or set"
            " JAX_ENABLE_X64=1"
        )


def jit(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit` with the compiler options for the filter.

    Parameters
    ----------
    function
        The function to compile. It must not be called inside another compiled function, since JAX accepts
        compiler options for outermost calls only; there use `jax.jit`.
    **options
        Options of `jax.jit`, such as ``static_argnums``.

    Returns
    -------
    Callable
        The compiled function.

    Examples
    --------
    The filter as a function of the parameters; the second call needs no compilation:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> filtered = jaxekf.jit(jaxekf.run_filter, static_argnums=0)
    >>> params = model.parameters
    >>> first = filtered(model, params, belief, line.steps).instants.log_likelihood.sum()
    >>> noise = params.noise._replace(optical=10.0 * params.noise.optical)
    >>> params = params._replace(noise=noise)
    >>> second = filtered(model, params, belief, line.steps).instants.log_likelihood.sum()
    >>> bool(first > second)
    True
    """
    settings: dict[str, Any] = {"compiler_options": _COMPILER_OPTIONS}
    return jax.jit(function, **(settings | options))
