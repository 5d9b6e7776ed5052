"""
An occlusion, filtered and smoothed
===================================

The tracker of the bundled run ``free-5`` sees nothing for two seconds. The filter integrates the
gyroscope and its uncertainty grows until the tracker is back; the smoother also uses what was
measured afterwards.
"""

import numpy as np
from matplotlib.figure import Figure

import jaxekf
from jaxekf.evaluation.metrics import attitude_error
from jaxekf.recordings.truth import encoder_at
from jaxekf.reporting import plots

jaxekf.set_up()
run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
filtered = jaxekf.estimate(run)
smoothed = jaxekf.estimate(run, smooth=True)
for name, made in {"filtered": filtered, "smoothed": smoothed}.items():
    print(f"{name}: attitude RMSE {jaxekf.score(made, run).attitude_rmse_deg:.3f} deg")

# %%
# Holding the last pose, which is what a tracker's driver does, against the estimate:

occlusion = plots.figure_functions()["occlusion"](filtered, run)

# %%
# The smoother's errors stay small within the occlusion, and so does its two-sigma band: both ends
# of the gap are known to it.


def smoother_figure() -> Figure:
    start, end = plots.longest_gap(run, filtered)
    truth = encoder_at(run.need_encoder(), filtered.time_ns)
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.axvspan(start, end, color="#d9d9d9", lw=0, label="tracker hidden")
    for name, made, colour in (
        ("filter", filtered, plots.MEASURED),
        ("smoother", smoothed, plots.ESTIMATE),
    ):
        error = np.rad2deg(attitude_error(truth.q_ref_body, made.attitude.value))[:, 2]
        sigma = np.rad2deg(made.attitude.sigma)[:, 2]
        axes.fill_between(
            made.time, -2 * sigma, 2 * sigma, color=colour, alpha=0.25, lw=0, label=f"{name}, 2σ"
        )
        axes.plot(made.time, error, color=colour, lw=1.2, label=name)
    axes.set_xlim(start - 1.0, end + 1.0)
    axes.set_ylim(-0.3, 0.3)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("error about z (deg)")
    figure.legend(loc="outside lower center", ncols=5, frameon=False)
    return figure


smoothing = smoother_figure()
