"""Consistency of a filter: NEES and NIS against their degrees of freedom, and whiteness of innovations.

The functions compute statistics of arrays, for one run or several; `jaxekf.evaluation.diagnosis` interprets
them.
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
"""Share of samples of a consistent filter within a `Consistency.band`."""
SURE = 0.999
"""Confidence level of the intervals."""
LONGEST_LAG_S = 2.0
MOST_LAGS = 400
_CERTAIN = 4.0


@dataclass(frozen=True)
class Consistency:
    """Normalised squares (NIS of innovations, NEES of errors) against the chi-square distribution.

    Examples
    --------
    The NIS of the tracker: 1 is within the confidence interval of its mean:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5")
    >>> nis = jaxekf.diagnose(estimate).sensors["optical"].nis
    >>> print(f"{nis.mean:.2f} of {nis.samples} samples of {nis.freedom:.0f} degrees of freedom")
    0.98 of 1272 samples of 3 degrees of freedom
    >>> nis.interval[0] < 1.0 < nis.interval[1]
    True
    """

    samples: int
    """Number of squares."""
    freedom: float
    """Mean degrees of freedom of a sample."""
    mean: float
    """Mean square per degree of freedom: 1 for a consistent filter, above 1 if overconfident. NaN for no
    samples."""
    effective: float
    """Equivalent number of independent samples: fewer than `samples` if they are correlated."""
    interval: tuple[float, float]
    """Confidence interval of the true mean at level `SURE`, from `effective` samples."""
    band: tuple[float, float]
    """Interval of a single square of the commonest degrees of freedom, with probability `BAND`."""
    inside: float
    """Share of samples within their band; `BAND` for a consistent filter."""
    typical: float
    """The same as `mean`, but from the median, which outliers do not change."""
    ks: float
    """Kolmogorov-Smirnov distance between the squares and the chi-square distribution."""
    ks_p: float
    """Its p-value, from samples far enough apart to be nearly independent."""

    @property
    def factor(self) -> float:
        """Ratio of the actual to the predicted standard deviation: the root of `mean`."""
        return float(np.sqrt(self.mean))


@dataclass(frozen=True)
class Whiteness:
    """Statistics of whitened innovations, which are independent with variance 1 for a consistent filter.

    Examples
    --------
    The share of lags at which the autocorrelation is within its bound of 95 %:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5")
    >>> white = jaxekf.diagnose(estimate).sensors["optical"].whiteness
    >>> white.autocorrelation.shape, bool(white.p > 1e-3)
    ((3, 125), True)
    >>> print(f"{(abs(white.autocorrelation) < white.bound).mean():.0%}")
    95%
    """

    lag_s: Floats
    """(L,) s, from one sampling period on."""
    autocorrelation: Floats
    """(rows, L), about zero: an innovation has mean zero, which is not subtracted."""
    bound: Floats
    """(L,) exceeded by a white row with probability 1 - `BAND`."""
    correlated_s: float
    """Correlation time, s: when the sum of the rows' mean autocorrelation reaches 1 - 1/e of its largest
    value; 0 if the sum is never significantly positive."""
    total: float
    """Sum of the rows' mean autocorrelation over `lag_s`."""
    total_sigma: float
    """Standard deviation of `total` for white innovations."""
    p: float
    """P-value of the Ljung-Box test over all rows and lags."""
    mean: Floats
    """(rows,) mean; 0 for unbiased innovations."""
    mean_sigma: Floats
    """(rows,) its standard deviation, with autocorrelation."""
    scale: Floats
    """(rows,) root mean square: 1 if the row's covariance is right."""


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
    """Values (N, rows) on a grid of the nominal period, NaN in gaps, so that lags are times.

    Samples that fit no such grid are returned as they are, one per lag.
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

    NaN values form no pairs. Several series are treated as realisations of one process.
    """
    products = pairs = np.zeros(0)
    for values in series:
        finite = np.isfinite(values)
        size: Any = next_fast_len(len(values) + lags + 1, real=True)
        found = [_lagged(np.where(finite, values, 0.0), lags, size), _lagged(finite, lags, size)]
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
    """Factor, at least 1, by which autocorrelation increases the variance of a mean.

    Autocorrelations up to the first one within its bound are summed.
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
    """Normalised squares of several runs against the chi-square distribution.

    Parameters
    ----------
    squares
        Squares (N,) of each run in order of time.
    freedom
        Degrees of freedom (N,) of each run; samples with none are ignored.
    """
    # Slow to import, and only needed here.
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
    """Whiteness of the innovations of several runs.

    Parameters
    ----------
    times
        Times (N,) of each run, ns.
    whitened
        Whitened innovations (N, rows) of each run, NaN in unused rows.
    """
    periods = [period_ns(t) for t in times if len(t) > 1]
    period = float(np.median(periods)) / NANOSECONDS if periods else 1.0
    # Series without samples stay: they give the number of rows of a sensor that no run has read.
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
