"""Clock offsets of any size between a tracker and an IMU.

The speeds of rotation of both need no frames and are correlated at every offset at which the streams share
some seconds. A peak of a correlation is no proof: `find` compares the rotations themselves at each peak,
and names the other offsets that fit as well, as with motion that repeats.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from jaxekf.calibration.motion_agreement import (
    CLEAR_ROTATION,
    SPANS_S,
    Integral,
    pair_steps,
    rotation_vectors,
)
from jaxekf.recordings.accounts import Indices
from jaxekf.recordings.types import Flags, Floats, Imu

_FINEST_S, _COARSEST_S = 0.02, 0.1
"""Bounds on the step of the grid, s."""
_LONGEST_GAP_S = 0.1
_MOST_POINTS = 4_000_000
_LEAST_S, _LEAST_SHARE = 5.0, 0.2
"""Seconds, and share of the shorter stream, that both must share at an offset."""
_APART_S = 0.5
"""Offsets closer than this are one."""
_CANDIDATES = 6
_LEAST_CORRELATION = 0.4
AGREE = 0.8
"""Least share of the tracker's rotation that the gyroscope explains at the right offset."""
ALIKE, NOISE = 3.0, 0.01
"""An offset fits as well as the best if its unexplained share, plus a little noise, is up to three times
as large."""
_LEAST_CHANGE = np.deg2rad(2.0)
"""Standard deviation of a speed, rad/s, below which the motion determines no offset."""

Attitude = Callable[[Indices], Floats]
"""Takes indices of samples (n,) to quaternions (n, 4), tool to reference."""


class OffsetSearch(NamedTuple):
    """Result of a search for a clock offset."""

    offset_s: float
    """Lag of the tracker's time stamps, s; NaN if no offset fits."""
    explained: float
    """Share of the tracker's squared rotation that the gyroscope explains there."""
    others_s: tuple[float, ...]
    """Other offsets that fit as well, s."""
    within_s: float
    """Largest offset that was searched, s; 0 if the motion is too slow or too steady for a search."""


class Speeds(NamedTuple):
    """Speeds of rotation on uniform time grids of one step."""

    step_s: float
    tracker: Floats
    """(N,) rad/s, 0 where unknown."""
    tracked: Flags
    gyroscope: Floats
    """(M,) rad/s."""
    covered: Flags
    ahead_s: float
    """Time of the tracker's first point, s from the gyroscope's first."""


def speeds(t: Floats, attitude: Attitude, imu: Imu) -> Speeds | None:
    """Speeds of rotation over about 0.1 s, less for fast motion and more for slow; None for few samples.

    Parameters
    ----------
    t
        (N,) times of the tracker's valid attitudes, s from the IMU's first sample.
    attitude
        Attitudes at some of these times.
    imu
        Rates of the IMU.
    """
    if len(t) < 3 or len(imu.time_ns) < 3:
        return None
    integral, step = Integral(imu.time_ns, imu.gyroscope), float(np.median(np.diff(t)))
    clear = _clear_speed(t, attitude(np.arange(len(t))))
    if clear is None:
        return None
    width, centre, speed = clear
    grid_s = max(_FINEST_S, min(0.5 * width, _COARSEST_S))
    if max(integral.t[-1], np.ptp(t)) / grid_s > _MOST_POINTS:
        return None
    speed = np.minimum(speed, np.quantile(speed, 0.98))
    at = np.arange(centre[0], centre[-1], grid_s)
    known = np.arange(0.5 * width, integral.t[-1] - 0.5 * width, grid_s)
    if min(len(at), len(known)) < 3:
        return None
    rotated = integral.between(known - 0.5 * width, known + 0.5 * width)
    return Speeds(
        grid_s,
        np.interp(at, centre, speed),
        _near(at, centre, max(1.5 * step, grid_s)),
        np.linalg.norm(rotated, axis=1) / width,
        _near(known, integral.t, max(_LONGEST_GAP_S, width)),
        float(at[0] - known[0]),
    )


def _clear_speed(t: Floats, q: Floats) -> tuple[float, Floats, Floats] | None:
    """Time span, s, over which the tracker's rotation is clear, and centres and speeds of these spans."""
    step, found = float(np.median(np.diff(t))), None
    for span_s in SPANS_S:
        steps = pair_steps(t, q.__getitem__, span_s)
        apart = t[steps:] - t[:-steps]
        good = apart <= 1.5 * steps * step
        if good.sum() < 3:
            break
        turned = np.linalg.norm(rotation_vectors(q[:-steps], q[steps:]), axis=1)[good]
        found = steps * step, (t[:-steps] + 0.5 * apart)[good], turned / apart[good]
        if np.quantile(turned, 0.9) > CLEAR_ROTATION:
            break
    return found


def _near(at: Floats, samples: Floats, within: float) -> Flags:
    """Points (N,) that have a sample on each side, not further apart than some time."""
    after = np.clip(np.searchsorted(samples, at), 1, len(samples) - 1)
    return samples[after] - samples[after - 1] <= within


def correlations(made: Speeds) -> tuple[Floats, Floats, Floats]:
    """Correlation coefficients of both speeds at every offset.

    Parameters
    ----------
    made
        The speeds.

    Returns
    -------
    offsets, coefficients and shared seconds, (K,) each; coefficients are -1 where too little is shared.
    """
    tracked = made.tracked
    count = len(made.tracker) + len(made.gyroscope) - 1
    size = int(next_fast_len(count, True) or count)

    def spectra(values: Floats, mask: Flags) -> list[Any]:
        centred = np.where(mask, values - values[mask].mean(), 0.0) / max(values[mask].std(), 1e-12)
        return [rfft(x, size) for x in (mask.astype(float), centred, centred**2)]

    if not tracked.any() or not made.covered.any():
        return np.zeros(0), np.zeros(0), np.zeros(0)
    ones, one, squared = spectra(made.tracker, tracked)
    masks, other, squares = (np.conj(x) for x in spectra(made.gyroscope, made.covered))

    def products(a: Any, b: Any) -> Floats:
        found = np.asarray(irfft(a * b, size), float)
        return np.concatenate([found[size - len(made.gyroscope) + 1 :], found[: len(made.tracker)]])

    shared = np.maximum(np.round(products(ones, masks)), 1.0)
    sums = products(one, masks), products(ones, other)
    variance = (
        products(squared, masks) - sums[0] ** 2 / shared,
        products(ones, squares) - sums[1] ** 2 / shared,
    )
    both = np.sqrt(np.maximum(variance[0], 0.0) * np.maximum(variance[1], 0.0))
    coefficient = (products(one, other) - sums[0] * sums[1] / shared) / np.maximum(both, 1e-12)
    least = max(
        _LEAST_S / made.step_s, _LEAST_SHARE * min(float(tracked.sum()), float(made.covered.sum()))
    )
    usable = (shared >= least) & (both > 1e-3 * shared)
    lags = np.arange(1 - len(made.gyroscope), len(made.tracker)) * made.step_s + made.ahead_s
    found = (lags, np.where(usable, coefficient, -1.0), shared * made.step_s)
    return found[0].astype(float), found[1].astype(float), found[2].astype(float)


def find(
    t: Floats,
    attitude: Attitude,
    imu: Imu,
    agreement: Callable[[float], tuple[float, float]],
) -> OffsetSearch:
    """Search all offsets at which both streams share five seconds and a fifth of the shorter one.

    Parameters
    ----------
    t, attitude, imu
        As for `speeds`.
    agreement
        Takes an offset, s, to the precise lag near it, s, and the share of the rotation that is explained.

    Returns
    -------
    OffsetSearch
    """
    made = speeds(t, attitude, imu)
    nothing = OffsetSearch(np.nan, 0.0, (), 0.0)
    if made is None or not made.tracked.any() or not made.covered.any():
        return nothing
    change = made.tracker[made.tracked].std(), made.gyroscope[made.covered].std()
    if min(change) < _LEAST_CHANGE:
        return nothing
    lags, coefficient, shared = correlations(made)
    usable = coefficient > -1.0
    if not usable.any():
        return nothing
    within = float(np.max(np.abs(lags[usable])))
    judged = sorted(
        (agreement(lag) for lag in _peaks(lags, coefficient, shared)), key=lambda found: -found[1]
    )
    if not judged or judged[0][1] < AGREE:
        return OffsetSearch(np.nan, judged[0][1] if judged else 0.0, (), within)
    best, explained = judged[0]
    others = [
        lag
        for lag, share in judged[1:]
        if abs(lag - best) > 0.5 * _APART_S and fits_as_well(share, explained)
    ]
    return OffsetSearch(best, explained, tuple(others), within)


def fits_as_well(share: float, best: float) -> bool:
    """Whether an explained share is as good as the best one, but for noise."""
    return 1.0 - share < ALIKE * (1.0 - best + NOISE)


def _peaks(lags: Floats, coefficient: Floats, shared: Floats) -> list[float]:
    """Offsets of the largest correlations, apart from each other; a longer shared time counts more."""
    score = np.arctanh(np.clip(coefficient, -0.999, 0.999)) * np.sqrt(shared)
    found = []
    for _ in range(_CANDIDATES):
        best = int(np.argmax(score))
        if not score[best] > -np.inf or coefficient[best] < _LEAST_CORRELATION:
            break
        found.append(float(lags[best]))
        score[np.abs(lags - lags[best]) < _APART_S] = -np.inf
    return found
