"""Allan deviation of the sensors of a static recording, with the fitted noise model."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from jaxekf.calibration.allan import SensorNoise
from jaxekf.calibration.static_noise import StaticNoise
from jaxekf.reporting.plots.style import AXES, ESTIMATE, MEASURED, TRUTH, new_grid, styled

_COLOURS = (ESTIMATE, MEASURED, "#6aa84f")


def allan(noise: StaticNoise) -> Figure:
    """Allan deviation over averaging time on logarithmic axes, one panel for each sensor.

    Each axis has its 95 % confidence band and the fitted noise model, over the averaging times of the fit.
    Dotted and dashed lines are the slopes of white noise and of a random walk.
    """
    sensors = noise.sensors
    with styled():
        figure, grid = new_grid(1, len(sensors), (5.6 * len(sensors) + 0.4, 5.2))
        for axes, (label, sensor) in zip(grid[0], sensors.items(), strict=True):
            turn = 180.0 / np.pi if sensor.unit.startswith("rad") else 1.0
            _draw(axes, sensor, turn)
            unit = "deg/s" if turn != 1.0 else "m/s²"
            axes.set_ylabel(f"Allan deviation of the {label} ({unit})")
            axes.set_xlabel("averaging time τ (s)")
        handles, names = grid[0, 0].get_legend_handles_labels()
        # In two rows under a single panel.
        columns = min(len(names), 3 * len(sensors))
        figure.legend(handles, names, loc="outside lower center", ncols=columns)
        figure.suptitle(f"{noise.run}: Allan deviation of {noise.imu.duration_s:.1f} s at rest")
    return figure


def _draw(axes: Any, sensor: SensorNoise, turn: float) -> None:
    curve = sensor.curve
    for i, (axis, colour) in enumerate(zip(AXES, _COLOURS, strict=True)):
        low, found, high = (turn * v[:, i] for v in (curve.low, curve.deviation, curve.high))
        axes.fill_between(curve.tau, low, high, color=colour, alpha=0.2, lw=0)
        axes.plot(curve.tau, found, "o", color=colour, ms=3, label=f"{axis}, 95 % band")
    for noise, colour in zip(sensor.axes, _COLOURS, strict=True):
        # Averaging times below a period of the highest frequency used are not part of the fit.
        tau = curve.tau[curve.tau >= 0.9 * min(0.5 / noise.band_hz, curve.tau[-1])]
        label = "fit" if colour == _COLOURS[0] else None
        axes.plot(tau, turn * noise.deviation(tau), color=colour, lw=1, label=label)
    axes.set_xscale("log")
    # The bands, not the slopes, determine the limits; at least a decade, so that the scale has labels.
    low, high = turn * float(np.min(curve.low)), turn * float(np.max(curve.high))
    if high > 0.0:
        # A sensor that never changes has nothing for a logarithmic axis.
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        low = max(low, 1e-6 * high)
        middle, reach = np.sqrt(low * high), max(1.3 * np.sqrt(high / low), np.sqrt(10.0))
        axes.set_ylim(middle / reach, middle * reach)
    axes.set_xlim(curve.tau[0] / 1.2, max(curve.tau[-1] * 1.2, 10.0 * curve.tau[0]))
    _slopes(axes, sensor, turn)
    axes.yaxis.set_major_formatter("{x:.2g}")
    axes.yaxis.set_minor_formatter("")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(True, which="minor", alpha=0.1)


def _slopes(axes: Any, sensor: SensorNoise, turn: float) -> None:
    """Allan deviations of white noise alone and of a random walk alone, mean of the axes."""
    tau = np.array(axes.get_xlim())
    white = turn * float(np.mean(sensor.white))
    axes.plot(tau, white / np.sqrt(tau), ":", color=TRUTH, lw=1, label="white noise, ∝ 1/√τ")
    walks = [made.walk.value for made in sensor.axes if made.walk.significant]
    if walks:
        walk = turn * float(np.mean(walks))
        axes.plot(
            tau, walk * np.sqrt(tau / 3.0), "--", color=TRUTH, lw=1, label="random walk, ∝ √τ"
        )
