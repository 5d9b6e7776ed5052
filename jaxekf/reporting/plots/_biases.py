"""Biases of the gyroscope and, if the model has it, of the accelerometer."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate, Estimated
from jaxekf.geometry import manifold
from jaxekf.recordings.truth import encoder_rate_at
from jaxekf.recordings.types import Floats, Recording
from jaxekf.reporting.plots._measurements import pose_measurements, seconds, shade
from jaxekf.reporting.plots._registry import figure
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


class EncoderBias(NamedTuple):
    """The gyroscope's bias by comparison with the encoder, deg/s."""

    t: Floats
    """(M,) seconds since the estimate's first instant."""
    difference: Floats
    """(M, 3) rate of the gyroscope minus rate of the encoder."""
    at_rest: Floats | None
    """(3,) mean difference at rest before the motion; None for a rest of less than a second."""


def _has_bias(estimate: Estimate, recording: Recording) -> bool:
    parts = {part.name for part in manifold.parts(estimate.model.space)}
    return "bias" in parts and recording.imu is not None


@figure(_has_bias)
def bias(estimate: Estimate, recording: Recording) -> Figure:
    """Gyroscope bias with its 2 sigma band and its value by the encoder; on the right the accelerometer
    bias, which an encoder does not measure."""
    poses, known = pose_measurements(estimate, recording), encoder_bias(estimate, recording)
    has_force = "accelerometer_bias" in {p.name for p in manifold.parts(estimate.model.space)}
    with styled():
        size = (11, 6.5) if has_force else (9, 6.5)
        drawn, grid = new_grid(3, 2 if has_force else 1, size, sharex=True)
        gyroscope = estimate.bias
        for i, axis in enumerate(AXES):
            axes = grid[i, 0]
            shade(axes, poses)
            if known is not None:
                _draw_encoder_bias(axes, known, i)
            value, sigma = np.rad2deg(gyroscope.value[:, i]), np.rad2deg(gyroscope.sigma[:, i])
            _draw(axes, estimate.time, value, sigma)
            axes.set_ylabel(f"gyroscope bias {axis} (deg/s)")
            if has_force:
                axes, force = grid[i, 1], estimate.part("accelerometer_bias")
                shade(axes, poses)
                _draw(axes, estimate.time, force.value[:, i], force.sigma[:, i])
                axes.set_ylabel(f"accelerometer bias {axis} (m/s²)")
        title = "gyroscope and accelerometer bias" if has_force else "gyroscope bias"
        finish(drawn, grid, f"{estimate.run}: {title}, body frame", estimate.clock)
    return drawn


def encoder_bias(estimate: Estimated, recording: Recording) -> EncoderBias | None:
    """The gyroscope's bias by comparison with the encoder; None for a recording without encoder."""
    if recording.encoder is None:
        return None
    imu = recording.need_imu()
    taken = estimate.clock.from_imu(imu.time_ns)
    inside = (taken >= estimate.time_ns[0]) & (taken <= estimate.time_ns[-1])
    t = seconds(taken[inside], estimate)
    true_rate = encoder_rate_at(
        recording.encoder, estimate.clock.to_encoder(taken[inside], recording)
    )
    difference = np.rad2deg(imu.gyroscope[inside] - true_rate)
    return EncoderBias(t, difference, _rest_value(t, np.rad2deg(true_rate), difference))


def _draw_encoder_bias(axes: Any, known: EncoderBias, i: int) -> None:
    mean = running_mean(known.t, known.difference[:, i], 2.0)
    axes.plot(*mean, color=MEASURED, lw=1, label="gyroscope − encoder, 2 s mean")
    if known.at_rest is not None:
        axes.axhline(known.at_rest[i], color=TRUTH, lw=1.2, ls="--", label="mean at rest")


def _draw(axes: Any, t: Floats, value: Floats, sigma: Floats) -> None:
    """A bias with its band. The wide band at the start does not determine the limits."""
    axes.plot(t, value, color=ESTIMATE, lw=1.2, label="estimate")
    band(axes, t, value, sigma, "2σ of the estimate")
    settled = t >= min(2.0, 0.1 * t[-1])
    middle, reach = np.median(value[settled]), 5.0 * np.median(sigma[settled])
    reach = max(reach, 2.0 * np.ptp(value[settled]))
    axes.set_ylim(middle - reach, middle + reach)


def running_mean(t: Floats, values: Floats, seconds: float) -> tuple[Floats, Floats]:
    """Moving average over a window of `seconds`, without the half windows at the ends; NaN is left out."""
    known = np.isfinite(values)
    t, values = t[known], values[known]
    width = round(seconds / max(float(np.median(np.diff(t))), 1e-9)) if len(t) > 1 else 0
    if width < 2 or width >= len(t):
        return t[:0], t[:0]
    mean = np.convolve(values, np.full(width, 1.0 / width), mode="valid")
    return t[width // 2 : width // 2 + len(mean)], mean


def _rest_value(t: Floats, true_rate_deg: Floats, difference: Floats) -> Floats | None:
    """Mean difference (3,) while the encoder rests at the start; None for less than a second."""
    known = np.asarray(np.isfinite(difference).all(axis=1))
    moving = np.flatnonzero(known & (np.abs(true_rate_deg) > 0.05).any(axis=1))
    end = moving[0] if moving.size else len(t)
    if end == 0 or t[end - 1] < 1.0:
        return None
    return difference[:end][known[:end]].mean(axis=0)
