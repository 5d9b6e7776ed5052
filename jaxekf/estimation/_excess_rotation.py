"""Variance of the rotation that a gyroscope at the limit of its range does not measure."""

from typing import Any

import numpy as np

from jaxekf.geometry import manifold
from jaxekf.geometry.manifold import SO3
from jaxekf.recordings.types import NANOSECONDS, Floats, Samples, Times

_SHARE = 0.5
"""Standard deviation of the rate beyond the limit, as a share of the limit."""


def excess_rotation(
    space: Any, driver: Samples, time_ns: Times, dt: Floats
) -> tuple[Floats | None, str]:
    """Variances (K, S, n) for `Steps.excess`, and a note; None where no sample is at the limit.

    The excess over a stretch of length T has the standard deviation ``0.5 limit T`` about each axis, spread
    evenly over its steps. A stretch begins and ends a sample beyond the first and the last at the limit.

    Parameters
    ----------
    space
        The model's; its first rotation is the one that the gyroscope drives.
    driver
        The input (N, c), whose first three channels are the rate.
    time_ns, dt
        (K, S) end, ns, and length, s, of each substep.
    """
    rotations = [p.error for p in manifold.parts(space) if isinstance(p.manifold, SO3)]
    if driver.at_limit is None or not driver.at_limit.any() or not rotations:
        return None, ""
    value, taken = np.asarray(driver.value)[:, :3], driver.time_ns
    edges = np.flatnonzero(np.diff(np.r_[False, driver.at_limit, False].astype(int)))
    first, last = edges[::2], edges[1::2] - 1
    begin = taken[np.maximum(first - 1, 0)]
    end = taken[np.minimum(last + 1, len(taken) - 1)]
    limit = np.abs(value[driver.at_limit]).max()
    spread = (_SHARE * limit) ** 2 * (end - begin) / NANOSECONDS
    variance = np.zeros(time_ns.shape)
    before = time_ns - np.round(dt * NANOSECONDS).astype(np.int64)
    for a, b, density in zip(begin, end, spread, strict=True):
        inside = np.minimum(time_ns, b) - np.maximum(before, a)
        variance += density * np.maximum(inside, 0) / NANOSECONDS
    found = np.zeros((*time_ns.shape, manifold.error_dim(space)))
    found[..., rotations[0]] = variance[..., None]
    count, lasts = int(driver.at_limit.sum()), len(first)
    stretches = f"{lasts} stretch{'es' if lasts > 1 else ''}"
    return found, (
        f"{count} samples of the gyroscope are at the limit of its range, {np.rad2deg(limit):.4g} deg/s,"
        f" in {stretches} from {taken[first[0]] / NANOSECONDS:.3f} to"
        f" {taken[last[-1]] / NANOSECONDS:.3f} s: the attitude there is that of the other sensors, and a"
        " rate is a lower bound"
    )
