"""Variance of the rotation that a gyroscope at the limit of its range does not measure."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxekf.geometry import manifold
from jaxekf.geometry.manifold import SO3
from jaxekf.recordings.types import NANOSECONDS, Floats, Samples, Times

_SHARE = 0.5
"""Standard deviation of the rate beyond the limit, as a share of the limit."""


def excess_rotation(
    space: Any, driver: Samples | None, samples: Mapping[str, Samples], time_ns: Times, dt: Floats
) -> tuple[Floats | None, tuple[str, ...]]:
    """Variances (K, S, n) for `Steps.excess`, and a note; None where no sample is at the limit.

    The excess over a stretch of length T has the standard deviation ``0.5 limit T`` about each axis, spread
    evenly over its steps. A stretch begins and ends a sample beyond the first and the last at the limit.
    Where the gyroscope is a measurement, which is masked then, the rate wanders by as much as the limit.

    Parameters
    ----------
    space
        The model's; its first rotation is the one that the gyroscope drives, its part ``rate`` the one that
        the gyroscope measures.
    driver
        The input (N, c), whose first three channels are the rate; None for a model without.
    samples
        Those of the sensors.
    time_ns, dt
        (K, S) end, ns, and length, s, of each substep.
    """
    parts = manifold.parts(space)
    errors = [p.error for p in parts if isinstance(p.manifold, SO3)]
    angle = driver is not None
    if driver is None:
        errors = [p.error for p in parts if p.name == "rate"]
        limited = [one for one in samples.values() if one.at_limit is not None]
        driver = limited[0] if limited else None
    if driver is None or driver.at_limit is None or not driver.at_limit.any() or not errors:
        return None, ()
    value, taken = np.asarray(driver.value)[:, :3], driver.time_ns
    edges = np.flatnonzero(np.diff(np.r_[False, driver.at_limit, False].astype(int)))
    first, last = edges[::2], edges[1::2] - 1
    begin = taken[np.maximum(first - 1, 0)]
    end = taken[np.minimum(last + 1, len(taken) - 1)]
    limit = np.abs(value[driver.at_limit]).max()
    lasts = (end - begin) / NANOSECONDS
    spread = (_SHARE * limit) ** 2 * lasts if angle else limit**2 / lasts
    # The variance gathered until a time has the slope of the stretches that contain it.
    at, change = np.r_[begin, end], np.r_[spread, -spread]
    order = np.argsort(at, kind="stable")
    since = (at[order] - at.min()) / NANOSECONDS
    gathered = np.r_[0.0, np.cumsum(np.cumsum(change[order])[:-1] * np.diff(since))]
    until = (time_ns - at.min()) / NANOSECONDS
    variance = np.interp(until, since, gathered) - np.interp(until - dt, since, gathered)
    variance = np.maximum(variance, 0.0)
    found = np.zeros((*time_ns.shape, manifold.error_dim(space)))
    found[..., errors[0]] = variance[..., None]
    count = int(driver.at_limit.sum())
    stretches = f"{len(first)} stretch{'es' if len(first) > 1 else ''}"
    text = (
        f"{count} samples of the gyroscope are at the limit of its range, {np.rad2deg(limit):.4g} deg/s,"
        f" in {stretches} from {taken[first[0]] / NANOSECONDS:.3f} to"
        f" {taken[last[-1]] / NANOSECONDS:.3f} s: the attitude there is that of the other sensors, and a"
        " rate is a lower bound"
    )
    return found, (text,)
