"""
A model of your own
===================

``examples/own_model.py`` adds the scale error of the gyroscope to the state of ``loose``. It is a
file of some hundred lines outside the package; Jacobians, gradients, gates, files and plots follow
from its functions. Here it finds scale errors of 2, −1 and 1 % that were planted into a bundled
run, and then the offset between two clocks, which is a calibration parameter of the model.
"""

from dataclasses import replace

import numpy as np
import own_model
from matplotlib.figure import Figure

import jaxekf
import tuning
from jaxekf.reporting import plots

jaxekf.set_up()
run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
planted = np.array([0.02, -0.01, 0.01])
imu = run.need_imu()
scaled = run.replace(imu=replace(imu, gyroscope=imu.gyroscope * (1.0 + planted)))
plain = jaxekf.estimate(scaled)
estimate = jaxekf.estimate(scaled, own_model.MODEL)
for name, made in {"loose": plain, "own model": estimate}.items():
    print(f"{name}: attitude RMSE {jaxekf.score(made, scaled).attitude_rmse_deg:.3f} deg")

# %%
# A part of the state is found by its name, with its block of the covariance.


def scale_figure() -> Figure:
    scale = estimate.part("scale")
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    for i, axes in enumerate(figure.subplots(3, 1, sharex=True)):
        value, sigma = 100 * scale.value[:, i], 100 * scale.sigma[:, i]
        plots.band(axes, estimate.time, value, sigma, "2σ of the estimate")
        axes.plot(estimate.time, value, color=plots.ESTIMATE, label="estimate")
        axes.axhline(100 * planted[i], color=plots.TRUTH, ls="--", lw=1, label="planted")
        axes.set_ylabel(f"axis {'xyz'[i]} (%)")
        axes.set_ylim(-4, 4)
        axes.grid(alpha=0.25)
    axes.set_xlabel("time (s)")
    figure.suptitle("Scale error of the gyroscope")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return figure


figure = scale_figure()

# %%
# A calibration parameter is constant and not part of the state: it is tuned. With the gyroscope's
# stamps 10 ms later the tuner finds the offset of its clock, and its 95 % interval. The encoder stays on
# the tracker's clock, which its section of `recording.toml` would state.

late = scaled.need_imu()
late = scaled.replace(
    imu=replace(late, time_ns=late.time_ns + 10_000_000),
    info={**scaled.info, "encoder_about": {"clock": "tracker"}},
)
tuned = tuning.tune(
    [late],
    model=own_model.MODEL,
    objective="map",
    free=["calibration.clock_offset"],
    confidence_intervals=True,
    iterations=15,
)
for label, (value, low, high) in tuned.intervals.items():
    print(f"{label}: {1e3 * value:.2f} ms ({1e3 * low:.2f} to {1e3 * high:.2f} ms)")
for name, params in {"start": None, "tuned": tuned.params}.items():
    made = jaxekf.estimate(late, own_model.MODEL, params=params)
    print(f"{name}: attitude RMSE {jaxekf.score(made, late).attitude_rmse_deg:.3f} deg")
