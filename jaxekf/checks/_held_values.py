"""Values of a sensor that are held between its samples, or rounded more coarsely than its noise."""

import numpy as np

from jaxekf.checks._findings import Findings
from jaxekf.checks.sensor_agreement import Evidence
from jaxekf.recordings.types import NANOSECONDS, Floats, Recording, Times

_FEWEST = 100
_HELD = 0.25
"""Share of samples that repeat the one before, from which on a sensor is written faster than it is read."""
_COARSE = 1.0
"""Step of a rounded sensor in its noise's standard deviations from which on rounding dominates: rounding
adds ``step / sqrt(12)`` of noise, and repeats values."""


def held_findings(recording: Recording, found: Evidence) -> Findings:
    """Notes on sensors of the IMU whose values are held, with the real rate, or coarsely rounded."""
    imu, notes = recording.imu, []
    if imu is None:
        return Findings()
    for name in ("gyroscope", "accelerometer", "magnetometer"):
        values = getattr(imu, name)
        if values is None:
            continue
        rows = np.flatnonzero(np.isfinite(values).all(axis=1))
        values, time_ns = values[rows], imu.time_ns[rows]
        if len(values) < _FEWEST:
            continue
        new = np.r_[True, (np.diff(values, axis=0) != 0.0).any(axis=1)]
        step = coarse_step(values[new])
        if step is None and (rate := held_rate(time_ns, new)) is not None:
            written = (len(time_ns) - 1) / float(time_ns[-1] - time_ns[0]) * NANOSECONDS
            hint = (
                "leave its cells blank where it was not read, or each value counts several times"
                if name == "magnetometer"
                else "export it without held values"
            )
            notes.append(
                f"the {name} is written at {written:.4g} Hz and read at {rate:.4g} Hz:"
                f" {100.0 * (1.0 - new.mean()):.0f} % of its samples repeat the one before, and are up to"
                f" {1e3 / rate:.2g} ms late; {hint}"
            )
        elif step is not None:
            factor, unit = {
                "gyroscope": (180.0 / np.pi, " deg/s"),
                "accelerometer": (1.0, " m/s^2"),
            }.get(name, (1.0, ""))
            notes.append(
                f"the {name} is rounded to steps of {factor * step:.3g}{unit}, more than its noise: take"
                f" {factor * step / np.sqrt(12.0):.2g}{unit} for the noise of a sample at least"
            )
    return Findings((), tuple(notes))


def held_rate(time_ns: Times, new: Floats) -> float | None:
    """Rate, Hz, of the samples that are new where the others hold the last one; None where few are held.

    One stretch without any change, at rest or of a frozen sensor, is none of a slower rate: the new samples
    come at a regular pace.
    """
    at = np.flatnonzero(new)
    lengths = np.diff(at)
    if len(lengths) < _FEWEST // 4:
        return None
    usual = lengths <= 2 * np.median(lengths) + 1
    if usual.mean() < 0.95 or 1.0 - usual.sum() / lengths[usual].sum() < _HELD:
        return None
    return usual.sum() / (float(np.diff(time_ns[at])[usual].sum()) / NANOSECONDS)


def coarse_step(values: Floats) -> float | None:
    """The step to which samples (N, 3) are rounded, where it is larger than their noise; else None."""
    steps = []
    for column in values.T:
        levels = np.unique(column)
        apart = np.diff(levels)
        if not len(apart) or len(levels) > 0.5 * len(column):
            return None
        # Text and floating point leave a rest, so that steps are compared and not divided.
        step = float(apart[apart > 1e-9 * max(np.abs(levels).max(), 1e-30)].min(initial=np.inf))
        multiple = apart / step
        if not np.isfinite(step) or np.abs(multiple - np.round(multiple)).max() > 0.05:
            return None
        steps.append((step, column))
    step = float(np.median([one for one, _ in steps]))
    third = [np.diff(column, n=3) / np.sqrt(20.0) for _, column in steps]
    noise = float(np.median([one.std() for one in third])) if len(values) > 10 else np.inf
    # Rounding itself has the noise step / sqrt(12).
    own = np.sqrt(max(noise**2 - step**2 / 12.0, 0.0))
    return step if step > _COARSE * own else None
