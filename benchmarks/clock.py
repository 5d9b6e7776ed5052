"""How long a compiled function takes."""

import statistics
import time

import jax


def timed(function: object, *args: object, seconds: float) -> tuple[float, float]:
    """Seconds of the first call, and the median of later ones."""
    begin = time.perf_counter()
    jax.block_until_ready(function(*args))
    first = time.perf_counter() - begin
    times = []
    until = time.perf_counter() + seconds
    while len(times) < 3 or (time.perf_counter() < until and len(times) < 30):
        begin = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - begin)
    return first, statistics.median(times)
