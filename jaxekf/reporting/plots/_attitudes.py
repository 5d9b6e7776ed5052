"""Attitude over the whole run, and a close-up of the longest time without a pose."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate
from jaxekf.evaluation.metrics import attitude_error, hold_last
from jaxekf.recordings.sample_selection import fill_gaps
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import Encoder, Flags, Floats, Recording, to_scipy
from jaxekf.reporting.plots._measurements import (
    PoseMeasurements,
    Stretch,
    longest_gap,
    pose_measurements,
    seconds,
    shade,
    truth,
)
from jaxekf.reporting.plots._registry import figure, has_output
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
    """Unwrapped Euler angles (N, 3), roll, pitch and yaw in degrees, of quaternions (N, 4)."""
    angles = to_scipy(q).as_euler("ZYX")[:, ::-1]
    return np.rad2deg(np.unwrap(angles, axis=0))


def euler_sigma_deg(q: Floats, cov: Floats) -> Floats:
    """Standard deviations (N, 3) of roll, pitch and yaw in degrees.

    Parameters
    ----------
    q
        (N, 4) attitude, body to reference, (w, x, y, z).
    cov
        (N, 3, 3) covariance of the attitude error in the body frame, rad².
    """
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


@figure(has_output("attitude"))
def attitude(estimate: Estimate, recording: Recording) -> Figure:
    """Roll, pitch and yaw on the left; errors with the 2 sigma band on the right."""
    poses, known = pose_measurements(estimate, recording), truth(estimate, recording)
    t, estimated = estimate.time, euler_deg(estimate.attitude.value)
    sigma = euler_sigma_deg(estimate.attitude.value, estimate.attitude.cov)
    measured = same_turn(poses.pose.q_ref_body[poses.seen], poses.t, t, estimated)
    with styled():
        drawn, grid = new_grid(3, 1 if known is None else 2, (11, 6.5), sharex=True)
        for i, name in enumerate(_ANGLES):
            axes = grid[i, 0]
            shade(axes, poses)
            if poses.t.size:
                axes.plot(poses.t, measured[:, i], ".", ms=2.5, color=MEASURED, label=poses.label)
            if known is not None:
                angles = same_turn(known.q_ref_body, t, t, estimated)
                angles[~known.valid] = np.nan
                axes.plot(t, angles[:, i], color=TRUTH, lw=2.2, label="encoder")
            band(axes, t, estimated[:, i], sigma[:, i], "2σ of the estimate")
            axes.plot(t, estimated[:, i], color=ESTIMATE, lw=1, label="estimate")
            axes.set_ylabel(f"{name} (deg)")
        if known is not None:
            _errors(grid[:, 1], estimate, recording, poses, known)
        finish(drawn, grid, f"{estimate.run}: attitude of the body in {poses.frame}")
    return drawn


def same_turn(q: Floats, t: Floats, t_near: Floats, near: Floats) -> Floats:
    """Euler angles (N, 3) in degrees at `t`, unwrapped to the curve `near` (M, 3) at `t_near`.

    Unwrapping the angles by themselves may jump by 360 degrees where samples are missing.
    """
    if len(q) == 0:
        return np.zeros((0, 3))
    angles = np.rad2deg(to_scipy(q).as_euler("ZYX")[:, ::-1])
    there = np.stack([np.interp(t, t_near, near[:, i]) for i in range(3)], axis=1)
    return angles + 360.0 * np.round((there - angles) / 360.0)


def _errors(
    column: Any, estimate: Estimate, recording: Recording, poses: PoseMeasurements, known: Encoder
) -> None:
    """Attitude errors of estimate and measurement, as rotation vectors in the body frame."""
    measured = np.zeros((0, 3))
    if poses.t.size:
        there = encoder_at(recording.need_encoder(), poses.pose.time_ns[poses.seen])
        measured = np.rad2deg(attitude_error(there.q_ref_body, poses.pose.q_ref_body[poses.seen]))
        measured[~there.valid] = np.nan
    error = np.rad2deg(attitude_error(known.q_ref_body, estimate.attitude.value))
    error[~known.valid] = np.nan
    sigma = np.rad2deg(estimate.attitude.sigma)
    for i, axis in enumerate(AXES):
        axes = column[i]
        shade(axes, poses)
        if poses.t.size:
            axes.plot(
                poses.t, measured[:, i], ".", ms=2.5, color=MEASURED, alpha=0.6, label=poses.label
            )
        band(axes, estimate.time, np.zeros(len(error)), sigma[:, i], "2σ of the estimate")
        axes.plot(estimate.time, error[:, i], color=ESTIMATE, lw=1, label="estimate")
        axes.set_ylabel(f"error about {axis} (deg)")
        symmetric_limits(axes, np.r_[error[:, i], measured[:, i]])


@figure(lambda e, r: "attitude" in e.outputs and pose_measurements(e, r).t.size > 0)
def occlusion(estimate: Estimate, recording: Recording) -> Figure:
    """Close-up of the longest time without a pose: the estimate, and the last pose held."""
    span, poses = longest_gap(recording, estimate), pose_measurements(estimate, recording)
    margin = max(0.6 * (span[1] - span[0]), 0.25)
    window = span[0] - margin, span[1] + margin
    dense = fill_gaps(poses.pose.time_ns)
    dense = dense[_within(seconds(dense, estimate), (max(window[0], 0.0), window[1]))]
    t_held, held = seconds(dense, estimate), hold_last(poses.pose, dense)
    near = _within(estimate.time, window)
    known = truth(estimate, recording)
    with styled():
        drawn, grid = new_grid(3, 1 if known is None else 2, (11, 6.5), sharex=True)
        t, estimated = estimate.time[near], estimate.attitude.value[near]
        angles = euler_deg(estimated)
        sigma = euler_sigma_deg(estimated, estimate.attitude.cov[near])
        held_angles = same_turn(held, t_held, t, angles)
        for i, name in enumerate(_ANGLES):
            axes = grid[i, 0]
            shade(axes, poses)
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
                shade(axes, poses)
                _hold(axes, t_held, hold_error[:, i])
                _close_error(axes, estimate, known, near, i)
                _annotate_worst(axes, hold_error[:, i])
        title = f"{estimate.run}: no {_POSE[poses.label]} for {span[1] - span[0]:.2f} s"
        finish(drawn, grid, title)
    return drawn


def _within(t: Floats, span: Stretch) -> Flags:
    return (t >= span[0]) & (t <= span[1])


def _hold(axes: Any, t: Floats, values: Floats) -> None:
    axes.step(t, values, where="post", color=HELD, lw=1, label="last pose held")


def _close_error(axes: Any, estimate: Estimate, known: Encoder, near: Flags, i: int) -> None:
    """The error about one axis within the window, with limits that include all of it."""
    t, sigma = estimate.time[near], np.rad2deg(estimate.attitude.sigma[near, i])
    error = np.rad2deg(attitude_error(known.q_ref_body[near], estimate.attitude.value[near]))[:, i]
    error[~known.valid[near]] = np.nan
    band(axes, t, np.zeros(len(t)), sigma, "2σ of the estimate")
    axes.plot(t, error, color=ESTIMATE, lw=1.2, label="estimate")
    axes.set_ylabel(f"error about {AXES[i]} (deg)")
    largest = np.abs(error[np.isfinite(error)]).max(initial=0.0)
    reach = 1.3 * max(2.0 * sigma.max(), largest, 0.3)
    axes.set_ylim(-reach, reach)


def _annotate_worst(axes: Any, held: Floats) -> None:
    """Print the largest error of the last pose held, if it is outside the axes."""
    held = held[np.isfinite(held)]
    if not held.size:
        return
    worst = held[np.argmax(np.abs(held))]
    if abs(worst) > axes.get_ylim()[1]:
        white = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 2.0}
        text, at = f"last pose held: {worst:+.1f} deg", axes.transAxes
        axes.text(0.98, 0.88, text, transform=at, ha="right", color=HELD, bbox=white)
