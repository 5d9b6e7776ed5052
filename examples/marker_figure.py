"""Figure 2 of Tobergte, Pomarlan, Hirzinger (2009): x and yaw while markers are hidden."""

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import jaxekf
from jaxekf.estimation import causal
from jaxekf.pose_solvers import marker_pose
from jaxekf.recordings.types import Flags, Floats
from jaxekf.reporting import plots
from jaxekf.simulation import marker_runs
from jaxekf.simulation.marker_runs import Hidden, ToolGrade, ToolMotion, raw_yaw

COUNTS = (0, 2, 3)
MARGIN_S = 0.6


def draw(
    motion: ToolMotion,
    grade: ToolGrade,
    params: jaxekf.Parameters,
    hidden: Callable[[int], Hidden],
    window: tuple[float, float],
    file: Path,
    seed: int = 0,
) -> None:
    """Draw causal estimates of one seed, for each number of hidden markers."""
    with mpl.rc_context(plots.STYLE):
        figure = Figure(figsize=(12, 9), layout="constrained")
        grid = figure.subplots(len(COUNTS), 4, sharex=True, width_ratios=[3, 2, 3, 2])
        for row, count in zip(grid, COUNTS, strict=True):
            _draw_row(row, motion, grade, params, hidden(count), window, seed)
            row[0].set_ylabel(f"{count} hidden\nx (mm)")
        for axes, title in zip(grid[0], ("x", "error of x", "yaw", "error of yaw"), strict=True):
            axes.set_title(title)
        for axes in grid[-1]:
            axes.set_xlabel("time (s)")
        handles, labels = grid[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=4, loc="outside upper center")
        plots.save(figure, file)


def _draw_row(
    row: list,
    motion: ToolMotion,
    grade: ToolGrade,
    params: jaxekf.Parameters,
    hidden: Hidden,
    window: tuple[float, float],
    seed: int,
) -> None:
    run = marker_runs.tool_recording(
        "figure", motion, seed=seed, duration_s=window[1], grade=grade, hidden=hidden
    )
    made = causal.estimate_online(run, "tight", params)
    raw = marker_pose.from_markers(run.need_markers())
    assert raw.position is not None
    known = run.need_encoder()
    assert known.position is not None
    t = made.time_ns / 1e9
    near = (t >= window[0] - MARGIN_S) & (t <= window[1])
    arrived = raw.time_ns / 1e9
    shown = (arrived >= window[0] - MARGIN_S) & (arrived <= window[1])
    hold = np.where(raw.valid[shown], 1.0, np.nan)
    at = np.searchsorted(known.time_ns, made.time_ns[near])
    curves = (
        (
            1e3 * known.position[at, 0],
            1e3 * made.outputs["position"].value[near, 0],
            1e3 * made.outputs["position"].sigma[near, 0],
            1e3 * raw.position[shown, 0] * hold,
            "x (mm)",
        ),
        (
            np.rad2deg(raw_yaw(known.q_ref_body[at])),
            np.rad2deg(raw_yaw(made.attitude.value[near])),
            _yaw_sigma_deg(made, near),
            np.rad2deg(raw_yaw(raw.q_ref_body[shown])) * hold,
            "yaw (deg)",
        ),
    )
    for i, (truth, centre, sigma, measured, label) in enumerate(curves):
        wide, narrow = row[2 * i], row[2 * i + 1]
        wide.step(
            arrived[shown],
            measured,
            where="post",
            color=plots.MEASURED,
            lw=1.0,
            label="tracker, at arrival",
        )
        wide.plot(t[near], truth, color=plots.TRUTH, lw=2.2, label="truth")
        plots.band(wide, t[near], centre, sigma, "2σ")
        wide.plot(t[near], centre, color=plots.ESTIMATE, lw=1.0, ls="--", label="causal estimate")
        wide.set_ylabel(label)
        plots.band(narrow, t[near], 0.0 * centre, sigma, None)
        narrow.plot(t[near], centre - truth, color=plots.ESTIMATE, lw=0.8)
        narrow.set_ylabel(f"error of {label}")
        for axes in (wide, narrow):
            axes.axvline(window[0], color="0.6", lw=0.8)


def _yaw_sigma_deg(made: jaxekf.Estimate, near: Flags) -> Floats:
    return plots.euler_sigma_deg(made.attitude.value[near], made.attitude.cov[near])[:, 2]
