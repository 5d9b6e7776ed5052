"""
A planted latency, found and corrected
======================================

The tracker's samples are stamped 20 ms later than they were taken, as happens where the time is
that of the arrival at the computer. Nothing in the recording shows it.
"""

from dataclasses import replace

import jaxekf
from jaxekf.calibration import alignment
from jaxekf.reporting import plots

jaxekf.set_up()
run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
optical = run.need_optical()
late = run.replace(optical=replace(optical, time_ns=optical.time_ns + 20_000_000))
estimate = jaxekf.estimate(late)
diagnosis = jaxekf.diagnose(estimate)
for verdict in diagnosis.verdicts:
    print(verdict)

# %%
# The innovations alone show it: where the tracker is late they follow the angular rate. The size is
# given with its uncertainty, as a number that a program can use:

fault = next(f for f in diagnosis.sensors["optical"].faults if f.kind == "latency")
print(f"{1e3 * fault.size[0]:.1f} ± {1e3 * fault.sigma[0]:.1f} ms")

# %%
# ``jaxekf align`` finds the same before any filter has run, from the angular rates of tracker and
# gyroscope:

aligned = alignment.align_run(late)
print(f"{1e3 * aligned.tracker.latency_s:.1f} ± {1e3 * aligned.tracker.latency_sigma_s:.1f} ms")

# %%
# With the latency stated in the recording the verdict is gone, and the error is that of the
# undisturbed run.

stated = late.replace(optical=replace(late.need_optical(), latency_ns=round(1e9 * fault.size[0])))
corrected = jaxekf.estimate(stated)
print(jaxekf.diagnose(corrected, stated).sentences()[0])
for name, made in {"late": estimate, "corrected": corrected}.items():
    print(f"{name}: attitude RMSE {jaxekf.score(made, run).attitude_rmse_deg:.3f} deg")

# %%
# The errors of the late run: they grow with the rate, and leave the two-sigma band.

attitude = plots.figure_functions()["attitude"](estimate, late)
