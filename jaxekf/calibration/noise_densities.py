"""Noise densities of a sensor at rest, by maximum likelihood on the spectrum of its differences.

A sample is a constant, and quantisation, white noise, flicker and a random walk. The sine transform of
the differences from sample to sample makes those of white noise and walk independent, exactly; with
``l = 2 - 2 cos(pi j / n)``, ``j = 1 ... n - 1``, and a sampling period ``t`` line ``j`` has the variance

    Q^2 l^2 / t^2  +  N^2 l / t  +  B^2 sqrt(l)  +  K^2 t

of which the first and third term hold approximately. The Allan deviations of the four are
``sqrt(3) Q / tau``, ``N / sqrt(tau)``, ``sqrt(2 ln 2 / pi) B`` and ``K sqrt(tau / 3)`` (IEEE Std 952).
Intervals are those of the profile likelihood, which needs no normal distribution and tells zero from small.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import dst
from scipy.optimize import brentq, nnls

from jaxekf._support import chi_square
from jaxekf._support.deprecations import renamed
from jaxekf.recordings.types import Flags, Floats

TERMS = ("quantisation", "white", "flicker", "walk")
_ALL = _QUANTISATION, _WHITE, _FLICKER, _WALK = (0, 1, 2, 3)
_INTERVAL = float(chi_square.ppf(0.95, 1))
_SIGNIFICANT = float(chi_square.ppf(0.99, 1))
"""By how much twice the logarithm of the likelihood must grow for a third term to be believed."""
_LINES_PER_E = 25.0
_ROUNDS = 60
_MISFIT, _MISFIT_SIGMAS = 0.1, 4.0
"""Third-octaves off by more than both say that the noise is of another kind up there."""
_PEAK, _PEAK_SIGMAS, _PEAK_ROUNDS = 0.5, 6.0, 4
"""Lines larger by more than both are of a vibration."""
_OCTAVES_JUDGED, _OCTAVES_DROPPED = 7, 6
_LEAST_LINES = 100


class Coefficient(NamedTuple):
    """A coefficient with its 95 % interval; `low` is 0 where the data do not tell it from nothing."""

    value: float
    low: float
    high: float

    @property
    def significant(self) -> bool:
        """Whether it is told from nothing."""
        return self.low > 0.0


class Densities(NamedTuple):
    """What one axis is made of, in the unit ``u`` of its samples."""

    quantisation: float
    """Q, u s."""
    white: Coefficient
    """N, u/sqrt(Hz)."""
    flicker: float
    """B, u; 0 where nothing speaks for it."""
    walk: Coefficient
    """K, u/s/sqrt(Hz)."""
    walk_alone: Coefficient
    """K, u/s/sqrt(Hz), where a walk has to stand for flicker too, as in a filter that knows no flicker."""
    band_hz: float
    """Up to this frequency the noise is of this kind, and was used."""

    def deviation(self, tau: Floats) -> Floats:
        """Allan deviation (T,) at `tau` (T,), s."""
        return np.sqrt(self._parts(tau).sum(axis=0))

    def exponent(self, tau: Floats) -> Floats:
        """Of the power law in frequency that most of the deviation is due to: 2, 0, -1 or -2, (T,)."""
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
    """Lines of a spectrum, neighbours together."""

    held: Floats
    """(L,)."""
    power: Floats
    """(L,) mean square."""
    shape: Floats
    """(L, 4) mean square of each term of coefficient 1."""
    hertz: Floats
    """(L,)."""

    def where(self, chosen: Flags) -> "_Lines":
        """Some of them."""
        return _Lines(*(field[chosen] for field in self))


def fit(values: Floats, period_s: float) -> Densities:
    """Coefficients of one axis from its samples (n,), evenly spaced.

    Where the spectrum is not of the four kinds at its upper end (a low pass in the sensor), octaves are
    left out there, as a filter cares for what remains over many samples; single peaks (a vibration) are
    left out anywhere. `values` that never change give zeros.
    """
    step = np.diff(np.asarray(values, float))
    if not step.any():
        nothing = Coefficient(0.0, 0.0, 0.0)
        return Densities(0.0, nothing, 0.0, nothing, nothing, 0.5 / period_s)
    lines = _of_the_four_kinds(_lines(step, period_s))
    terms, found = (_WHITE, _WALK), _maximise(lines, (_WHITE, _WALK))
    spread = _spread(lines, _maximise(lines, _ALL))
    terms, found = _with(lines, terms, found, _QUANTISATION, spread)
    alone = _interval(lines, terms, found, _WALK, spread)
    terms, found = _with(lines, terms, found, _FLICKER, spread)
    return Densities(
        float(np.sqrt(found[_QUANTISATION])),
        _interval(lines, terms, found, _WHITE, spread),
        float(np.sqrt(found[_FLICKER])),
        _interval(lines, terms, found, _WALK, spread),
        alone,
        float(lines.hertz[-1]),
    )


def _with(
    lines: _Lines, terms: tuple[int, ...], found: Floats, term: int, spread: float
) -> tuple[tuple[int, ...], Floats]:
    """One term more, where the likelihood speaks for it."""
    richer = _maximise(lines, (*terms, term))
    if _cost(lines, found) - _cost(lines, richer) > spread * _SIGNIFICANT:
        return (*terms, term), richer
    return terms, found


def _of_the_four_kinds(lines: _Lines) -> _Lines:
    """The part of a spectrum that is, from low frequencies up, without single peaks in it."""
    best, least = lines, np.inf
    for _ in range(_OCTAVES_DROPPED):
        kept = lines
        for _ in range(_PEAK_ROUNDS):
            ratio = kept.power / (kept.shape @ _maximise(kept, _ALL))
            low = ratio <= 1.0 + np.maximum(_PEAK, _PEAK_SIGMAS * np.sqrt(2.0 / kept.held))
            if low.all():
                break
            kept = kept.where(low)
        misfit = _misfit(kept, kept.shape @ _maximise(kept, _ALL))
        if misfit < least:
            best, least = kept, misfit
        lower = lines.hertz <= 0.5 * lines.hertz[-1]
        if misfit == 0.0 or lines.held[lower].sum() < _LEAST_LINES:
            break
        lines = lines.where(lower)
    return best


def _lines(step: Floats, period_s: float) -> _Lines:
    """The spectrum of differences, in bins that are narrow beside any change of the terms."""
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
    """Minus twice the logarithm of the likelihood."""
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
    """Coefficients (4,), squared, of the largest likelihood, none negative: Fisher's scoring, each step a
    non-negative least-squares problem. `held` is one of them and its value."""
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
    """The coefficients that the likelihood does not refuse, all others at their best."""
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
    """Where an interval ends, going from within it."""
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
    """By how much the lines scatter more than they should, at least 1: intervals grow with it."""
    ratio = lines.power / (lines.shape @ found)
    return max(1.0, float(np.mean(0.5 * lines.held * np.square(ratio - 1.0))))


def _misfit(lines: _Lines, variance: Floats) -> float:
    """By how much third-octaves of the upper part are off, on average; 0 where none says so for sure."""
    near = lines.hertz >= lines.hertz[-1] / 2.0**_OCTAVES_JUDGED
    label = np.floor(3.0 * np.log2(lines.hertz[-1] / lines.hertz[near])).astype(int)
    held = np.bincount(label, lines.held[near])
    power = np.bincount(label, (lines.held * lines.power / variance)[near])
    ratio, held = power[held > 0.0] / held[held > 0.0], held[held > 0.0]
    off = np.abs(ratio - 1.0)
    if np.all(off <= np.maximum(_MISFIT, _MISFIT_SIGMAS * np.sqrt(2.0 / held))):
        return 0.0
    return float(off.mean())


__getattr__ = renamed(
    __name__,
    {
        "Estimated": "Coefficient",
    },
)
