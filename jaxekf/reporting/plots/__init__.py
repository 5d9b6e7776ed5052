"""Pictures of an estimate beside what was measured and what is true.

Every figure is a function of an estimate and its recording; `possible_figures` tells which of them a model
and a recording can show.
"""

from collections.abc import Callable

from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate
from jaxekf.geometry import manifold
from jaxekf.recordings.types import Recording
from jaxekf.reporting.plots._attitudes import attitude, euler_sigma_deg, occlusion
from jaxekf.reporting.plots._biases import bias
from jaxekf.reporting.plots._paths import path
from jaxekf.reporting.plots._sight import longest_gap, look
from jaxekf.reporting.plots._single_markers import innovations, marker_sensors, visibility
from jaxekf.reporting.plots._vectors import position, rate, velocity
from jaxekf.reporting.plots.style import ESTIMATE, MEASURED, STYLE, TRUTH, band, save

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
