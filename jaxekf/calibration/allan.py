"""Overlapping Allan deviation and noise densities of a sensor at rest.

The Allan variance at ``tau`` is half the mean square of ``mean over the next tau - mean over this tau``,
over all starting points. Its confidence intervals are chi-square intervals with the equivalent degrees of
freedom of the noise type that dominates at ``tau`` (Riley, NIST SP 1065, table 5, overlapping estimator).
`imu_noise` analyses a static IMU; `noise_densities.fit` does the fit of one axis.
"""

from typing import NamedTuple

import numpy as np

from jaxekf._support import arrays, chi_square
from jaxekf._support.errors import RecordingError
from jaxekf.calibration.noise_densities import Densities, fit
from jaxekf.recordings.types import NANOSECONDS, Floats, Imu, Times, period_ns

_PER_OCTAVE = 3
"""Averaging times per octave."""
_LARGEST_SHARE = 0.1
"""Longest averaging time as a share of the recording's length."""
_LONGEST_GAP = 20
"""Missing samples in a row that are interpolated; a longer gap ends the stretch."""
_MISSING_SHARE = 0.02
_LEAST_SAMPLES = 100
_LEAST_S = 3.0


class Curve(NamedTuple):
    """Allan deviation of three axes over averaging time, with 95 % intervals, in the samples' unit."""

    tau: Floats
    """(T,) seconds."""
    deviation: Floats
    """(T, 3)."""
    low: Floats
    """(T, 3)."""
    high: Floats
    """(T, 3)."""


class SensorNoise(NamedTuple):
    """Noise of one three-axis sensor at rest."""

    unit: str
    curve: Curve
    axes: tuple[Densities, Densities, Densities]

    @property
    def white(self) -> Floats:
        """(3,) density of the white noise, unit/sqrt(Hz)."""
        return np.array([axis.white.value for axis in self.axes])

    def floor(self) -> tuple[Floats, Floats]:
        """Bias instability: smallest deviation (3,) and the averaging time (3,), s, at which it occurs."""
        lowest = self.curve.deviation.argmin(axis=0)
        return self.curve.deviation[lowest, range(3)], self.curve.tau[lowest]


class ImuNoise(NamedTuple):
    """Noise of an IMU at rest."""

    duration_s: float
    """Length of the stretch that was used, s."""
    samples: int
    missing: int
    """Samples that were interpolated."""
    gyroscope: SensorNoise
    accelerometer: SensorNoise | None


def imu_noise(imu: Imu, place: object = "recording") -> ImuNoise:
    """Noise of gyroscope and accelerometer from an IMU that is static throughout.

    The longest stretch without a long gap is used.

    Parameters
    ----------
    imu
        Static samples.
    place
        Name of the recording for error messages.

    Raises
    ------
    RecordingError
        If that stretch is shorter than 3 s or 100 samples.
    """
    period_s, filled, missing = _regular(imu)
    count, duration_s = len(filled), len(filled) * period_s
    if duration_s < _LEAST_S or count < _LEAST_SAMPLES:
        raise RecordingError(
            str(place),
            f"{duration_s:.1f} s ({count} samples) of an IMU at rest, without gaps",
            f"{_LEAST_S:.0f} s and {_LEAST_SAMPLES} samples or more",
            "a longer static recording",
        )
    gyroscope = sensor_noise(filled[:, :3], period_s, "rad/s")
    accelerometer = None
    if imu.accelerometer is not None:
        accelerometer = sensor_noise(filled[:, 3:], period_s, "m/s^2")
    return ImuNoise(duration_s, count, missing, gyroscope, accelerometer)


def sensor_noise(values: Floats, period_s: float, unit: str) -> SensorNoise:
    """Allan deviation and noise densities of evenly spaced static samples.

    Parameters
    ----------
    values
        (n, 3) samples in `unit`.
    period_s
        Sampling period, s.
    unit
        Unit of the samples.
    """
    values = arrays.floats(values, arrays.argument("values"), (None, 3))
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
    interval = chi_square.deviation_interval(found, freedom)
    return SensorNoise(unit, Curve(tau, found, *interval), (x, y, z))


def averaging_lengths(count: int) -> Floats:
    """Averaging lengths in samples, three per octave, up to a tenth of `count`."""
    largest = max(1.0, _LARGEST_SHARE * count)
    octaves = np.arange(0.0, np.log2(largest) + 1e-9, 1.0 / _PER_OCTAVE)
    return np.unique(np.round(2.0**octaves)).astype(float)


def overlapping_deviation(values: Floats, lengths: Floats) -> Floats:
    """Overlapping Allan deviation (T,) of samples (n,) at averaging lengths (T,), in samples.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.calibration import allan
    >>> white = np.random.default_rng(1).standard_normal(100_000)
    >>> deviation = allan.overlapping_deviation(white, np.array([1, 100]))
    >>> bool(abs(deviation[0] / deviation[1] - 10.0) < 0.5)  # falls with the root of the time
    True
    """
    values = arrays.floats(values, arrays.argument("values"), (None,))
    lengths = arrays.floats(lengths, arrays.argument("lengths"), (None,))
    total = np.concatenate([[0.0], np.cumsum(values - np.mean(values))])
    found = np.empty(len(lengths))
    for i, m in enumerate(lengths.astype(int)):
        second = total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m]
        found[i] = np.sqrt(0.5 * np.mean(np.square(second))) / m
    return found


def degrees_of_freedom(points: int, m: int, exponent: int) -> float:
    """Equivalent degrees of freedom of an overlapping Allan variance (Riley, NIST SP 1065, table 5).

    Parameters
    ----------
    points
        Number of points of the integral, one more than the samples.
    m
        Averaging length in samples.
    exponent
        Exponent of the noise's power spectrum in frequency: 2, 0, -1 or -2.
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
    """Sampling period, even samples (n, 3 or 6) of the longest stretch, and the number interpolated."""
    values = imu.gyroscope
    if imu.accelerometer is not None:
        values = np.concatenate([values, imu.accelerometer], axis=1)
    nominal = max(period_ns(imu.time_ns), 1)
    steps = np.round(np.diff(imu.time_ns) / nominal).astype(int)
    begin, end = _longest(steps)
    steps, values, times = steps[begin : end - 1], values[begin:end], imu.time_ns[begin:end]
    # Time stamps jitter, the sensor's own clock does not.
    number = np.concatenate([[0], np.cumsum(np.maximum(steps, 1))])
    if len(number) < 2:
        return nominal / NANOSECONDS, values, 0
    missing = int(number[-1]) + 1 - len(number)
    if missing:
        every = np.arange(number[-1] + 1)
        values = np.stack([np.interp(every, number, column) for column in values.T], axis=1)
    period = float(times[-1] - times[0]) / NANOSECONDS / int(number[-1])
    return period, values, missing


def _longest(steps: Times) -> tuple[int, int]:
    """First and last index, exclusive, of the longest stretch without a long gap or many short ones."""
    lost = np.maximum(steps - 1, 0)
    bound = _LONGEST_GAP if lost.sum() <= _MISSING_SHARE * (len(steps) + 1) else 0
    cuts = np.concatenate([[-1], np.flatnonzero(lost > bound), [len(steps)]])
    longest = int(np.argmax(np.diff(cuts)))
    return int(cuts[longest]) + 1, int(cuts[longest + 1]) + 1
