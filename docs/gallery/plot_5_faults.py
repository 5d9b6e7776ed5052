"""
Faults, and how they look
=========================

One simulated run of 48 s, and the same with one fault at a time. Each picture shows the normalised
innovation squared (NIS) of the tracker by degree of freedom, with the band that holds 95 % of the
samples of a consistent filter, and the autocorrelation of the whitened innovations with its 95 %
bounds. Below it is the verdict of `jaxekf.diagnose`; its second argument, the recording with an encoder,
is left out on purpose, since innovations need no truth.
"""

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import jaxekf
from jaxekf.recordings.types import from_scipy, to_scipy
from jaxekf.simulation import attitude_runs

jaxekf.set_up()
MODEL = jaxekf.get_model("loose")
RUN = attitude_runs.recording("run", attitude_runs.free_motion(3), seed=3, duration_s=48.0)
LEGEND = {"frameon": False, "fontsize": 8, "loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
OPTICAL, IMU = RUN.need_optical(), RUN.need_imu()


def with_noise(**factors):
    """The model's default parameters with some of the noise multiplied."""
    noise = MODEL.parameters.noise
    return MODEL.parameters._replace(
        noise=noise._replace(
            **{name: factor * getattr(noise, name) for name, factor in factors.items()}
        )
    )


def show(run=RUN, params=MODEL.parameters) -> Figure:
    """Estimate, print the diagnosis, and draw NIS and autocorrelation."""
    estimate = jaxekf.estimate(run, params=params)
    diagnosis = jaxekf.diagnose(estimate)
    print("\n".join(diagnosis.sentences()))
    record, found = estimate.sensors["optical"], diagnosis.sensors["optical"]
    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    nis, white = figure.subplots(1, 2)
    low, high = (bound / 3.0 for bound in found.nis.band)
    t = (record.time_ns - record.time_ns[0]) / 1e9
    nis.axhspan(low, high, color="#d9d9d9", label="95 % band")
    nis.plot(t, np.maximum(record.nis / 3.0, 1e-3), ".", ms=2, color="#0b5394", label="a sample")
    nis.axhline(found.nis.mean, color="#a61c00", lw=1.2, label=f"mean {found.nis.mean:.2f}")
    nis.set(xlabel="time (s)", ylabel="NIS / 3", yscale="log", ylim=(1e-2, 1e2))
    nis.legend(**LEGEND, ncols=3)
    lag, bound = found.whiteness.lag_s, found.whiteness.bound
    white.fill_between(lag, -bound, bound, color="#d9d9d9", lw=0, label="95 % bounds")
    for row, axis in zip(found.whiteness.autocorrelation, "xyz", strict=True):
        white.plot(lag, row, lw=0.9, label=f"about {axis}")
    white.set(xlabel="lag (s)", ylabel="autocorrelation", xlim=(0, 1))
    white.legend(**LEGEND, ncols=4)
    return figure


# %%
# Nothing wrong
# -------------
#
# NIS scatters about 1 and innovations are white.

healthy = show()

# %%
# Measurement noise R set too small
# ---------------------------------
#
# The tracker's deviation is set to a third. NIS is far above 1; the innovations are negatively
# correlated at the first lags, because the gain is too high.

small = show(params=with_noise(optical=1 / 3))

# %%
# Measurement noise R set too large
# ---------------------------------

large = show(params=with_noise(optical=3.0))

# %%
# Process noise Q set too small
# -----------------------------
#
# The gyroscope's density and the walk of its bias are set to a tenth. The filter trusts its
# prediction for too long: NIS hardly shows it, but the innovations are positively correlated over
# seconds.

trusting = show(params=with_noise(gyroscope=0.1, bias_walk=0.1))

# %%
# Process noise Q set too large
# -----------------------------
#
# Both are ten times too large. The gain is too high, so that each innovation takes back a part of
# the one before.

doubting = show(params=with_noise(gyroscope=10.0, bias_walk=10.0))

# %%
# The tracker is stamped late
# ---------------------------
#
# 20 ms. The innovations follow the angular rate: the autocorrelation is that of the motion.

late = show(RUN.replace(optical=replace(OPTICAL, time_ns=OPTICAL.time_ns + 20_000_000)))

# %%
# Scale error of the gyroscope
# ----------------------------
#
# All axes read 3 % too much.

scaled = show(RUN.replace(imu=replace(IMU, gyroscope=1.03 * IMU.gyroscope)))

# %%
# The gyroscope is turned in the body
# -----------------------------------
#
# By 2 deg about x, while the recording states that it is not.

TURN = Rotation.from_rotvec(np.deg2rad([2.0, 0.0, 0.0]))
turned = show(RUN.replace(imu=replace(IMU, gyroscope=TURN.apply(IMU.gyroscope))))

# %%
# A gyroscope bias that is held at zero
# -------------------------------------
#
# The initial deviation and the walk of the bias are set to next to nothing.

still = with_noise(bias_walk=1e-3)
still = still._replace(initial=still.initial._replace(bias=1e-3 * still.initial.bias))
biased = show(params=still)

# %%
# Outliers
# --------
#
# One in fifty samples of the tracker is off by some 3 deg. Most innovations are as large as
# predicted, a few are far larger: the mean is moved, the median is not.

RNG = np.random.default_rng(0)
ERROR = np.where(RNG.uniform(size=(len(OPTICAL.time_ns), 1)) < 0.02, np.deg2rad(3.0), 0.0)
ERROR = ERROR * RNG.standard_normal((len(ERROR), 3))
WRONG = from_scipy(to_scipy(OPTICAL.q_ref_body) * Rotation.from_rotvec(ERROR))
outliers = show(RUN.replace(optical=replace(OPTICAL, q_ref_body=WRONG)))

# %%
# The remedy is a gate or a robust weighting: ``jaxekf.robust("loose", "huber")``.
