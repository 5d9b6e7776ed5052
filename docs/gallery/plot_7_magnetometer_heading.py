"""
Heading from a magnetometer
===========================

No tracker at all: ``marg`` takes gyroscope, accelerometer and magnetometer. Gravity gives the
inclination, the magnetic field the heading. Without a field the heading would drift with the
gyroscope's bias.
"""

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import jaxekf
from jaxekf.evaluation.metrics import orientation_error
from jaxekf.recordings.truth import encoder_at
from jaxekf.recordings.types import from_scipy, to_scipy
from jaxekf.reporting import plots
from jaxekf.simulation import attitude_runs

jaxekf.set_up()
grade = attitude_runs.SensorGrade(accelerometer=0.01, magnetometer=0.02)
run = attitude_runs.recording(
    "marg", attitude_runs.free_motion(4), seed=4, duration_s=30.0, grade=grade
).replace(optical=None)
estimate = jaxekf.estimate(run, "marg")

# %%
# The error has two parts: heading, about the vertical, and inclination, what is left of it. The
# simulated field is undisturbed, which the noise of ``marg`` does not expect: its band is made for
# real rooms, and tuning would narrow it.

truth = encoder_at(run.need_encoder(), estimate.time_ns)
error = orientation_error(estimate.attitude.value, truth.q_ref_body)
print(
    f"total {error.total_deg:.2f} deg, heading {error.heading_deg:.2f} deg,"
    f" inclination {error.inclination_deg:.2f} deg"
)


# %%
# Heading (yaw) of the estimate, of the encoder, and of the gyroscope alone, integrated from the
# true start.


def heading_figure() -> Figure:
    def yaw(q):
        return np.rad2deg(np.unwrap(to_scipy(q).as_euler("ZYX")[:, 0]))

    imu = run.need_imu()
    turns = np.diff(imu.time_ns)[:, None] / 1e9 * (imu.gyroscope[1:] + imu.gyroscope[:-1]) / 2
    alone = integrated(truth.q_ref_body[0], turns)
    sigma = plots.euler_sigma_deg(estimate.attitude.value, estimate.attitude.cov)[:, 2]
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    heading, off = figure.subplots(2, 1, sharex=True)
    t, t_imu = estimate.time, (imu.time_ns - estimate.time_ns[0]) / 1e9
    known = yaw(truth.q_ref_body)
    heading.plot(t, known, color=plots.TRUTH, lw=2.2, label="encoder")
    heading.plot(t_imu, yaw(alone), color=plots.MEASURED, lw=1, label="gyroscope alone")
    heading.plot(t, yaw(estimate.attitude.value), color=plots.ESTIMATE, lw=1, label="marg")
    heading.set_ylabel("heading (deg)")
    plots.band(off, t, np.zeros(len(t)), sigma, "2σ of the estimate")
    off.plot(t, yaw(estimate.attitude.value) - known, color=plots.ESTIMATE, lw=1)
    off.plot(t_imu, yaw(alone) - np.interp(t_imu, t, known), color=plots.MEASURED, lw=1)
    off.set(xlabel="time (s)", ylabel="error (deg)", ylim=(-6, 6))
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    return figure


def integrated(start, turns):
    """Quaternions (N + 1, 4) of a start turned by rotation vectors (N, 3), one after the other."""
    attitudes = [to_scipy(start)]
    for turn in turns:
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(turn))
    return from_scipy(Rotation.concatenate(attitudes))


figure = heading_figure()
