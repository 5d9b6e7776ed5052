"""Attitude over the whole run, and a close-up of the longest time without a pose."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate, Estimated
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
from jaxekf.reporting.plots._vectors import Measured, Vector, draw
from jaxekf.reporting.plots.style import (
    AXES,
    ESTIMATE,
    HELD,
    TRUTH,
    band,
    finish,
    new_grid,
    styled,
)

ANGLES = ("roll", "pitch", "yaw")
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
    poses = pose_measurements(estimate, recording)
    vector = attitude_vector(estimate, recording, poses if poses.t.size else None)
    names = "{} (deg)", "error about {} (deg)"
    title = f"{estimate.run}: attitude of the body in {poses.frame}"
    style = {"width": 1.0, "alpha": 0.6}
    return draw(estimate, poses, vector, names, title, limits=False, error_style=style)


def attitude_vector(
    estimate: Estimated, recording: Recording | None, poses: PoseMeasurements | None
) -> Vector:
    """Roll, pitch and yaw in degrees; errors as rotation vectors in the body frame."""
    output, t = estimate.outputs["attitude"], estimate.time
    angles, known = euler_deg(output.value), truth(recording, estimate, estimate.time_ns)
    true = error = measured = None
    if known is not None:
        true = same_turn(known.q_ref_body, t, t, angles)
        true[~known.valid] = np.nan
        error = _error_deg(known, output.value)
    if poses is not None:
        raw = poses.pose.q_ref_body[poses.seen]
        there = truth(recording, estimate, poses.pose.time_ns[poses.seen])
        off = None if there is None else _error_deg(there, raw)
        measured = Measured(poses.t, same_turn(raw, poses.t, t, angles), off, poses.label)
    sigma, error_sigma = euler_sigma_deg(output.value, output.cov), np.rad2deg(output.sigma)
    return Vector(ANGLES, "deg", angles, sigma, true, error, error_sigma, measured)


def _error_deg(known: Encoder, q: Floats) -> Floats:
    """Attitude errors (N, 3) in degrees, rotation vectors in the body frame; NaN where unknown."""
    error = np.rad2deg(attitude_error(known.q_ref_body, q))
    error[~known.valid] = np.nan
    return error


def same_turn(q: Floats, t: Floats, t_near: Floats, near: Floats) -> Floats:
    """Euler angles (N, 3) in degrees at `t`, unwrapped to the curve `near` (M, 3) at `t_near`.

    Unwrapping the angles by themselves may jump by 360 degrees where samples are missing.
    """
    if len(q) == 0:
        return np.zeros((0, 3))
    angles = np.rad2deg(to_scipy(q).as_euler("ZYX")[:, ::-1])
    there = np.stack([np.interp(t, t_near, near[:, i]) for i in range(3)], axis=1)
    return angles + 360.0 * np.round((there - angles) / 360.0)


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
    known = truth(recording, estimate, estimate.time_ns)
    with styled():
        drawn, grid = new_grid(3, 1 if known is None else 2, (11, 6.5), sharex=True)
        t, estimated = estimate.time[near], estimate.attitude.value[near]
        angles = euler_deg(estimated)
        sigma = euler_sigma_deg(estimated, estimate.attitude.cov[near])
        held_angles = same_turn(held, t_held, t, angles)
        for i, name in enumerate(ANGLES):
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
            hold_error = _error_deg(
                encoder_at(recording.need_encoder(), estimate.clock.to_encoder(dense, recording)),
                held,
            )
            error = _error_deg(known, estimate.attitude.value)[near]
            sigma = np.rad2deg(estimate.attitude.sigma[near])
            for i, axes in enumerate(grid[:, 1]):
                shade(axes, poses)
                _hold(axes, t_held, hold_error[:, i])
                _close_error(axes, t, error[:, i], sigma[:, i])
                axes.set_ylabel(f"error about {AXES[i]} (deg)")
                _annotate_worst(axes, hold_error[:, i])
        title = f"{estimate.run}: no {_POSE[poses.label]} for {span[1] - span[0]:.2f} s"
        finish(drawn, grid, title, estimate.clock)
    return drawn


def _within(t: Floats, span: Stretch) -> Flags:
    return (t >= span[0]) & (t <= span[1])


def _hold(axes: Any, t: Floats, values: Floats) -> None:
    axes.step(t, values, where="post", color=HELD, lw=1, label="last pose held")


def _close_error(axes: Any, t: Floats, error: Floats, sigma: Floats) -> None:
    """The error about one axis within the window, with limits that include all of it."""
    band(axes, t, np.zeros(len(t)), sigma, "2σ of the estimate")
    axes.plot(t, error, color=ESTIMATE, lw=1.2, label="estimate")
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
