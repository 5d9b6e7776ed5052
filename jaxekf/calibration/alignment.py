"""Clock and rotation of trackers relative to their IMUs, run by run and combined.

`align_run` estimates latency, drift and tracker-to-IMU rotation of one run, `combine_runs` forms the
weighted mean and tests whether the runs agree, `calibration_for` writes the result into a model's
parameters.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support import chi_square
from jaxekf._support.deprecations import renamed
from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.calibration import clock_step
from jaxekf.calibration.attitude_alignment import (
    AttitudeMatch,
    refine,
    unobservable_axis,
    without_turn,
)
from jaxekf.calibration.clock_offset import AGREE, find
from jaxekf.calibration.motion_agreement import rotation_agreement
from jaxekf.calibration.time_offset import match
from jaxekf.filtering.model import Model, Parameters
from jaxekf.pose_solvers.marker_pose import fit_markers, from_markers
from jaxekf.recordings.accounts import Indices
from jaxekf.recordings.types import NANOSECONDS, Floats, Imu, Optical, Recording

_DRIFTS = 3.0
"""Standard deviations from which a drift is significant."""
_MATTERS_S = 1e-3
_LATE_S, _SIGMAS = 2e-3, 3.0
_TURNED = np.deg2rad(1.0)
_KNOWN = np.deg2rad(0.5)
_AGREE = 0.01
_UNKNOWN_MEAN, _FRAME_ROUNDS = 0.15, 20
_NEAR_S = 0.45
"""Offset, s, that the search of `time_offset.match` covers."""


class RunAlignment(NamedTuple):
    """Estimates of one run."""

    run: str
    tracker: AttitudeMatch
    encoder: AttitudeMatch | None
    """None without an encoder of an attitude, or if its alignment could not be estimated."""
    notes: tuple[str, ...]


class CombinedAlignment(NamedTuple):
    """Weighted means over several runs, and chi-square tests of whether the runs agree."""

    runs: int
    latency_s: float
    latency_sigma_s: float
    """Standard deviation, s; inflated if the runs disagree."""
    latency_chi2: float
    latency_p: float
    """P-value of the chi-square; NaN for one run."""
    alignment: Floats
    """(3,) rotation vector, rad, tool frame to IMU frame."""
    alignment_cov: Floats
    """(3, 3) rad^2, as in `AttitudeMatch`; inflated if the runs disagree."""
    alignment_chi2: float
    alignment_p: float
    drift: float
    """Growth of the latency, s/s; NaN if no run is long enough."""
    drift_sigma: float
    start_latency_s: float
    """Latency at the start of a run under that drift; `latency_s` is that of the middle."""
    alignment_freedom: int
    """Degrees of freedom of the alignments' chi-square; unobservable axes have none."""

    @property
    def has_drift(self) -> bool:
        """Whether the drift is significant."""
        return abs(self.drift) > _DRIFTS * self.drift_sigma

    def sentences(self) -> tuple[str, ...]:
        """Warnings if the runs disagree in clock or frame."""
        found = []
        for what, p in (("latency", self.latency_p), ("alignment", self.alignment_p)):
            if p < _AGREE:
                found.append(
                    f"the runs disagree in {what} (chi-square test, p = {p:.1g}): the standard"
                    " deviation of the mean is inflated; calibrate the runs one by one if it matters"
                )
        return tuple(found)


def poses(recording: Recording) -> Optical:
    """The tracker's poses, or those computed from its single markers."""
    if recording.optical is not None or recording.markers is None:
        return recording.need_optical()
    markers = recording.markers
    return from_markers(markers, fit_markers(markers, recording.path or recording.name))


def align_run(recording: Recording) -> RunAlignment:
    """Clock and rotation of the tracker, and of an encoder of the attitude, relative to the IMU.

    Raises
    ------
    RecordingError
        If the tracker's alignment cannot be estimated. A failure of the encoder becomes a note.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.calibration import alignment
    >>> tracker = alignment.align_run(jaxekf.load(jaxekf.demo.FOLDER / "free-5")).tracker
    >>> abs(tracker.latency_s) < 1e-3, bool(np.linalg.norm(tracker.alignment) < 0.01)  # s, rad
    (True, True)
    """
    imu, place = recording.need_imu(), recording.path or recording.name
    tracker = align(poses(recording), imu, place)
    notes = []
    if has_drift(tracker):
        notes.append(
            f"the tracker's clock drifts against the IMU's by {1e6 * tracker.drift:.1f} ppm,"
            f" {1e3 * tracker.drift * tracker.duration_s:.1f} ms over the run: without"
            " clock_drift a constant offset is right in the middle of the run only"
        )
    if (jump := clock_step.far_step(poses(recording), imu)) is not None:
        notes.append(f"{jump.sentence()}: only the part before it is used")
    encoder = None
    joint = "axis" in recording.info.get("encoder_about", {})
    if recording.encoder is not None and not joint:
        stream = recording.encoder
        try:
            taken = stream.time_ns - stream.latency_ns
            encoder = align(Optical(taken, stream.q_ref_body, stream.valid), imu, place)
        except RecordingError as error:
            notes.append(f"the encoder's alignment could not be estimated: {error}")
    return RunAlignment(recording.name, tracker, encoder, tuple(notes))


def align(optical: Optical, imu: Imu, place: object = "recording") -> AttitudeMatch:
    """Clock, drift and rotation of one stream of attitudes, at a clock offset of any size.

    Raises
    ------
    RecordingError
        As `time_offset.match` and `attitude_alignment.refine` if the motion determines no offset; if no
        offset fits, several fit alike, or a clock steps.
    """
    step = clock_step.find(optical, imu)
    if step is not None:
        raise step.error(place)
    try:
        return refine(optical, imu, match(optical, imu, place), place)
    except RecordingError:
        offset_s = _far_offset(optical, imu, place)
        if offset_s is None:
            raise
    shifted = replace(optical, time_ns=optical.time_ns - round(offset_s * NANOSECONDS))
    found = refine(shifted, imu, match(shifted, imu, place), place)
    return found._replace(latency_s=found.latency_s + offset_s, middle_s=found.middle_s + offset_s)


def _far_offset(optical: Optical, imu: Imu, place: object) -> float | None:
    """Clock offset beyond half a second, s; None if the motion determines none or it is smaller."""
    rows = np.flatnonzero(optical.valid)
    t = (optical.time_ns[rows] - optical.latency_ns - imu.time_ns[0]) / NANOSECONDS

    def attitude(chosen: Indices) -> Floats:
        return optical.q_ref_body[rows[chosen]]

    def agreement(offset_s: float) -> tuple[float, float]:
        return rotation_agreement(t, attitude, imu, offset_s)

    found = find(t, attitude, imu, agreement)
    if found.within_s == 0.0 or abs(found.offset_s) < _NEAR_S:
        return None
    if np.isnan(found.offset_s):
        raise RecordingError(
            str(place),
            "a tracker and a gyroscope whose rotations do not agree at any clock offset within"
            f" ±{found.within_s:.0f} s (the best one explains {100.0 * found.explained:.0f} %)",
            f"{100.0 * AGREE:.0f} % or more",
            "streams of one body and one run, with clocks that do not jump",
        )
    if found.others_s:
        offsets = sorted([found.offset_s, *found.others_s], key=abs)
        raise RecordingError(
            str(place),
            "motion that repeats: clock offsets of"
            f" {', '.join(f'{offset:+.2f}' for offset in offsets)} s between tracker and gyroscope fit"
            " alike",
            "one that fits",
            "motion that does not repeat, or shifting the times of one stream first",
        )
    return found.offset_s


def has_latency(found: AttitudeMatch) -> bool:
    """Whether a latency is significant and larger than 2 ms."""
    return abs(found.latency_s) > max(_LATE_S, _SIGMAS * found.latency_sigma_s)


def misalignment_deg(found: AttitudeMatch) -> tuple[float, float] | None:
    """Angle between the frames and its largest standard deviation, deg; None if it is not significant.

    A turn about an unobservable axis is left out.
    """
    angle = float(np.linalg.norm(found.alignment))
    sigma = largest_sigma(found.alignment_cov)
    if angle <= max(_TURNED, _SIGMAS * sigma):
        return None
    return float(np.rad2deg(angle)), float(np.rad2deg(sigma))


def largest_sigma(alignment_cov: Floats) -> float:
    """Largest standard deviation of an alignment, rad, without that about an unobservable axis."""
    at = -1 if unobservable_axis(alignment_cov) is None else -2
    return float(np.sqrt(np.linalg.eigvalsh(alignment_cov)[at]))


def unobservable_turn(alignment_cov: Floats) -> str | None:
    """A sentence on the axis about which the alignment is unobservable; None without one."""
    axis = unobservable_axis(alignment_cov)
    if axis is None:
        return None
    where = ", ".join(f"{value + 0.0:+.2f}" for value in np.round(axis, 2))
    return (
        f"all rotation is about one axis, ({where}) of the tool frame: the tilt of this axis against the"
        " IMU is known, the turn of the tool frame about it is unobservable and left at zero; rotate about"
        " a second axis to determine it"
    )


def has_drift(found: AttitudeMatch) -> bool:
    """Whether a drift is significant and changes the latency by more than 1 ms over the run."""
    return (
        abs(found.drift) > _DRIFTS * found.drift_sigma
        and abs(found.drift) * found.duration_s > _MATTERS_S
    )


def combine_runs(runs: Sequence[RunAlignment]) -> CombinedAlignment:
    """One latency and one alignment for all runs, each run weighted by its inverse covariance.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.calibration import alignment
    >>> runs = [jaxekf.load(path) for path in jaxekf.demo.paths(("free-4", "free-5"))]
    >>> mean = alignment.combine_runs([alignment.align_run(run) for run in runs])
    >>> mean.runs, abs(mean.latency_s) < 1e-3, mean.sentences()
    (2, True, ())
    """
    found = [run.tracker for run in runs]
    latency = np.array([m.latency_s for m in found])[:, None]
    variance = np.array([[[m.latency_sigma_s**2]] for m in found])
    mean, cov, statistic, p = _mean(latency, variance)
    frame, turn_cov, turn_chi2, turn_p, freedom = _mean_frame(found)
    drift, drift_sigma = _mean_drift(found)
    grown = 0.0 if np.isnan(drift) else drift
    early = latency - grown * 0.5 * np.array([[m.duration_s] for m in found])
    return CombinedAlignment(
        len(found),
        float(mean[0]),
        float(np.sqrt(cov[0, 0])),
        statistic,
        p,
        frame.as_rotvec(),
        turn_cov,
        turn_chi2,
        turn_p,
        drift,
        drift_sigma,
        float(_mean(early, variance)[0][0]),
        freedom,
    )


def _mean_frame(found: Sequence[AttitudeMatch]) -> tuple[Rotation, Floats, float, float, int]:
    """Weighted mean of the alignments, with covariance, chi-square about it, p-value and freedom."""
    covs = np.array([m.alignment_cov for m in found])
    frames = [Rotation.from_rotvec(m.alignment) for m in found]
    axes = [unobservable_axis(cov) for cov in covs]
    # Rotations are compared relative to the most certain one; errors are rotations in the tool frame.
    mean = frames[int(np.argmin(np.trace(covs, axis1=1, axis2=2)))]
    unknown = sum(axis is not None for axis in axes)
    rounds = _FRAME_ROUNDS if unknown else 1
    while True:
        near = [
            frame if axis is None else without_turn(frame, axis, mean)
            for frame, axis in zip(frames, axes, strict=True)
        ]
        off = (mean.inv() * Rotation.concatenate(near)).as_rotvec()
        turn, cov, chi2, p = _mean(off, covs, unknown)
        mean, rounds = mean * Rotation.from_rotvec(turn), rounds - 1
        if rounds == 0:
            break
    axis = unobservable_axis(cov)
    freedom = max(0, 3 * len(found) - 3 - unknown + (axis is not None))
    return mean if axis is None else without_turn(mean, axis), cov, chi2, p, freedom


def _mean_drift(found: Sequence[AttitudeMatch]) -> tuple[float, float]:
    """Weighted mean drift of the runs that are long enough, and its standard deviation."""
    known = [m for m in found if np.isfinite(m.drift)]
    if not known:
        return np.nan, np.nan
    values = np.array([[m.drift] for m in known])
    mean, cov, _, _ = _mean(values, np.array([[[m.drift_sigma**2]] for m in known]))
    return float(mean[0]), float(np.sqrt(cov[0, 0]))


def _mean(values: Floats, covs: Floats, unknown: int = 0) -> tuple[Floats, Floats, float, float]:
    """Weighted mean (n,) of vectors (N, n), its covariance, the chi-square about it and the p-value.

    `unknown` components of the vectors are known by their prior only.
    """
    weight = np.linalg.inv(covs)
    cov = np.linalg.inv(weight.sum(axis=0))
    mean = cov @ np.einsum("nij,nj->i", weight, values)
    off = values - mean
    statistic = float(np.einsum("ni,nij,nj->", off, weight, off))
    freedom = (len(values) - 1) * values.shape[1] - unknown
    if unknown and np.linalg.eigvalsh(cov)[-1] > _UNKNOWN_MEAN**2:
        freedom += 1
    if freedom <= 0:
        return mean, cov, 0.0, float("nan")
    p = float(chi_square.sf(statistic, freedom))
    return mean, cov * max(1.0, statistic / freedom if p < _AGREE else 1.0), statistic, p


def calibration_for(model: Model, found: CombinedAlignment) -> tuple[Parameters, tuple[str, ...]]:
    """The model's parameters with clock and rotation set, and sentences on what could not be set.

    The function sets a model's `latency` or `clock_offset` (its negative), `clock_drift` (gain of the IMU's
    clock over the tracker's) if the model has one and the drift is significant, and `alignment` if it is
    known to half a degree about every axis but an unobservable one. `loose` rotates the IMU's rates into
    the tool frame, the pose models rotate the tool frame into the IMU's.

    Raises
    ------
    ModelError
        If the model has neither `latency` nor `clock_offset`.
    """
    calibration = model.parameters.calibration
    names = set(getattr(calibration, "_fields", ()))
    changes: dict[str, Any] = {}
    latency = found.latency_s
    if "clock_drift" in names and found.has_drift:
        # The drift counts from the start of a run, so the offset is that of the start.
        latency = found.start_latency_s
        changes["clock_drift"] = np.array(-found.drift)
    if "clock_offset" in names:
        changes["clock_offset"] = np.array(-latency)
    if "latency" in names:
        changes["latency"] = np.array(latency)
    if not {"clock_offset", "latency"} & names:
        raise ModelError(
            f"got the model '{model.name}', which has no clock to calibrate, expected one that has a"
            " clock_offset or latency; try loose, loose_pose or tight"
        )
    if "alignment" not in names:
        return _with(model, changes), (f"the model '{model.name}' has no alignment to set",)
    worst = largest_sigma(found.alignment_cov)
    if not worst <= _KNOWN:
        return _with(model, changes), (
            f"the alignment is known to {np.rad2deg(worst):.2g} deg only about one axis, expected"
            f" {np.rad2deg(_KNOWN):.1g} deg or better: it is not set; record rotation about several axes",
        )
    inward = "clock_offset" in names
    changes["alignment"] = -found.alignment if inward else found.alignment
    turn = unobservable_turn(found.alignment_cov)
    return _with(model, changes), () if turn is None else (turn,)


def _with(model: Model, changes: dict[str, Any]) -> Parameters:
    params = model.parameters
    return params._replace(calibration=params.calibration._replace(**changes))


__getattr__ = renamed(
    __name__,
    "Together>CombinedAlignment drifts>has_drift is_late>has_latency together>combine_runs "
    "turned_deg>misalignment_deg",
)
