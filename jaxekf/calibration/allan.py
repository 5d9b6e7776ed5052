"""Overlapping Allan deviation of a sensor at rest, and what a static recording tells of its noise.

The square of the deviation at ``tau`` is half the mean square of ``mean over the next tau - mean over this
tau``, over all places to begin. Its intervals are those of chi-square with the equivalent degrees of
freedom of the kind of noise that prevails at ``tau`` (Riley, NIST SP 1065, table 5, overlapping estimator).
"""

from typing import NamedTuple

import numpy as np

from jaxekf._support import chi_square
from jaxekf._support.errors import RecordingError
from jaxekf.calibration.noise_densities import Densities, fit
from jaxekf.recordings.types import NANOSECONDS, Floats, Imu, Times, period_ns

_PER_OCTAVE = 3
_LARGEST_SHARE = 0.1
"""Of the length: the longest time that is averaged over."""
_LONGEST_GAP = 20
"""Samples in a row that may be missing; they are interpolated, further ones end a stretch."""
_MISSING_SHARE = 0.02
_LEAST_SAMPLES = 100
_LEAST_S = 3.0


class Curve(NamedTuple):
    """Allan deviation over averaging time, of three axes, with 95 % intervals; in the samples' unit."""

    tau: Floats
    """(T,) seconds."""
    deviation: Floats
    """(T, 3)."""
    low: Floats
    """(T, 3)."""
    high: Floats
    """(T, 3)."""


class SensorNoise(NamedTuple):
    """One sensor of three axes at rest."""

    unit: str
    curve: Curve
    axes: tuple[Densities, Densities, Densities]

    @property
    def white(self) -> Floats:
        """(3,) density of the white noise, unit/sqrt(Hz)."""
        return np.array([axis.white.value for axis in self.axes])

    def floor(self) -> tuple[Floats, Floats]:
        """The smallest deviation (3,), and the time (3,), s, it is reached at: how stable a bias can be."""
        lowest = self.curve.deviation.argmin(axis=0)
        return self.curve.deviation[lowest, range(3)], self.curve.tau[lowest]


class ImuNoise(NamedTuple):
    """An IMU at rest."""

    duration_s: float
    """Of the stretch that was used."""
    samples: int
    missing: int
    """Samples that were interpolated."""
    gyroscope: SensorNoise
    accelerometer: SensorNoise | None


def imu_noise(imu: Imu, place: object = "recording") -> ImuNoise:
    """Noise of gyroscope and accelerometer from an IMU that rests throughout.

    The longest stretch without a long gap is used. Raises `RecordingError` where that is under 3 s or 100
    samples.
    """
    period_s, filled, missing = _regular(imu)
    count, duration_s = len(filled), len(filled) * period_s
    if duration_s < _LEAST_S or count < _LEAST_SAMPLES:
        raise RecordingError(
            str(place),
            f"{duration_s:.1f} s ({count} samples) of an IMU at rest, without gaps",
            f"{_LEAST_S:.0f} s and {_LEAST_SAMPLES} samples or more",
            "a recording that rests longer",
        )
    gyroscope = sensor_noise(filled[:, :3], period_s, "rad/s")
    accelerometer = None
    if imu.accelerometer is not None:
        accelerometer = sensor_noise(filled[:, 3:], period_s, "m/s^2")
    return ImuNoise(duration_s, count, missing, gyroscope, accelerometer)


def sensor_noise(values: Floats, period_s: float, unit: str) -> SensorNoise:
    """Allan deviation and densities of a sensor's samples (n, 3), evenly spaced, at rest."""
    x, y, z = (fit(values[:, i], period_s) for i in range(3))
    lengths = averaging_lengths(len(values))
    tau = lengths * period_s
    found = np.stack([overlapping_deviation(values[:, i], lengths) for i in range(3)], axis=1)
    points = len(values) + 1
    freedom = np.stack(
        [
            [
                degrees_of_freedom(points, int(m), int(kind))
                for m, kind in zip(lengths, axis.exponent(tau), strict=True)
            ]
            for axis in (x, y, z)
        ],
        axis=1,
    )
    low = found * np.sqrt(freedom / chi_square.ppf(0.975, freedom))
    high = found * np.sqrt(freedom / chi_square.ppf(0.025, freedom))
    return SensorNoise(unit, Curve(tau, found, low, high), (x, y, z))


def averaging_lengths(count: int) -> Floats:
    """Whole numbers of samples to average over, three an octave, up to a tenth of `count`."""
    largest = max(1.0, _LARGEST_SHARE * count)
    octaves = np.arange(0.0, np.log2(largest) + 1e-9, 1.0 / _PER_OCTAVE)
    return np.unique(np.round(2.0**octaves)).astype(float)


def overlapping_deviation(values: Floats, lengths: Floats) -> Floats:
    """Overlapping Allan deviation (T,) of samples (n,) at averaging lengths (T,), in samples."""
    total = np.concatenate([[0.0], np.cumsum(values - np.mean(values))])
    found = np.empty(len(lengths))
    for i, m in enumerate(lengths.astype(int)):
        second = total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m]
        found[i] = np.sqrt(0.5 * np.mean(np.square(second))) / m
    return found


def degrees_of_freedom(points: int, m: int, exponent: int) -> float:
    """Equivalent degrees of freedom of an overlapping Allan variance (Riley, NIST SP 1065, table 5).

    `points` are those of the integral, one more than samples; `m` the averaging length; `exponent` of the
    power of frequency that the noise's spectrum follows: 2, 0, -1 or -2.
    """
    n = float(points)
    if exponent == 2:
        found = (n + 1.0) * (n - 2.0 * m) / (2.0 * (n - m))
    elif exponent == 0:
        found = 3.0 * (n - 1.0) / (2.0 * m) - 2.0 * (n - 2.0) / n
        found *= 4.0 * m**2 / (4.0 * m**2 + 5.0)
    elif exponent == -1:
        if m == 1:
            found = 2.0 * (n - 2.0) ** 2 / (2.3 * n - 4.9)
        else:
            found = 5.0 * n**2 / (4.0 * m * (n + 3.0 * m))
    else:
        found = (n - 2.0) / (m * (n - 3.0) ** 2)
        found *= (n - 1.0) ** 2 - 3.0 * m * (n - 1.0) + 4.0 * m**2
    return max(1.0, found)


def _regular(imu: Imu) -> tuple[float, Floats, int]:
    """Period, evenly spaced samples (n, 3 or 6) of the longest stretch, and how many are interpolated."""
    values = imu.gyroscope
    if imu.accelerometer is not None:
        values = np.concatenate([values, imu.accelerometer], axis=1)
    nominal = max(period_ns(imu.time_ns), 1)
    steps = np.round(np.diff(imu.time_ns) / nominal).astype(int)
    begin, end = _longest(steps)
    steps, values, times = steps[begin : end - 1], values[begin:end], imu.time_ns[begin:end]
    # Stamps jitter; the sensor's own clock does not.
    number = np.concatenate([[0], np.cumsum(np.maximum(steps, 1))])
    if len(number) < 2:
        return nominal / NANOSECONDS, values, 0
    missing = int(number[-1]) + 1 - len(number)
    if missing:
        every = np.arange(number[-1] + 1)
        values = np.stack([np.interp(every, number, column) for column in values.T], axis=1)
    return _period(times, int(number[-1])), values, missing


def _longest(steps: Times) -> tuple[int, int]:
    """First and last index, exclusive, of the longest stretch without a long gap or many short ones."""
    lost = np.maximum(steps - 1, 0)
    bound = _LONGEST_GAP if lost.sum() <= _MISSING_SHARE * (len(steps) + 1) else 0
    cuts = np.concatenate([[-1], np.flatnonzero(lost > bound), [len(steps)]])
    longest = int(np.argmax(np.diff(cuts)))
    return int(cuts[longest]) + 1, int(cuts[longest + 1]) + 1


def _period(times: Times, steps: int) -> float:
    return float(times[-1] - times[0]) / NANOSECONDS / steps
