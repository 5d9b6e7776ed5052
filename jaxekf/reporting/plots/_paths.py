"""The path of the tool in three dimensions."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate
from jaxekf.evaluation.metrics import rms
from jaxekf.recordings.types import Encoder, Floats, Recording, to_scipy
from jaxekf.reporting.plots._measurements import PoseMeasurements, pose_measurements, truth
from jaxekf.reporting.plots._registry import figure
from jaxekf.reporting.plots.style import AXES, ESTIMATE, MEASURED, TRUTH, new_figure, styled


class _Paths(NamedTuple):
    """Points (N, 3) in mm, reference frame."""

    estimated: Floats
    measured: Floats | None
    true: Floats | None
    """NaN where the truth is unknown."""


def _has_path(estimate: Estimate, recording: Recording) -> bool:
    outputs = estimate.outputs
    return "position" in outputs or ("attitude" in outputs and "marker_body" in recording.info)


@figure(_has_path)
def path(estimate: Estimate, recording: Recording) -> Figure:
    """3-D path of the body's origin or, for a model without position, of a marker of the tool, which
    rotates about the origin of the reference frame."""
    poses, known = (
        pose_measurements(estimate, recording),
        truth(recording, estimate, estimate.time_ns),
    )
    if "position" in estimate.outputs:
        paths, subject = _origin_path(estimate, poses, known), "path of the body's origin"
    else:
        paths, subject = _marker_path(estimate, recording, poses, known), "path of a marker"
    title = f"{estimate.run}: {subject}, reference frame"
    with styled():
        drawn = new_figure((7, 6))
        axes: Any = drawn.add_subplot(projection="3d")
        if paths.true is not None:
            axes.plot(*paths.true.T, color=TRUTH, lw=2.2, label="encoder")
            title += f", RMSE {rms(paths.estimated - paths.true):.2f} mm"
        if paths.measured is not None:
            axes.plot(*paths.measured.T, ".", ms=2.5, color=MEASURED, label=poses.label)
        axes.plot(*paths.estimated.T, color=ESTIMATE, lw=1.2, label="estimate")
        for name in AXES:
            getattr(axes, f"set_{name}label")(f"{name} (mm)")
        _equal_scale(axes, paths.estimated)
        axes.legend(loc="upper left")
        drawn.suptitle(title)
    return drawn


def _origin_path(estimate: Estimate, poses: PoseMeasurements, known: Encoder | None) -> _Paths:
    measured = true = None
    if poses.pose.position is not None:
        measured = 1e3 * poses.pose.position[poses.seen]
    if known is not None and known.position is not None:
        true = np.where(known.valid[:, None], 1e3 * known.position, np.nan)
    return _Paths(1e3 * estimate.outputs["position"].value, measured, true)


def _marker_path(
    estimate: Estimate, recording: Recording, poses: PoseMeasurements, known: Encoder | None
) -> _Paths:
    marker = np.asarray(recording.info["marker_body"], float)

    def turned(q: Floats) -> Floats:
        return 1e3 * to_scipy(q).apply(marker)

    true, optical = None, recording.optical
    measured = turned(poses.pose.q_ref_body[poses.seen]) if poses.t.size else None
    if optical is not None and optical.position is not None:
        measured = 1e3 * optical.position[poses.seen]
    if known is not None:
        true = np.where(known.valid[:, None], turned(known.q_ref_body), np.nan)
    return _Paths(turned(estimate.attitude.value), measured, true)


def _equal_scale(axes: Any, points: Floats) -> None:
    """The same scale on the three axes, with a little depth where the path is flat."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = 0.55 * float(np.ptp(points, axis=0).max()) + 1e-9
    for name, centre in zip(AXES, middle, strict=True):
        getattr(axes, f"set_{name}lim")(centre - reach, centre + reach)
    axes.set_box_aspect((1, 1, 1))
