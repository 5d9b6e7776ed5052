"""The posterior Cramer-Rao bound of a tracked tool with an IMU.

For a given motion and Gaussian noise it is the covariance of the error-state filter linearised at the
*true* motion (Tichavsky, Muravchik, Nehorai 1998). This file uses NumPy and Jacobians derived by hand, and
shares no code with the estimator that is compared with the bound.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf.recordings.types import Floats, to_scipy
from jaxekf.simulation.marker_runs import GRAVITY_REF, Hidden, Tool, ToolGrade, ToolMotion

_POSITION, _TILT, _SPEED = slice(0, 3), slice(3, 6), slice(6, 9)
_GYRO, _ACCEL = slice(9, 12), slice(12, 15)
PRIOR = {"position": 0.01, "attitude": np.deg2rad(5.0), "velocity": 0.3}
"""Standard deviations at the start (m, rad, m/s); those of the biases are the grade's."""


class Bound(NamedTuple):
    """RMS over a window of the lower bounds of the standard deviations."""

    x_mm: float
    yaw_rad: float


def _cross(v: Floats) -> Floats:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _transitions(motion: ToolMotion, t: Any, dt: float) -> tuple[Floats, Floats]:
    """Error transitions (N - 1, 15, 15) from each instant to the next, and attitudes (N, 3, 3)."""
    q, rate = motion.attitude.attitude(t)
    turn = to_scipy(q).as_matrix()
    force = np.einsum("nji,nj->ni", turn, motion.acceleration(t) - GRAVITY_REF)
    whole = np.tile(np.eye(15), (len(t) - 1, 1, 1))
    for k, step in enumerate(whole):
        middle = 0.5 * (turn[k] + turn[k + 1])
        tilt = -middle @ _cross(0.5 * (force[k] + force[k + 1]))
        step[_POSITION, _SPEED] = dt * np.eye(3)
        step[_POSITION, _TILT], step[_SPEED, _TILT] = 0.5 * dt**2 * tilt, dt * tilt
        step[_POSITION, _ACCEL], step[_SPEED, _ACCEL] = -0.5 * dt**2 * middle, -dt * middle
        back = -0.5 * dt * (rate[k] + rate[k + 1])
        step[_TILT, _TILT] = Rotation.from_rotvec(back).as_matrix()
        step[_TILT, _GYRO] = -dt * np.eye(3)
    return whole, turn


def _yaw_slope(turn: Floats) -> Floats:
    """Derivative (3,) of ``atan2(R10, R00)`` with respect to the attitude error in the body frame."""
    moved = [turn @ _cross(axis) for axis in np.eye(3)]
    length = turn[0, 0] ** 2 + turn[1, 0] ** 2
    return np.array([(turn[0, 0] * m[1, 0] - turn[1, 0] * m[0, 0]) / length for m in moved])


def _seen(cov: Floats, turn: Floats, arms: list[Floats], sigma: float) -> Floats:
    """The covariance after the measurement of these markers."""
    for arm in arms:
        slope = np.zeros((3, 15))
        slope[:, _POSITION] = np.eye(3)
        slope[:, _TILT] = -turn @ _cross(arm)
        innovation = slope @ cov @ slope.T + sigma**2 * np.eye(3)
        gain = np.linalg.solve(innovation, slope @ cov).T
        rest = np.eye(15) - gain @ slope
        cov = rest @ cov @ rest.T + sigma**2 * gain @ gain.T
    return cov


def bound(
    motion: ToolMotion,
    grade: ToolGrade,
    hidden: Hidden,
    duration_s: float,
    window: tuple[float, float],
) -> Bound:
    """The bound for causal estimators, which use at time t only the frames that had arrived by then.

    It is evaluated at every IMU sample of the window, without its end.
    """
    dt, tool = grade.imu_s, Tool()
    t = dt * np.arange(round(duration_s / dt) + 1)
    step, turn = _transitions(motion, t, dt)
    per_s = np.zeros(15)
    per_s[_TILT], per_s[_SPEED] = (
        np.deg2rad(grade.gyroscope_deg),
        1e-3 * STANDARD_GRAVITY * grade.accelerometer_mg,
    )
    per_s[_GYRO], per_s[_ACCEL] = np.deg2rad(grade.bias_walk_deg), grade.accelerometer_walk
    noise = np.diag(per_s**2) * dt
    start = [PRIOR["position"], PRIOR["attitude"], PRIOR["velocity"]]
    start += [np.deg2rad(grade.bias_deg), grade.accelerometer_bias]
    cov = np.diag(np.repeat(start, 3) ** 2)
    every, late = round(grade.tracker_s / dt), round(grade.latency_s / dt)
    first, end = (round(edge / dt) for edge in window)
    squares = []
    for frame in range(0, len(t), every):
        if frame:
            for k in range(frame - every, frame):
                cov = step[k] @ cov @ step[k].T + noise
        arms = [
            place
            for name, place in zip(tool.names, tool.p_body_marker, strict=True)
            if not any(h == name and a <= t[frame] < b for h, a, b in hidden)
        ]
        cov = _seen(cov, turn[frame], arms, 1e-3 * grade.marker_mm)
        ahead = cov
        for k in range(frame, min(frame + late + every, end)):
            if k > frame:
                ahead = step[k - 1] @ ahead @ step[k - 1].T + noise
            if k >= max(frame + late, first):
                slope = _yaw_slope(turn[k])
                squares.append([ahead[0, 0], slope @ ahead[_TILT, _TILT] @ slope])
    x, yaw = np.sqrt(np.mean(squares, axis=0))
    return Bound(1e3 * float(x), float(yaw))


def density_factor(motion: ToolMotion, grade: ToolGrade, x_mm: float, **at: object) -> float:
    """The factor of both white noise densities for which the bound of x is `x_mm`, all markers visible."""
    low, high = 0.05, 1.0
    for _ in range(12):
        middle = 0.5 * (low + high)
        found = bound(motion, scaled(grade, middle), (), **at)  # pyright: ignore[reportArgumentType]
        low, high = (middle, high) if found.x_mm < x_mm else (low, middle)
    return 0.5 * (low + high)


def scaled(grade: ToolGrade, factor: float) -> ToolGrade:
    """The grade with both white noise densities of the IMU times a factor."""
    from dataclasses import replace

    return replace(
        grade,
        gyroscope_deg=factor * grade.gyroscope_deg,
        accelerometer_mg=factor * grade.accelerometer_mg,
    )
