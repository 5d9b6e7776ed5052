"""
A first estimate with its uncertainty
=====================================

One of the recordings that come with the package: a tracker at 62.5 Hz that loses its tool three
times, a gyroscope at 125 Hz with a bias, and an encoder as truth. ``loose`` is the default model:
attitude and gyroscope bias, with the gyroscope as the input of the prediction.

The picture in the README of the repository is the one of this example::

    python docs/gallery/plot_1_first_estimate.py docs/images/first_estimate.png
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import jaxekf
from jaxekf.evaluation.metrics import attitude_error
from jaxekf.recordings.truth import encoder_at
from jaxekf.reporting import plots

jaxekf.set_up()
run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
params = jaxekf.get_model("loose").parameters
estimate = jaxekf.estimate(run)
print(jaxekf.score(estimate, run))

# %%
# The errors about the three axes of the body against the encoder. A consistent filter keeps 95 % of
# them inside its two-sigma band. The band widens while the tracker sees nothing (grey), because
# then only the gyroscope is integrated.


def error_figure() -> Figure:
    truth = encoder_at(run.need_encoder(), estimate.time_ns)
    error = np.rad2deg(attitude_error(truth.q_ref_body, estimate.attitude.value))
    sigma = np.rad2deg(estimate.attitude.sigma)
    hidden = ~run.need_optical().valid
    t_optical = (run.need_optical().time_ns - estimate.time_ns[0]) / 1e9
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    for i, axes in enumerate(figure.subplots(3, 1, sharex=True)):
        for start in np.flatnonzero(hidden[1:] & ~hidden[:-1]):
            end = start + 1 + np.argmin(hidden[start + 1 :])
            if end - start > 5:
                axes.axvspan(
                    t_optical[start], t_optical[end], color="#d9d9d9", lw=0, label="tracker hidden"
                )
        plots.band(axes, estimate.time, np.zeros(len(error)), sigma[:, i], "2σ of the estimate")
        axes.plot(
            estimate.time, error[:, i], color=plots.ESTIMATE, lw=0.9, label="estimate − encoder"
        )
        axes.set_ylabel(f"about {'xyz'[i]} (deg)")
        axes.set_ylim(-0.4, 0.4)
        axes.grid(alpha=0.25)
    axes.set_xlabel("time (s)")
    handles, labels = axes.get_legend_handles_labels()
    named = dict(zip(labels, handles, strict=True))
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle("Attitude error of the default model on free-5")
    return figure


errors = error_figure()

# %%
# The gyroscope's bias, estimated along with the attitude, beside the difference of gyroscope and
# encoder.

bias = plots.figure_functions()["bias"](estimate, run)

# %%
# As a script, with a file's name, it writes the first picture there.

if __name__ == "__main__" and len(sys.argv) == 2:
    errors.savefig(sys.argv[1], dpi=110)
