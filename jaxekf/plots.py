"""Pictures of an estimate beside what was measured and what is true. The only user of matplotlib."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxekf import manifold
from jaxekf.metrics import attitude_error, hold_last, rms
from jaxekf.recording import (
    NANOSECONDS,
    Encoder,
    Floats,
    Recording,
    Times,
    period_ns,
    to_scipy,
)
from jaxekf.result import Estimate
from jaxekf.timeline import fill_gaps
from jaxekf.truth import encoder_at, encoder_rate_at

ESTIMATE, MEASURED, TRUTH, HELD = "#0b5394", "#e69138", "#222222", "#a61c00"
_AXES = ("x", "y", "z")
STYLE: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "savefig.dpi": 130,
}


def figure_functions() -> dict[str, Callable[[Estimate, Recording], Figure]]:
    """Every figure by its file name."""
    return {
        "attitude": attitude,
        "rate": rate,
        "bias": bias,
        "occlusion": occlusion,
        "path": path,
    }


def possible_figures(estimate: Estimate, recording: Recording) -> tuple[str, ...]:
    """Names of the figures that this model and recording can show."""
    if recording.optical is None or len(estimate.time_ns) < 10:
        return ()
    parts = {part.name for part in manifold.parts(estimate.model.space)}
    needs = {
        "attitude": "attitude" in estimate.outputs,
        "rate": "rate" in estimate.outputs and recording.imu is not None,
        "bias": "bias" in parts and recording.imu is not None,
        "occlusion": "attitude" in estimate.outputs,
        "path": "attitude" in estimate.outputs and "marker_body" in recording.info,
    }
    return tuple(name for name in figure_functions() if needs[name])


def save(figure: Figure, file: Path | str) -> Path:
    """Write a figure as PNG."""
    FigureCanvasAgg(figure)
    figure.savefig(file)
    return Path(file)


def _figure(
    rows: int, columns: int, size: tuple[float, float], **kwargs: Any
) -> tuple[Figure, Any]:
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        return figure, figure.subplots(rows, columns, squeeze=False, **kwargs)


def _seconds(time_ns: Times, estimate: Estimate) -> Floats:
    return (time_ns - estimate.time_ns[0]) / NANOSECONDS


def _truth(estimate: Estimate, recording: Recording) -> Encoder | None:
    if recording.encoder is None:
        return None
    return encoder_at(recording.encoder, estimate.time_ns)


def _shade_gaps(axes: Any, estimate: Estimate, recording: Recording) -> None:
    """Grey where the tracker saw nothing for more than two periods."""
    optical = recording.need_optical()
    seen = optical.time_ns[optical.valid]
    t = _seconds(seen, estimate)
    longest = 2.5 * period_ns(optical.time_ns) / NANOSECONDS
    for i in np.flatnonzero(np.diff(t) > longest):
        axes.axvspan(t[i], t[i + 1], color="0.88", lw=0, zorder=0)


def _euler_deg(q: Floats) -> Floats:
    """Turns about x, y and z (roll, pitch, yaw) in degrees, without jumps."""
    angles = to_scipy(q).as_euler("ZYX")[:, ::-1]
    return np.rad2deg(np.unwrap(angles, axis=0))


def euler_sigma_deg(q: Floats, cov: Floats) -> Floats:
    """Standard deviation (N, 3) of roll, pitch and yaw from the body-frame covariance, degrees."""
    _, pitch, roll = to_scipy(q).as_euler("ZYX").T
    cosine = np.maximum(np.abs(np.cos(pitch)), 1e-3)
    zero, one = np.zeros_like(roll), np.ones_like(roll)
    rows = [
        [one, np.sin(roll) * np.sin(pitch) / cosine, np.cos(roll) * np.sin(pitch) / cosine],
        [zero, np.cos(roll), -np.sin(roll)],
        [zero, np.sin(roll) / cosine, np.cos(roll) / cosine],
    ]
    slope = np.moveaxis(np.array(rows), 2, 0)
    return np.rad2deg(np.sqrt(np.einsum("nij,njk,nik->ni", slope, cov, slope)))


def band(axes: Any, t: Floats, centre: Floats, sigma: Floats, label: str | None) -> None:
    """Two standard deviations about a curve."""
    axes.fill_between(
        t, centre - 2 * sigma, centre + 2 * sigma, color=ESTIMATE, alpha=0.22, lw=0, label=label
    )


def _limits(axes: Any, values: Floats) -> None:
    """A symmetric range that shows what matters and is not ruled by single outliers."""
    values = values[np.isfinite(values)]
    if values.size:
        bound = 1.3 * np.quantile(np.abs(values), 0.995) + 1e-12
        axes.set_ylim(-bound, bound)


def attitude(estimate: Estimate, recording: Recording) -> Figure:
    """Roll, pitch and yaw on the left; error against truth with the 2 sigma band on the right."""
    truth = _truth(estimate, recording)
    optical = recording.need_optical()
    seen = optical.valid & (optical.time_ns >= estimate.time_ns[0])
    t, t_seen = estimate.time, _seconds(optical.time_ns[seen], estimate)
    with mpl.rc_context(STYLE):
        figure, grid = _figure(3, 2 if truth else 1, (11, 6.5), sharex=True)
        estimated, measured = (
            _euler_deg(estimate.attitude.value),
            _euler_deg(optical.q_ref_body[seen]),
        )
        sigma = euler_sigma_deg(estimate.attitude.value, estimate.attitude.cov)
        known = (
            None
            if truth is None
            else np.where(truth.valid[:, None], _euler_deg(truth.q_ref_body), np.nan)
        )
        for i, name in enumerate(("roll", "pitch", "yaw")):
            axes = grid[i, 0]
            _shade_gaps(axes, estimate, recording)
            axes.plot(t_seen, measured[:, i], ".", ms=2, color=MEASURED, label="tracker")
            if known is not None:
                axes.plot(t, known[:, i], color=TRUTH, lw=2.2, label="encoder")
            axes.plot(t, estimated[:, i], color=ESTIMATE, lw=1, label="estimate")
            if truth is None:
                band(axes, t, estimated[:, i], sigma[:, i], "2σ of the estimate")
            axes.set_ylabel(f"{name} (deg)")
        if truth is not None:
            _attitude_errors(grid[:, 1], estimate, recording, truth)
        _finish(figure, grid, f"{estimate.run}: attitude of the tool in the tracker's frame")
    return figure


def _attitude_errors(column: Any, estimate: Estimate, recording: Recording, truth: Encoder) -> None:
    optical = recording.need_optical()
    seen = optical.valid & (optical.time_ns >= estimate.time_ns[0])
    at_tracker = encoder_at(recording.need_encoder(), optical.time_ns[seen])
    measured = np.rad2deg(attitude_error(at_tracker.q_ref_body, optical.q_ref_body[seen]))
    error = np.rad2deg(attitude_error(truth.q_ref_body, estimate.attitude.value))
    error[~truth.valid] = np.nan
    sigma = np.rad2deg(estimate.attitude.sigma)
    for i, axis in enumerate(_AXES):
        axes = column[i]
        _shade_gaps(axes, estimate, recording)
        t_seen = _seconds(optical.time_ns[seen], estimate)
        axes.plot(t_seen, measured[:, i], ".", ms=2, color=MEASURED, alpha=0.6, label="tracker")
        band(axes, estimate.time, np.zeros(len(error)), sigma[:, i], "2σ of the estimate")
        axes.plot(estimate.time, error[:, i], color=ESTIMATE, lw=1, label="estimate")
        axes.set_ylabel(f"error about {axis} (deg)")
        _limits(axes, np.r_[error[:, i], measured[:, i]])


def rate(estimate: Estimate, recording: Recording) -> Figure:
    """Angular rate on the left; error against truth with the 2 sigma band on the right."""
    imu = recording.need_imu()
    inside = (imu.time_ns >= estimate.time_ns[0]) & (imu.time_ns <= estimate.time_ns[-1])
    t, t_imu = estimate.time, _seconds(imu.time_ns[inside], estimate)
    value, sigma = np.rad2deg(estimate.rate.value), np.rad2deg(estimate.rate.sigma)
    measured = np.rad2deg(imu.gyroscope[inside])
    known = None
    if recording.encoder is not None:
        known = np.rad2deg(encoder_rate_at(recording.encoder, estimate.time_ns))
    with mpl.rc_context(STYLE):
        figure, grid = _figure(3, 1 if known is None else 2, (11, 6.5), sharex=True)
        for i, axis in enumerate(_AXES):
            axes = grid[i, 0]
            _shade_gaps(axes, estimate, recording)
            axes.plot(t_imu, measured[:, i], color=MEASURED, lw=0.6, label="gyroscope")
            axes.plot(t, value[:, i], color=ESTIMATE, lw=0.8, label="estimate")
            band(axes, t, value[:, i], sigma[:, i], "2σ of the estimate" if known is None else None)
            if known is not None:
                axes.plot(t, known[:, i], color=TRUTH, lw=1.2, label="encoder")
            axes.set_ylabel(f"rate about {axis} (deg/s)")
            if known is None:
                continue
            axes = grid[i, 1]
            _shade_gaps(axes, estimate, recording)
            raw = (
                measured[:, i]
                - np.rad2deg(encoder_rate_at(recording.need_encoder(), imu.time_ns[inside]))[:, i]
            )
            error = value[:, i] - known[:, i]
            axes.plot(t_imu, raw, color=MEASURED, lw=0.6, label="gyroscope")
            axes.plot(t, error, color=ESTIMATE, lw=0.6, label="estimate")
            band(axes, t, np.zeros(len(error)), sigma[:, i], "2σ of the estimate")
            axes.set_ylabel(f"error about {axis} (deg/s)")
            _limits(axes, np.r_[error, raw])
        _finish(figure, grid, f"{estimate.run}: angular rate of the tool, body frame")
    return figure


def bias(estimate: Estimate, recording: Recording) -> Figure:
    """Gyroscope bias with its 2 sigma band, and what the encoder says it was."""
    part = estimate.bias
    value, sigma, t = np.rad2deg(part.value), np.rad2deg(part.sigma), estimate.time
    imu = recording.need_imu()
    inside = (imu.time_ns >= estimate.time_ns[0]) & (imu.time_ns <= estimate.time_ns[-1])
    t_imu, difference, at_rest = _seconds(imu.time_ns[inside], estimate), None, None
    if recording.encoder is not None:
        true_rate = encoder_rate_at(recording.encoder, imu.time_ns[inside])
        difference = np.rad2deg(imu.gyroscope[inside] - true_rate)
        at_rest = _rest_value(t_imu, np.rad2deg(true_rate), difference)
    with mpl.rc_context(STYLE):
        figure, grid = _figure(3, 1, (9, 6.5), sharex=True)
        for i, axis in enumerate(_AXES):
            axes = grid[i, 0]
            _shade_gaps(axes, estimate, recording)
            if difference is not None:
                axes.plot(
                    *_running_mean(t_imu, difference[:, i], 2.0),
                    color=MEASURED,
                    lw=1,
                    label="gyroscope − encoder, 2 s mean",
                )
            if at_rest is not None:
                axes.axhline(at_rest[i], color=TRUTH, lw=1.2, ls="--", label="measured at rest")
            axes.plot(t, value[:, i], color=ESTIMATE, lw=1.2, label="estimate")
            band(axes, t, value[:, i], sigma[:, i], "2σ of the estimate")
            settled = t >= min(2.0, 0.1 * t[-1])
            middle, reach = np.median(value[settled, i]), 5.0 * np.median(sigma[settled, i])
            reach = max(reach, 2.0 * np.ptp(value[settled, i]))
            axes.set_ylim(middle - reach, middle + reach)
            axes.set_ylabel(f"bias about {axis} (deg/s)")
        _finish(figure, grid, f"{estimate.run}: gyroscope bias")
    return figure


def _running_mean(t: Floats, values: Floats, seconds: float) -> tuple[Floats, Floats]:
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


def longest_gap(recording: Recording, estimate: Estimate) -> tuple[float, float]:
    """Start and end, in seconds since the start of the estimate, of the longest occlusion."""
    optical = recording.need_optical()
    seen = optical.time_ns[optical.valid & (optical.time_ns >= estimate.time_ns[0])]
    t = _seconds(seen, estimate)
    if len(t) < 2:
        return 0.0, float(estimate.time[-1])
    at = int(np.argmax(np.diff(t)))
    return float(t[at]), float(t[at + 1])


def occlusion(estimate: Estimate, recording: Recording) -> Figure:
    """Close-up of the longest occlusion: holding the tracker against the estimate."""
    begin, end = longest_gap(recording, estimate)
    margin = max(0.6 * (end - begin), 0.25)
    optical = recording.need_optical()
    dense = fill_gaps(optical.time_ns)
    dense = dense[dense >= estimate.time_ns[0]]
    t_hold = _seconds(dense, estimate)
    near_hold = (t_hold >= begin - margin) & (t_hold <= end + margin)
    near = (estimate.time >= begin - margin) & (estimate.time <= end + margin)
    with mpl.rc_context(STYLE):
        known = recording.encoder is not None
        figure, grid = _figure(3, 2 if known else 1, (11, 6.5), sharex=True)
        held = hold_last(optical, dense)[near_hold]
        estimated = estimate.attitude.value[near]
        t, sigma = estimate.time[near], np.rad2deg(estimate.attitude.sigma[near])
        angles = [_euler_deg(held), _euler_deg(estimated)]
        euler_sigma = euler_sigma_deg(estimated, estimate.attitude.cov[near])
        truth = encoder_at(recording.encoder, estimate.time_ns[near]) if recording.encoder else None
        for i, name in enumerate(("roll", "pitch", "yaw")):
            axes = grid[i, 0]
            _shade_gaps(axes, estimate, recording)
            axes.step(
                t_hold[near_hold],
                angles[0][:, i],
                where="post",
                color=HELD,
                lw=1,
                label="tracker held",
            )
            if truth is not None:
                axes.plot(
                    t, _euler_deg(truth.q_ref_body)[:, i], color=TRUTH, lw=2.2, label="encoder"
                )
            axes.plot(t, angles[1][:, i], color=ESTIMATE, lw=1.2, label="estimate")
            if truth is None:
                band(axes, t, angles[1][:, i], euler_sigma[:, i], "2σ of the estimate")
            axes.set_ylabel(f"{name} (deg)")
            axes.set_xlim(begin - margin, end + margin)
        if truth is not None:
            hold_truth = encoder_at(recording.need_encoder(), dense[near_hold])
            hold_error = np.rad2deg(attitude_error(hold_truth.q_ref_body, held))
            error = np.rad2deg(attitude_error(truth.q_ref_body, estimated))
            for i, axis in enumerate(_AXES):
                axes = grid[i, 1]
                _shade_gaps(axes, estimate, recording)
                axes.step(
                    t_hold[near_hold],
                    hold_error[:, i],
                    where="post",
                    color=HELD,
                    lw=1,
                    label="tracker held",
                )
                band(axes, t, np.zeros(len(t)), sigma[:, i], "2σ of the estimate")
                axes.plot(t, error[:, i], color=ESTIMATE, lw=1.2, label="estimate")
                axes.set_ylabel(f"error about {axis} (deg)")
                reach = 1.3 * max(2.0 * sigma[:, i].max(), np.abs(error[:, i]).max(), 0.3)
                axes.set_ylim(-reach, reach)
                worst = hold_error[np.argmax(np.abs(hold_error[:, i])), i]
                if abs(worst) > reach:
                    text = f"held: {worst:+.1f} deg"
                    white = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 2.0}
                    axes.text(
                        0.98,
                        0.88,
                        text,
                        transform=axes.transAxes,
                        ha="right",
                        color=HELD,
                        bbox=white,
                    )
        _finish(figure, grid, f"{estimate.run}: the tracker hidden for {end - begin:.2f} s")
    return figure


def path(estimate: Estimate, recording: Recording) -> Figure:
    """3-D path of a marker on the tool, which turns about the origin of the tracker's frame."""
    marker = np.asarray(recording.info["marker_body"], float)
    optical = recording.need_optical()
    seen = optical.valid & (optical.time_ns >= estimate.time_ns[0])
    measured = 1e3 * (
        optical.position[seen]
        if optical.position is not None
        else to_scipy(optical.q_ref_body[seen]).apply(marker)
    )
    estimated = 1e3 * to_scipy(estimate.attitude.value).apply(marker)
    truth = _truth(estimate, recording)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7, 6), layout="constrained")
        axes: Any = figure.add_subplot(projection="3d")
        if truth is not None:
            true_path = 1e3 * to_scipy(truth.q_ref_body).apply(marker)
            axes.plot(*true_path.T, color=TRUTH, lw=2.2, label="encoder")
            error = rms((estimated - true_path)[truth.valid])
            title = f"{estimate.run}: path of a marker, error {error:.2f} mm RMS"
        else:
            title = f"{estimate.run}: path of a marker"
        axes.plot(*measured.T, ".", ms=2.5, color=MEASURED, label="tracker")
        axes.plot(*estimated.T, color=ESTIMATE, lw=1.2, label="estimate")
        for name in _AXES:
            getattr(axes, f"set_{name}label")(f"{name} (mm)")
        _equal_scale(axes, estimated)
        axes.legend(loc="upper left")
        figure.suptitle(title)
    return figure


def _equal_scale(axes: Any, points: Floats) -> None:
    """The same scale on the three axes, with a little depth where the path is flat."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = 0.55 * float(np.ptp(points, axis=0).max()) + 1e-9
    for name, centre in zip(_AXES, middle, strict=True):
        getattr(axes, f"set_{name}lim")(centre - reach, centre + reach)
    axes.set_box_aspect((1, 1, 1))


def _finish(figure: Figure, grid: Any, title: str) -> None:
    """Time label below, one legend a column above it, and the title."""
    for column in range(grid.shape[1]):
        grid[-1, column].set_xlabel("time since the start of the run (s)")
        handles, labels = grid[0, column].get_legend_handles_labels()
        grid[0, column].legend(
            handles, labels, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=len(labels)
        )
    figure.suptitle(title)
