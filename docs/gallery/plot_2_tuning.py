"""
Before and after tuning
=======================

Four simulated runs whose sensors are not those that the model's default noise describes: the
tracker is three times better, the gyroscope twice as noisy. The noise is tuned on three runs by the
likelihood of their innovations, which needs no truth, and judged on the fourth.
"""

import numpy as np
from matplotlib.figure import Figure

import jaxekf
import tuning
from jaxekf.simulation import attitude_runs

jaxekf.set_up()
grade = attitude_runs.SensorGrade(gyroscope_deg=0.1, optical_deg=0.1)
runs = [
    attitude_runs.recording(
        f"run-{seed}", attitude_runs.free_motion(seed), seed=seed, duration_s=24.0, grade=grade
    )
    for seed in range(4)
]
training, unseen = runs[:3], runs[3]
tuned = tuning.tune(training, objective="likelihood", confidence_intervals=True, iterations=20)
for label, (value, low, high) in tuned.intervals.items():
    print(f"{label:18} {value:.3g}, 95 % interval {low:.3g} to {high:.3g}")
for label, recordings in tuned.open.items():
    print(f"{label:18} keeps its initial value: {recordings} would determine it")

# %%
# On the run that was not used, the error falls, and NIS and NEES come to 1: the covariance now
# describes the errors.

before = jaxekf.estimate(unseen)
after = jaxekf.estimate(unseen, params=tuned.params)
for name, made in {"default": before, "tuned": after}.items():
    found = jaxekf.score(made, unseen)
    print(
        f"{name:8} attitude RMSE {found.attitude_rmse_deg:.3f} deg,"
        f" NEES {found.attitude_nees:.2f}, NIS {made.mean_nis('optical'):.2f}"
    )

# %%
# The search, and the innovations' normalised squares (NIS by degree of freedom, mean over one
# second) before and after. The grey band holds 95 % of such means for a consistent filter.


def tuning_figure() -> Figure:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    search, nis = figure.subplots(1, 2)
    search.plot([step.training for step in tuned.history], ".-", color="#0b5394")
    search.set_xlabel("iteration")
    search.set_ylabel("negative log-likelihood per sample")
    rows, width = 3, 62
    half = 2.0 * np.sqrt(2.0 / (rows * width))
    nis.axhspan(1.0 - half, 1.0 + half, color="#d9d9d9", label="95 % band")
    for name, made, colour in (("default", before, "#e69138"), ("tuned", after, "#0b5394")):
        record = made.sensors["optical"]
        means = np.convolve(record.nis / rows, np.full(width, 1.0 / width), mode="valid")[::width]
        nis.plot(np.arange(len(means)) * width / 62.5, means, color=colour, label=name)
    nis.set_xlabel("time (s)")
    nis.set_ylabel("NIS of the tracker / 3")
    nis.set_yscale("log")
    nis.set_yticks([0.1, 0.2, 0.5, 1.0], ["0.1", "0.2", "0.5", "1"])
    nis.minorticks_off()
    nis.legend(frameon=False)
    return figure


figure = tuning_figure()
