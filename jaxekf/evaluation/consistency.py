"""Whether errors are as large as they are said to be, and whether innovations are white.

Statistics of arrays, for one run or several at once; `jaxekf.evaluation.diagnosis` says what they mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import ndtri

from jaxekf._support import chi_square
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Times, period_ns

BAND = 0.95
"""Share of honest samples that lie in a `Consistency.band`."""
SURE = 0.999
"""Probability with which an interval holds what it is of."""
LONGEST_LAG_S = 2.0
MOST_LAGS = 400
_CERTAIN = 4.0


@dataclass(frozen=True)
class Consistency:
    """Normalised squares (NIS of innovations, NEES of errors) against their chi-square law."""

    samples: int
    freedom: float
    """Mean number of degrees of freedom of a sample."""
    mean: float
    """Mean square by degree of freedom: 1 where honest, above where overconfident. NaN of none."""
    effective: float
    """Number of independent samples that would tell as much: fewer than `samples` where correlated."""
    interval: tuple[float, float]
    """In which the true mean lies with a probability of `SURE`, by `effective` samples."""
    band: tuple[float, float]
    """Square of a sample of the commonest number of degrees of freedom, in `BAND` of all cases."""
    inside: float
    """Share of samples inside their band; `BAND` where honest."""
    typical: float
    """As `mean`, but from the median: what outliers do not move."""
    ks: float
    """Kolmogorov-Smirnov distance of the squares from their law."""
    ks_p: float
    """Its p-value, of samples so far apart that they are nearly independent."""

    @property
    def factor(self) -> float:
        """By how much deviations are larger than said: the root of `mean`."""
        return float(np.sqrt(self.mean))


@dataclass(frozen=True)
class Whiteness:
    """Innovations scaled by the root of their predicted covariance: independent and of variance 1 where
    the filter is right."""

    lag_s: Floats
    """(L,) from one sampling period on."""
    autocorrelation: Floats
    """(rows, L), about zero: an innovation has no mean to be taken off."""
    bound: Floats
    """(L,) which a white row exceeds in 1 - `BAND` of all cases."""
    correlated_s: float
    """Seconds within which the sum of the rows' mean autocorrelation gains 1 - 1/e of its largest (the
    time constant of an exponential one); 0 where the sum is never certainly positive."""
    total: float
    """Sum of the rows' mean autocorrelation over `lag_s`."""
    total_sigma: float
    """Standard deviation of `total` where innovations are white."""
    p: float
    """Probability that white innovations look as correlated (Ljung-Box, all rows and lags)."""
    mean: Floats
    """(rows,); 0 where nothing pushes to one side."""
    mean_sigma: Floats
    """(rows,) its standard deviation, autocorrelation taken into account."""
    scale: Floats
    """(rows,) root mean square: 1 where the row's noise is right."""


def whiten(residual: Floats, cov: Floats, used: Flags) -> Floats:
    """``inv(chol(S)) e`` (N, rows) over the used rows of each sample; NaN in the others."""
    white = np.full(residual.shape, np.nan)
    patterns, which = np.unique(used, axis=0, return_inverse=True)
    for i, pattern in enumerate(patterns):
        rows, at = np.flatnonzero(pattern), np.flatnonzero(which.ravel() == i)
        if rows.size:
            factor = np.linalg.cholesky(cov[np.ix_(at, rows, rows)])
            solved = np.linalg.solve(factor, residual[np.ix_(at, rows)][:, :, None])
            white[np.ix_(at, rows)] = solved[:, :, 0]
    return white


def on_grid(time_ns: Times, values: Floats) -> Floats:
    """Values (N, rows) on a grid of the nominal period, NaN where there is none.

    A gap then is a gap in lags, too. Samples that fit no such grid stay as they are, one a lag.
    """
    period = period_ns(time_ns)
    if period <= 0:
        return values
    place = np.round((time_ns - time_ns[0]) / period).astype(np.int64)
    if np.any(np.diff(place) <= 0) or place[-1] > 20 * len(place):
        return values
    grid = np.full((place[-1] + 1, values.shape[1]), np.nan)
    grid[place] = values
    return grid


def autocorrelation(series: Sequence[Floats], lags: int) -> tuple[Floats, Floats]:
    """Autocorrelation (rows, lags + 1) about zero of series (M, rows), and the number of pairs.

    NaN values form no pairs. Several series are taken as draws of one law.
    """
    products = pairs = np.zeros(0)
    for values in series:
        seen = np.isfinite(values)
        size: Any = next_fast_len(len(values) + lags + 1, real=True)
        found = [_lagged(np.where(seen, values, 0.0), lags, size), _lagged(seen, lags, size)]
        products = found[0] if products.size == 0 else products + found[0]
        pairs = found[1] if pairs.size == 0 else pairs + found[1]
    pairs = np.round(pairs)
    with np.errstate(invalid="ignore", divide="ignore"):
        covariance = np.where(pairs > 0, products / pairs, 0.0)
        return np.where(covariance[:, :1] > 0, covariance / covariance[:, :1], 0.0), pairs


def _lagged(values: Any, lags: int, size: int) -> Floats:
    """``sum_t x_t x_(t + l)`` (rows, lags + 1)."""
    spectrum: Any = rfft(np.asarray(values, float), size, axis=0)
    full: Any = irfft(np.abs(spectrum) ** 2, size, axis=0)
    return full[: lags + 1].T


def inflation(series: Sequence[Floats], lags: int | None = None) -> float:
    """By how much the variance of a mean is larger for the correlation of its samples, at least 1.

    Autocorrelations count until the first that is within its bound.
    """
    count = sum(int(np.isfinite(values).sum()) for values in series)
    if count < 3:
        return 1.0
    longest = max(len(values) for values in series)
    rho, pairs = autocorrelation(series, min(longest // 3, 5000) if lags is None else lags)
    mean, number = rho.mean(axis=0)[1:], pairs.sum(axis=0)[1:]
    lost = mean * np.sqrt(np.maximum(number, 1.0)) < ndtri(0.5 + 0.5 * BAND)
    end = int(np.argmax(lost)) if lost.any() else len(mean)
    return float(max(1.0, 1.0 + 2.0 * mean[:end].sum()))


def judge_squares(squares: Sequence[Floats], freedom: Sequence[Any]) -> Consistency:
    """Normalised squares of several runs, each (N,), in order of time, against their degrees of freedom.

    Samples of no degree of freedom do not count.
    """
    # Half of what this package's imports would take: only for those who ask whether a run is consistent.
    from scipy.stats import kstest

    kept = [f > 0 for f in freedom]
    runs = [s[k] for s, k in zip(squares, kept, strict=True)]
    freedoms = [np.asarray(f[k], float) for f, k in zip(freedom, kept, strict=True)]
    square, degrees = np.concatenate(runs), np.concatenate(freedoms)
    nan = float("nan")
    if square.size == 0:
        return Consistency(0, nan, nan, 0.0, (nan, nan), (nan, nan), nan, nan, nan, nan)
    mean = float(square.sum() / degrees.sum())
    relative = [(s / f - mean)[:, None] for s, f in zip(runs, freedoms, strict=True)]
    grown = inflation(relative)
    effective = square.size / grown
    tails = np.array([0.5 * (1 + SURE), 0.5 * (1 - SURE)])
    total = degrees.sum() / grown
    low, high = mean * total / chi_square.ppf(tails, total)
    edges = np.array([0.5 * (1 - BAND), 0.5 * (1 + BAND)])
    place = chi_square.cdf(square, degrees)
    common = np.bincount(degrees.astype(int)).argmax()
    stride = int(np.ceil(grown))
    apart = np.concatenate(
        [chi_square.cdf(s, f)[::stride] for s, f in zip(runs, freedoms, strict=True)]
    )
    band: Any = chi_square.ppf(edges, common)
    return Consistency(
        samples=int(square.size),
        freedom=float(degrees.mean()),
        mean=mean,
        effective=float(effective),
        interval=(float(low), float(high)),
        band=(float(band[0]), float(band[1])),
        inside=float(np.mean((place >= edges[0]) & (place <= edges[1]))),
        typical=float(np.median(square / chi_square.ppf(0.5, degrees))),
        ks=float(kstest(place, "uniform").statistic),
        ks_p=float(kstest(apart, "uniform").pvalue),
    )


def judge_whiteness(times: Sequence[Times], whitened: Sequence[Floats]) -> Whiteness:
    """Whitened innovations of several runs, times (N,) and values (N, rows), NaN where not used."""
    periods = [period_ns(t) for t in times if len(t) > 1]
    period = float(np.median(periods)) / NANOSECONDS if periods else 1.0
    # Those without a sample stay: of a sensor that no run read there is no other that tells its rows.
    series = [on_grid(t, w) for t, w in zip(times, whitened, strict=True)]
    longest = max((len(s) for s in series), default=0)
    wanted = int(np.clip(round(LONGEST_LAG_S / max(period, 1e-9)), 10, MOST_LAGS))
    lags = max(1, min(wanted, longest // 4))
    rho, pairs = autocorrelation(series, lags)
    rho, pairs = rho[:, 1:], np.maximum(pairs[:, 1:], 1.0)
    mean, sigma = rho.mean(axis=0), 1.0 / np.sqrt(pairs.sum(axis=0))
    sums, spread = np.cumsum(mean), np.sqrt(np.cumsum(sigma**2))
    correlated = 0.0
    if np.any(sums > _CERTAIN * spread):
        correlated = period * (1 + int(np.argmax(sums >= (1.0 - 1.0 / np.e) * sums.max())))
    values = np.concatenate(whitened)
    count = np.maximum(np.isfinite(values).sum(axis=0), 1)
    middle = np.nansum(values, axis=0) / count
    grown = [inflation([s[:, [i]] - middle[i] for s in series]) for i in range(values.shape[1])]
    deviation = np.sqrt(np.nansum((values - middle) ** 2, axis=0) / count)
    return Whiteness(
        lag_s=np.asarray(period * np.arange(1, lags + 1), float),
        autocorrelation=rho,
        bound=ndtri(0.5 * (1 + BAND)) / np.sqrt(pairs.mean(axis=0)),
        correlated_s=float(correlated),
        total=float(mean.sum()),
        total_sigma=float(spread[-1]),
        p=float(chi_square.sf(np.sum(rho**2 * pairs), rho.size)),
        mean=middle,
        mean_sigma=deviation * np.sqrt(np.array(grown) / count),
        scale=np.sqrt(np.nansum(values**2, axis=0) / count),
    )
