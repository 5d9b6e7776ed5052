"""Noise densities of a sensor at rest, by maximum likelihood on the spectrum of its differences.

The model of a sample is a constant plus quantisation, white noise, flicker noise and a random walk. The
sine transform of the differences from sample to sample makes those of white noise and walk exactly
independent; with ``l = 2 - 2 cos(pi j / n)``, ``j = 1 ... n - 1``, and a sampling period ``t``, line ``j``
has the variance

    Q^2 l^2 / t^2  +  N^2 l / t  +  B^2 sqrt(l)  +  K^2 t

The first and the third term are approximations. The Allan deviations of the four are ``sqrt(3) Q / tau``,
``N / sqrt(tau)``, ``sqrt(2 ln 2 / pi) B`` and ``K sqrt(tau / 3)`` (IEEE Std 952). Confidence intervals are
those of the profile likelihood, which needs no normal distribution and distinguishes zero from small.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import dst
from scipy.optimize import brentq, nnls

from jaxekf._support import arrays, chi_square
from jaxekf._support.deprecations import renamed
from jaxekf.recordings.types import Flags, Floats

TERMS = ("quantisation", "white", "flicker", "walk")
_ALL = _QUANTISATION, _WHITE, _FLICKER, _WALK = (0, 1, 2, 3)
_INTERVAL = float(chi_square.ppf(0.95, 1))
_SIGNIFICANT = float(chi_square.ppf(0.99, 1))
"""Increase of twice the log-likelihood from which a further term is significant."""
_LINES_PER_E = 25.0
_ROUNDS = 60
_MISFIT, _MISFIT_SIGMAS = 0.1, 4.0
"""Third-octaves off by more than both: the noise is of another type at those frequencies."""
_PEAK, _PEAK_SIGMAS, _PEAK_ROUNDS = 0.5, 6.0, 4
"""Lines larger than the model by more than both belong to a vibration."""
_OCTAVES_JUDGED, _OCTAVES_DROPPED = 7, 6
_LEAST_LINES = 100


class Coefficient(NamedTuple):
    """A coefficient with its 95 % interval; `low` is 0 if it is not significant."""

    value: float
    low: float
    high: float

    @property
    def significant(self) -> bool:
        """Whether the coefficient differs significantly from zero."""
        return self.low > 0.0


class Densities(NamedTuple):
    """Noise of one axis, in the unit ``u`` of its samples."""

    quantisation: float
    """Q, u s."""
    white: Coefficient
    """N, u/sqrt(Hz)."""
    flicker: float
    """B, u; 0 if it is not significant."""
    walk: Coefficient
    """K, u/s/sqrt(Hz)."""
    walk_alone: Coefficient
    """K, u/s/sqrt(Hz), fitted without flicker noise, for a filter whose model has none."""
    band_hz: float
    """Highest frequency, Hz, that was used; above it the noise is of another type."""

    def deviation(self, tau: Floats) -> Floats:
        """Allan deviation (T,) at `tau` (T,), s."""
        return np.sqrt(self._parts(tau).sum(axis=0))

    def exponent(self, tau: Floats) -> Floats:
        """Exponent in frequency of the noise type that dominates at `tau`: 2, 0, -1 or -2, (T,)."""
        return np.array([2, 0, -1, -2])[self._parts(tau).argmax(axis=0)]

    def _parts(self, tau: Floats) -> Floats:
        return np.array(
            [
                3.0 * self.quantisation**2 / tau**2,
                self.white.value**2 / tau,
                np.full_like(tau, 2.0 * np.log(2.0) / np.pi * self.flicker**2),
                self.walk.value**2 * tau / 3.0,
            ]
        )


class _Lines(NamedTuple):
    """Lines of a spectrum, neighbours averaged."""

    held: Floats
    """(L,) lines that were averaged."""
    power: Floats
    """(L,) mean square."""
    shape: Floats
    """(L, 4) mean square of each term of coefficient 1."""
    hertz: Floats
    """(L,)."""

    def select(self, chosen: Flags) -> "_Lines":
        """Some of them."""
        return _Lines(*(field[chosen] for field in self))


def fit(values: Floats, period_s: float) -> Densities:
    """Noise coefficients of one axis.

    If the spectrum's upper end does not fit the four terms (a low pass in the sensor), octaves are left out
    there, since a filter depends on the noise over many samples. Single peaks (a vibration) are left out
    everywhere. Values that never change give zeros.

    Parameters
    ----------
    values
        (n,) evenly spaced static samples.
    period_s
        Sampling period, s.
    """
    step = np.diff(arrays.floats(values, arrays.argument("values"), (None,)))
    if not step.any():
        nothing = Coefficient(0.0, 0.0, 0.0)
        return Densities(0.0, nothing, 0.0, nothing, nothing, 0.5 / period_s)
    lines = _fitting_lines(_lines(step, period_s))
    terms, found = (_WHITE, _WALK), _maximise(lines, (_WHITE, _WALK))
    spread = _spread(lines, _maximise(lines, _ALL))
    terms, found = _with_term(lines, terms, found, _QUANTISATION, spread)
    alone = _interval(lines, terms, found, _WALK, spread)
    terms, found = _with_term(lines, terms, found, _FLICKER, spread)
    return Densities(
        float(np.sqrt(found[_QUANTISATION])),
        _interval(lines, terms, found, _WHITE, spread),
        float(np.sqrt(found[_FLICKER])),
        _interval(lines, terms, found, _WALK, spread),
        alone,
        float(lines.hertz[-1]),
    )


def _with_term(
    lines: _Lines, terms: tuple[int, ...], found: Floats, term: int, spread: float
) -> tuple[tuple[int, ...], Floats]:
    """Add a term if the likelihood ratio is significant."""
    richer = _maximise(lines, (*terms, term))
    if _cost(lines, found) - _cost(lines, richer) > spread * _SIGNIFICANT:
        return (*terms, term), richer
    return terms, found


def _fitting_lines(lines: _Lines) -> _Lines:
    """The lines that fit the four terms, from low frequencies up, without single peaks."""
    best, least = lines, np.inf
    for _ in range(_OCTAVES_DROPPED):
        kept = lines
        for _ in range(_PEAK_ROUNDS):
            ratio = kept.power / (kept.shape @ _maximise(kept, _ALL))
            low = ratio <= 1.0 + np.maximum(_PEAK, _PEAK_SIGMAS * np.sqrt(2.0 / kept.held))
            if low.all():
                break
            kept = kept.select(low)
        misfit = _misfit(kept, kept.shape @ _maximise(kept, _ALL))
        if misfit < least:
            best, least = kept, misfit
        lower = lines.hertz <= 0.5 * lines.hertz[-1]
        if misfit == 0.0 or lines.held[lower].sum() < _LEAST_LINES:
            break
        lines = lines.select(lower)
    return best


def _lines(step: Floats, period_s: float) -> _Lines:
    """Spectrum of differences, in bins that are narrow relative to any change of the terms."""
    count = len(step)
    power = np.asarray(dst(step, type=1, norm="ortho")) ** 2
    number = np.arange(1, count + 1)
    size = 2.0 - 2.0 * np.cos(np.pi * number / (count + 1))
    shape = np.stack(
        [size**2 / period_s**2, size / period_s, np.sqrt(size), np.full(count, period_s)], axis=1
    )
    label = np.floor(_LINES_PER_E * np.log(number)).astype(int)
    begin = np.flatnonzero(np.diff(label, prepend=-1))
    held = np.diff(np.append(begin, count)).astype(float)
    hertz = number / (2.0 * (count + 1) * period_s)
    return _Lines(
        held,
        np.add.reduceat(power, begin) / held,
        np.add.reduceat(shape, begin, axis=0) / held[:, None],
        hertz[np.append(begin[1:] - 1, count - 1)],
    )


def _cost(lines: _Lines, coefficients: Floats) -> float:
    """Minus twice the log-likelihood."""
    variance = lines.shape @ coefficients
    if not np.all(variance > 0.0):
        return np.inf
    return float(np.sum(lines.held * (np.log(variance) + lines.power / variance)))


def _maximise(
    lines: _Lines,
    terms: tuple[int, ...],
    held: tuple[int, float] | None = None,
    start: Floats | None = None,
) -> Floats:
    """Squared coefficients (4,) of the largest likelihood, none negative.

    Fisher scoring, each step a non-negative least-squares problem. `held` fixes one coefficient: its index
    and its value.
    """
    free = [term for term in terms if held is None or term != held[0]]
    fixed = np.zeros(4)
    if held is not None:
        fixed[held[0]] = held[1]
    scale = np.array([1.0 / np.mean(lines.shape[:, term] / lines.power) for term in free])
    found = fixed.copy()
    found[free] = scale / len(free) if start is None else np.maximum(start[free], 1e-9 * scale)
    cost = _cost(lines, found)
    for _ in range(_ROUNDS):
        variance = lines.shape @ found
        weight = np.sqrt(0.5 * lines.held) / variance
        rest = lines.power - lines.shape @ fixed
        aim = fixed.copy()
        aim[free] = scale * nnls(weight[:, None] * lines.shape[:, free] * scale, weight * rest)[0]
        share, before = 1.0, cost
        while share > 1e-4:
            tried = found + share * (aim - found)
            cost = _cost(lines, tried)
            if cost <= before:
                found = tried
                break
            share *= 0.5
        else:
            return found
        if before - cost < 1e-7:
            return found
    return found


def _interval(
    lines: _Lines, terms: tuple[int, ...], found: Floats, term: int, spread: float
) -> Coefficient:
    """Confidence interval by the profile likelihood: the other coefficients are at their best."""
    best = _cost(lines, found)

    def excess(value: float) -> float:
        other = _maximise(lines, terms, (term, value), found)
        return _cost(lines, other) - best - spread * _INTERVAL

    scale = float(1.0 / np.mean(lines.shape[:, term] / lines.power))
    high = _crossing(excess, max(float(found[term]), 1e-6 * scale), 2.0)
    low = 0.0
    if found[term] > 0.0 and excess(0.0) > 0.0:
        low = _crossing(excess, float(found[term]), 0.5)
    return Coefficient(*(float(np.sqrt(value)) for value in (found[term], low, high)))


def _crossing(excess: Callable[[float], float], begin: float, factor: float) -> float:
    """End of a confidence interval, searched outwards from a point within it."""
    inner = begin
    for _ in range(80):
        outer = inner * factor
        if excess(outer) > 0.0:
            ends = sorted((np.log(inner), np.log(outer)))
            found: Any = brentq(lambda at: excess(float(np.exp(at))), *ends, xtol=1e-3)
            return float(np.exp(found))
        inner = outer
    return inner


def _spread(lines: _Lines, found: Floats) -> float:
    """Factor, at least 1, by which the lines scatter more than the model; it widens the intervals."""
    ratio = lines.power / (lines.shape @ found)
    return max(1.0, float(np.mean(0.5 * lines.held * np.square(ratio - 1.0))))


def _misfit(lines: _Lines, variance: Floats) -> float:
    """Mean relative error of the third-octaves of the upper part; 0 if none is significant."""
    near = lines.hertz >= lines.hertz[-1] / 2.0**_OCTAVES_JUDGED
    label = np.floor(3.0 * np.log2(lines.hertz[-1] / lines.hertz[near])).astype(int)
    held = np.bincount(label, lines.held[near])
    power = np.bincount(label, (lines.held * lines.power / variance)[near])
    ratio, held = power[held > 0.0] / held[held > 0.0], held[held > 0.0]
    off = np.abs(ratio - 1.0)
    if np.all(off <= np.maximum(_MISFIT, _MISFIT_SIGMAS * np.sqrt(2.0 / held))):
        return 0.0
    return float(off.mean())


__getattr__ = renamed(__name__, "Estimated>Coefficient")
