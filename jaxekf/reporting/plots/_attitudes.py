"""Attitude: over the whole run, and close up where the tracker was hidden for longest."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate
from jaxekf.evaluation.metrics import attitude_error, hold_last
from jaxekf.recordings.sample_selection import fill_gaps
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import Encoder, Flags, Floats, Recording, to_scipy
from jaxekf.reporting.plots._sight import Sight, Stretch, longest_gap, look, seconds, shade, truth
from jaxekf.reporting.plots.style import (
    AXES,
    ESTIMATE,
    HELD,
    MEASURED,
    TRUTH,
    band,
    finish,
    new_grid,
    styled,
    symmetric_limits,
)

_ANGLES = ("roll", "pitch", "yaw")
_POSE = {
    "tracker": "pose from the tracker",
    "pose of the markers": "pose of the markers",
    "pose of an image": "pose from an image",
}


def euler_deg(q: Floats) -> Floats:
    """Turns about x, y and z (roll, pitch, yaw) in degrees, (N, 3), without jumps."""
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


def attitude(estimate: Estimate, recording: Recording) -> Figure:
    """Roll, pitch and yaw on the left; error against truth with the 2 sigma band on the right."""
    sight, known = look(estimate, recording), truth(estimate, recording)
    t, estimated = estimate.time, euler_deg(estimate.attitude.value)
    sigma = euler_sigma_deg(estimate.attitude.value, estimate.attitude.cov)
    measured = same_turn(sight.pose.q_ref_body[sight.seen], sight.t, t, estimated)
    with styled():
        figure, grid = new_grid(3, 1 if known is None else 2, (11, 6.5), sharex=True)
        for i, name in enumerate(_ANGLES):
            axes = grid[i, 0]
            shade(axes, sight)
            if sight.t.size:
                axes.plot(sight.t, measured[:, i], ".", ms=2.5, color=MEASURED, label=sight.label)
            if known is not None:
                angles = same_turn(known.q_ref_body, t, t, estimated)
                angles[~known.valid] = np.nan
                axes.plot(t, angles[:, i], color=TRUTH, lw=2.2, label="encoder")
            band(axes, t, estimated[:, i], sigma[:, i], "2σ of the estimate")
            axes.plot(t, estimated[:, i], color=ESTIMATE, lw=1, label="estimate")
            axes.set_ylabel(f"{name} (deg)")
        if known is not None:
            _errors(grid[:, 1], estimate, recording, sight, known)
        finish(figure, grid, f"{estimate.run}: attitude of the body in {sight.frame}")
    return figure


def same_turn(q: Floats, t: Floats, t_near: Floats, near: Floats) -> Floats:
    """Euler angles (N, 3) in degrees at `t`, on the same turn as the curve `near` (M, 3) at `t_near`.

    Unwrapping by itself may take another turn wherever samples are missing.
    """
    if len(q) == 0:
        return np.zeros((0, 3))
    angles = np.rad2deg(to_scipy(q).as_euler("ZYX")[:, ::-1])
    there = np.stack([np.interp(t, t_near, near[:, i]) for i in range(3)], axis=1)
    return angles + 360.0 * np.round((there - angles) / 360.0)


def _errors(
    column: Any, estimate: Estimate, recording: Recording, sight: Sight, known: Encoder
) -> None:
    """Rotation vectors from the truth to the estimate and to what was measured, about the body's axes."""
    measured = np.zeros((0, 3))
    if sight.t.size:
        there = encoder_at(recording.need_encoder(), sight.pose.time_ns[sight.seen])
        measured = np.rad2deg(attitude_error(there.q_ref_body, sight.pose.q_ref_body[sight.seen]))
        measured[~there.valid] = np.nan
    error = np.rad2deg(attitude_error(known.q_ref_body, estimate.attitude.value))
    error[~known.valid] = np.nan
    sigma = np.rad2deg(estimate.attitude.sigma)
    for i, axis in enumerate(AXES):
        axes = column[i]
        shade(axes, sight)
        if sight.t.size:
            axes.plot(
                sight.t, measured[:, i], ".", ms=2.5, color=MEASURED, alpha=0.6, label=sight.label
            )
        band(axes, estimate.time, np.zeros(len(error)), sigma[:, i], "2σ of the estimate")
        axes.plot(estimate.time, error[:, i], color=ESTIMATE, lw=1, label="estimate")
        axes.set_ylabel(f"error about {axis} (deg)")
        symmetric_limits(axes, np.r_[error[:, i], measured[:, i]])


def occlusion(estimate: Estimate, recording: Recording) -> Figure:
    """Close-up of the longest time without a pose: holding the last one against the estimate."""
    span, sight = longest_gap(recording, estimate), look(estimate, recording)
    margin = max(0.6 * (span[1] - span[0]), 0.25)
    window = span[0] - margin, span[1] + margin
    dense = fill_gaps(sight.pose.time_ns)
    dense = dense[_within(seconds(dense, estimate), (max(window[0], 0.0), window[1]))]
    t_held, held = seconds(dense, estimate), hold_last(sight.pose, dense)
    near = _within(estimate.time, window)
    known = truth(estimate, recording)
    with styled():
        figure, grid = new_grid(3, 1 if known is None else 2, (11, 6.5), sharex=True)
        t, estimated = estimate.time[near], estimate.attitude.value[near]
        angles = euler_deg(estimated)
        sigma = euler_sigma_deg(estimated, estimate.attitude.cov[near])
        held_angles = same_turn(held, t_held, t, angles)
        for i, name in enumerate(_ANGLES):
            axes = grid[i, 0]
            shade(axes, sight)
            _hold(axes, t_held, held_angles[:, i])
            if known is not None:
                true_angles = same_turn(known.q_ref_body[near], t, t, angles)
                true_angles[~known.valid[near]] = np.nan
                axes.plot(t, true_angles[:, i], color=TRUTH, lw=2.2, label="encoder")
            band(axes, t, angles[:, i], sigma[:, i], "2σ of the estimate")
            axes.plot(t, angles[:, i], color=ESTIMATE, lw=1.2, label="estimate")
            axes.set_ylabel(f"{name} (deg)")
            axes.set_xlim(*window)
        if known is not None:
            there = encoder_at(recording.need_encoder(), dense)
            hold_error = np.rad2deg(attitude_error(there.q_ref_body, held))
            hold_error[~there.valid] = np.nan
            for i, axes in enumerate(grid[:, 1]):
                shade(axes, sight)
                _hold(axes, t_held, hold_error[:, i])
                _close_error(axes, estimate, known, near, i)
                _say_worst(axes, hold_error[:, i])
        title = f"{estimate.run}: no {_POSE[sight.label]} for {span[1] - span[0]:.2f} s"
        finish(figure, grid, title)
    return figure


def _within(t: Floats, span: Stretch) -> Flags:
    return (t >= span[0]) & (t <= span[1])


def _hold(axes: Any, t: Floats, values: Floats) -> None:
    axes.step(t, values, where="post", color=HELD, lw=1, label="last pose held")


def _close_error(axes: Any, estimate: Estimate, known: Encoder, near: Flags, i: int) -> None:
    """The error about one axis within the window, with limits that show it whole."""
    t, sigma = estimate.time[near], np.rad2deg(estimate.attitude.sigma[near, i])
    error = np.rad2deg(attitude_error(known.q_ref_body[near], estimate.attitude.value[near]))[:, i]
    error[~known.valid[near]] = np.nan
    band(axes, t, np.zeros(len(t)), sigma, "2σ of the estimate")
    axes.plot(t, error, color=ESTIMATE, lw=1.2, label="estimate")
    axes.set_ylabel(f"error about {AXES[i]} (deg)")
    largest = np.abs(error[np.isfinite(error)]).max(initial=0.0)
    reach = 1.3 * max(2.0 * sigma.max(), largest, 0.3)
    axes.set_ylim(-reach, reach)


def _say_worst(axes: Any, held: Floats) -> None:
    """The largest error of holding the tracker, in words where it is out of the picture."""
    held = held[np.isfinite(held)]
    if not held.size:
        return
    worst = held[np.argmax(np.abs(held))]
    if abs(worst) > axes.get_ylim()[1]:
        white = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 2.0}
        text, at = f"held: {worst:+.1f} deg", axes.transAxes
        axes.text(0.98, 0.88, text, transform=at, ha="right", color=HELD, bbox=white)
