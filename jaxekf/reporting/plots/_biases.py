"""Biases of the gyroscope and, where the model has it, of the accelerometer."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate, Estimated
from jaxekf.geometry import manifold
from jaxekf.recordings.truth import encoder_rate_at
from jaxekf.recordings.types import Floats, Recording
from jaxekf.reporting.plots._sight import look, seconds, shade
from jaxekf.reporting.plots.style import (
    AXES,
    ESTIMATE,
    MEASURED,
    TRUTH,
    band,
    finish,
    new_grid,
    styled,
)


class Told(NamedTuple):
    """What the encoder says the gyroscope's bias was, deg/s."""

    t: Floats
    difference: Floats
    """(M, 3) gyroscope less encoder."""
    at_rest: Floats | None
    """(3,)."""


def bias(estimate: Estimate, recording: Recording) -> Figure:
    """Gyroscope bias with its 2 sigma band, and what the encoder says it was; on the right that of the
    accelerometer, of which an encoder tells nothing."""
    sight, known = look(estimate, recording), told(estimate, recording)
    has_force = "accelerometer_bias" in {p.name for p in manifold.parts(estimate.model.space)}
    with styled():
        size = (11, 6.5) if has_force else (9, 6.5)
        figure, grid = new_grid(3, 2 if has_force else 1, size, sharex=True)
        turning = estimate.bias
        for i, axis in enumerate(AXES):
            axes = grid[i, 0]
            shade(axes, sight)
            if known is not None:
                _draw_told(axes, known, i)
            value, sigma = np.rad2deg(turning.value[:, i]), np.rad2deg(turning.sigma[:, i])
            _draw(axes, estimate.time, value, sigma)
            axes.set_ylabel(f"gyroscope about {axis} (deg/s)")
            if has_force:
                axes, force = grid[i, 1], estimate.part("accelerometer_bias")
                shade(axes, sight)
                _draw(axes, estimate.time, force.value[:, i], force.sigma[:, i])
                axes.set_ylabel(f"accelerometer along {axis} (m/s²)")
        named = "biases of the gyroscope and the accelerometer" if has_force else "gyroscope bias"
        finish(figure, grid, f"{estimate.run}: {named}")
    return figure


def told(estimate: Estimated, recording: Recording) -> Told | None:
    """What the encoder says; None without one."""
    if recording.encoder is None:
        return None
    imu = recording.need_imu()
    inside = (imu.time_ns >= estimate.time_ns[0]) & (imu.time_ns <= estimate.time_ns[-1])
    t = seconds(imu.time_ns[inside], estimate)
    true_rate = encoder_rate_at(recording.encoder, imu.time_ns[inside])
    difference = np.rad2deg(imu.gyroscope[inside] - true_rate)
    return Told(t, difference, _rest_value(t, np.rad2deg(true_rate), difference))


def _draw_told(axes: Any, told: Told, i: int) -> None:
    mean = running_mean(told.t, told.difference[:, i], 2.0)
    axes.plot(*mean, color=MEASURED, lw=1, label="gyroscope − encoder, 2 s mean")
    if told.at_rest is not None:
        axes.axhline(told.at_rest[i], color=TRUTH, lw=1.2, ls="--", label="measured at rest")


def _draw(axes: Any, t: Floats, value: Floats, sigma: Floats) -> None:
    """A bias with its band, in a range that the wide band of the start does not rule."""
    axes.plot(t, value, color=ESTIMATE, lw=1.2, label="estimate")
    band(axes, t, value, sigma, "2σ of the estimate")
    settled = t >= min(2.0, 0.1 * t[-1])
    middle, reach = np.median(value[settled]), 5.0 * np.median(sigma[settled])
    reach = max(reach, 2.0 * np.ptp(value[settled]))
    axes.set_ylim(middle - reach, middle + reach)


def running_mean(t: Floats, values: Floats, seconds: float) -> tuple[Floats, Floats]:
    """Mean over a window, without the half windows at the ends and without unknown samples."""
    known = np.isfinite(values)
    t, values = t[known], values[known]
    width = round(seconds / max(float(np.median(np.diff(t))), 1e-9)) if len(t) > 1 else 0
    if width < 2 or width >= len(t):
        return t[:0], t[:0]
    mean = np.convolve(values, np.full(width, 1.0 / width), mode="valid")
    return t[width // 2 : width // 2 + len(mean)], mean


def _rest_value(t: Floats, true_rate_deg: Floats, difference: Floats) -> Floats | None:
    """Mean of the gyroscope while the encoder stands still at the start; None within the first second."""
    known = np.asarray(np.isfinite(difference).all(axis=1))
    moving = np.flatnonzero(known & (np.abs(true_rate_deg) > 0.05).any(axis=1))
    end = moving[0] if moving.size else len(t)
    if end == 0 or t[end - 1] < 1.0:
        return None
    return difference[:end][known[:end]].mean(axis=0)
