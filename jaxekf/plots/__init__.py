"""Pictures of an estimate beside what was measured and what is true.

Every figure is a function of an estimate and its recording; `possible_figures` tells which of them a model
and a recording can show.
"""

from collections.abc import Callable

from matplotlib.figure import Figure

from jaxekf import manifold
from jaxekf.plots.attitudes import attitude, euler_sigma_deg, occlusion
from jaxekf.plots.biases import bias
from jaxekf.plots.paths import path
from jaxekf.plots.sight import longest_gap, look
from jaxekf.plots.single_markers import innovations, marker_sensors, visibility
from jaxekf.plots.style import ESTIMATE, MEASURED, STYLE, TRUTH, band, save
from jaxekf.plots.vectors import position, rate, velocity
from jaxekf.recording import Recording
from jaxekf.result import Estimate

__all__ = [
    "ESTIMATE",
    "MEASURED",
    "STYLE",
    "TRUTH",
    "band",
    "euler_sigma_deg",
    "figure_functions",
    "longest_gap",
    "possible_figures",
    "save",
]

_LEAST_INSTANTS = 10


def figure_functions() -> dict[str, Callable[[Estimate, Recording], Figure]]:
    """Every figure by its file name."""
    return {
        "attitude": attitude,
        "position": position,
        "velocity": velocity,
        "rate": rate,
        "bias": bias,
        "occlusion": occlusion,
        "path": path,
        "visibility": visibility,
        "innovations": innovations,
    }


def possible_figures(estimate: Estimate, recording: Recording) -> tuple[str, ...]:
    """Names of the figures that this model and recording can show; none of fewer than ten instants."""
    if len(estimate.time_ns) < _LEAST_INSTANTS:
        return ()
    tracked = look(estimate, recording).t.size > 0
    parts = {part.name for part in manifold.parts(estimate.model.space)}
    single = bool(marker_sensors(estimate, recording))
    needs = {
        "attitude": "attitude" in estimate.outputs,
        "position": "position" in estimate.outputs,
        "velocity": "velocity" in estimate.outputs,
        "rate": "rate" in estimate.outputs and recording.imu is not None,
        "bias": "bias" in parts and recording.imu is not None,
        "occlusion": tracked and "attitude" in estimate.outputs,
        "path": "position" in estimate.outputs
        or ("attitude" in estimate.outputs and "marker_body" in recording.info),
        "visibility": single,
        "innovations": single,
    }
    return tuple(name for name in figure_functions() if needs[name])
