"""Times of a function: to trace, lower and compile it, and to run it."""

import statistics
import sys
import time
from itertools import pairwise
from typing import Any, NamedTuple

import jax


class Build(NamedTuple):
    """A compiled program, and the seconds of each stage of its compilation."""

    program: Any
    """The compiled function, for arguments of the same shapes."""
    trace_s: float
    lower_s: float
    compile_s: float
    operations: int
    """StableHLO operations: the lines with ``=`` of the lowered text."""

    @property
    def total_s(self) -> float:
        """Seconds of all three stages."""
        return self.trace_s + self.lower_s + self.compile_s


def build(function: Any, *args: Any) -> Build:
    """Compile a jitted function for these arguments, after all caches in memory are cleared.

    The caller must disable the cache on disk (`jax_enable_compilation_cache`).
    """
    clear_caches()
    times = [time.perf_counter()]
    traced = function.trace(*args)
    times.append(time.perf_counter())
    lowered = traced.lower()
    times.append(time.perf_counter())
    program = lowered.compile()
    times.append(time.perf_counter())
    return Build(program, *(b - a for a, b in pairwise(times)), _operations(lowered))


def clear_caches() -> None:
    """Clear the caches of JAX and those of this package."""
    jax.clear_caches()
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] == "jaxekf":
            for value in list(vars(module).values()):
                clear = getattr(value, "cache_clear", None)
                if callable(clear):
                    clear()


def operations(function: Any, *args: Any) -> int:
    """Number of StableHLO operations of a jitted function for these arguments."""
    return _operations(function.lower(*args))


def _operations(lowered: Any) -> int:
    return sum(" = " in line for line in lowered.as_text().splitlines())


class Timing(NamedTuple):
    """Times of a function."""

    first_s: float
    """Seconds of the first call."""
    median_s: float
    """Median of later calls."""
    result: Any


def timed(function: Any, *args: Any, seconds: float) -> Timing:
    """Time the first call of a function, and later calls for about `seconds`.

    There are 3 to 30 later calls, or fewer than 3 if these take longer than five times `seconds`.
    """
    begin = time.perf_counter()
    result = jax.block_until_ready(function(*args))
    first = time.perf_counter() - begin
    times: list[float] = []
    while not times or (
        len(times) < 30 and sum(times) < (5.0 * seconds if len(times) < 3 else seconds)
    ):
        begin = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - begin)
    return Timing(first, statistics.median(times), result)
