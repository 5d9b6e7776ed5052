"""Clock and frame of the trackers of several runs against their IMUs, and whether the runs agree."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support import chi_square
from jaxekf._support.deprecations import renamed
from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.calibration.attitude_alignment import AttitudeMatch, refine
from jaxekf.calibration.time_offset import match
from jaxekf.filtering.model import Model, Parameters
from jaxekf.pose_solvers.marker_pose import fit_markers, from_markers
from jaxekf.recordings.types import Floats, Imu, Optical, Recording

_DRIFTS = 3.0
"""Deviations from which on a drift is believed."""
_MATTERS_S = 1e-3
_LATE_S, _SIGMAS = 2e-3, 3.0
_TURNED = np.deg2rad(1.0)
_KNOWN = np.deg2rad(0.5)
_AGREE = 0.01


class RunAlignment(NamedTuple):
    """What one run tells."""

    run: str
    tracker: AttitudeMatch
    encoder: AttitudeMatch | None
    """None where there is no encoder of an attitude, or it does not tell."""
    notes: tuple[str, ...]


class CombinedAlignment(NamedTuple):
    """Several runs as one: means by weight, and whether the runs agree with them."""

    runs: int
    latency_s: float
    latency_sigma_s: float
    """Widened where the runs do not agree."""
    latency_chi2: float
    latency_p: float
    """Probability of a chi-square as large or larger; NaN of one run."""
    alignment: Floats
    """(3,) rotation vector, rad, that takes vectors of the tracked frame into the IMU's."""
    alignment_cov: Floats
    """(3, 3) rad^2, as in `AttitudeMatch`; widened where the runs do not agree."""
    alignment_chi2: float
    alignment_p: float
    drift: float
    """By which the latency grows in a second; NaN where no run tells."""
    drift_sigma: float
    start_latency_s: float
    """At the start of a run, by that drift; `latency_s` is that of its middle."""

    @property
    def has_drift(self) -> bool:
        """Whether the drift is told from nothing."""
        return abs(self.drift) > _DRIFTS * self.drift_sigma

    def sentences(self) -> tuple[str, ...]:
        """What speaks against one clock and one frame for all."""
        found = []
        for what, p in (("latency", self.latency_p), ("alignment", self.alignment_p)):
            if p < _AGREE:
                found.append(
                    f"the runs do not agree in {what} (chi-square, p = {p:.1g}): the mean's deviation is"
                    " widened; calibrate them one by one where they differ by more than can be borne"
                )
        return tuple(found)


def poses(recording: Recording) -> Optical:
    """The tracker's poses, or those that its single markers give."""
    if recording.optical is not None or recording.markers is None:
        return recording.need_optical()
    markers = recording.markers
    return from_markers(markers, fit_markers(markers, recording.path or recording.name))


def align_run(recording: Recording) -> RunAlignment:
    """Clock and frame of the tracker, and of an encoder of the attitude, against the IMU.

    Raises `RecordingError` where the tracker does not tell; of the encoder that is a note.
    """
    imu, place = recording.need_imu(), recording.path or recording.name
    tracker = align(poses(recording), imu, place)
    notes = []
    if has_drift(tracker):
        notes.append(
            f"the tracker's clock drifts against the IMU's by {1e6 * tracker.drift:.1f} ppm,"
            f" {1e3 * tracker.drift * tracker.duration_s:.1f} ms over the run: without a"
            " clock_drift an offset holds in its middle only"
        )
    encoder = None
    joint = "axis" in recording.info.get("encoder_about", {})
    if recording.encoder is not None and not joint:
        stream = recording.encoder
        try:
            encoder = align(Optical(stream.time_ns, stream.q_ref_body, stream.valid), imu, place)
        except RecordingError as error:
            notes.append(f"the encoder does not tell: {error}")
    return RunAlignment(recording.name, tracker, encoder, tuple(notes))


def align(optical: Optical, imu: Imu, place: object = "recording") -> AttitudeMatch:
    """Clock, drift and frame of one stream of attitudes. Raises `RecordingError`: see `match`, `refine`."""
    return refine(optical, imu, match(optical, imu, place), place)


def has_latency(found: AttitudeMatch) -> bool:
    """Whether a latency is there, for certain, that matters."""
    return abs(found.latency_s) > max(_LATE_S, _SIGMAS * found.latency_sigma_s)


def misalignment_deg(found: AttitudeMatch) -> tuple[float, float] | None:
    """By how many degrees the frames are turned, and the largest deviation; None where they may be one."""
    angle = float(np.linalg.norm(found.alignment))
    sigma = float(np.sqrt(np.linalg.eigvalsh(found.alignment_cov)[-1]))
    if angle <= max(_TURNED, _SIGMAS * sigma):
        return None
    return float(np.rad2deg(angle)), float(np.rad2deg(sigma))


def has_drift(found: AttitudeMatch) -> bool:
    """Whether a drift is there that one offset cannot make good."""
    return (
        abs(found.drift) > _DRIFTS * found.drift_sigma
        and abs(found.drift) * found.duration_s > _MATTERS_S
    )


def combine_runs(runs: Sequence[RunAlignment]) -> CombinedAlignment:
    """One latency and one alignment of all runs, each run with the weight of its covariance."""
    found = [run.tracker for run in runs]
    latency = np.array([m.latency_s for m in found])[:, None]
    variance = np.array([[[m.latency_sigma_s**2]] for m in found])
    mean, cov, statistic, p = _mean(latency, variance)
    frames = Rotation.from_rotvec([m.alignment for m in found])
    # The best known one is where the others are compared; errors are turns in the tracked frame.
    best = int(np.argmin([np.trace(m.alignment_cov) for m in found]))
    off = (frames[best].inv() * frames).as_rotvec()
    turn, turn_cov, turn_chi2, turn_p = _mean(off, np.array([m.alignment_cov for m in found]))
    drift, drift_sigma = _mean_drift(found)
    grown = 0.0 if np.isnan(drift) else drift
    early = latency - grown * 0.5 * np.array([[m.duration_s] for m in found])
    return CombinedAlignment(
        len(found),
        float(mean[0]),
        float(np.sqrt(cov[0, 0])),
        statistic,
        p,
        (frames[best] * Rotation.from_rotvec(turn)).as_rotvec(),
        turn_cov,
        turn_chi2,
        turn_p,
        drift,
        drift_sigma,
        float(_mean(early, variance)[0][0]),
    )


def _mean_drift(found: Sequence[AttitudeMatch]) -> tuple[float, float]:
    """Mean by weight of the runs that are long enough, and its deviation, widened where they disagree."""
    known = [m for m in found if np.isfinite(m.drift)]
    if not known:
        return np.nan, np.nan
    values = np.array([[m.drift] for m in known])
    mean, cov, _, _ = _mean(values, np.array([[[m.drift_sigma**2]] for m in known]))
    return float(mean[0]), float(np.sqrt(cov[0, 0]))


def _mean(values: Floats, covs: Floats) -> tuple[Floats, Floats, float, float]:
    """Mean (n,) of vectors (N, n) by weight, its covariance, and chi-square about it with its p."""
    weight = np.linalg.inv(covs)
    cov = np.linalg.inv(weight.sum(axis=0))
    mean = cov @ np.einsum("nij,nj->i", weight, values)
    off = values - mean
    statistic = float(np.einsum("ni,nij,nj->", off, weight, off))
    freedom = (len(values) - 1) * values.shape[1]
    if freedom == 0:
        return mean, cov, 0.0, float("nan")
    p = float(chi_square.sf(statistic, freedom))
    return mean, cov * max(1.0, statistic / freedom if p < _AGREE else 1.0), statistic, p


def calibration_for(model: Model, found: CombinedAlignment) -> tuple[Parameters, tuple[str, ...]]:
    """The model's parameters with clock and frame set, and sentences on what could not be.

    A model's `latency` or `clock_offset` (its negative), `clock_drift` (what the IMU's clock gains on the
    tracker's) where it has one and a drift is told, and `alignment` where it is known to half a degree
    about every axis. `loose` turns the IMU's rates into the tracked frame, the models of a pose the tracked
    frame into the IMU's. Raises `ModelError` for a model that has neither.
    """
    calibration = model.parameters.calibration
    names = set(getattr(calibration, "_fields", ()))
    changes: dict[str, Any] = {}
    latency = found.latency_s
    if "clock_drift" in names and found.has_drift:
        # It counts from the start of a run, at which the offset then holds.
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
    worst = float(np.sqrt(np.linalg.eigvalsh(found.alignment_cov)[-1]))
    if not worst <= _KNOWN:
        return _with(model, changes), (
            f"the alignment is known to {np.rad2deg(worst):.2g} deg only about one axis, expected"
            f" {np.rad2deg(_KNOWN):.1g} deg or better: it is not set; record turns about several axes",
        )
    inward = "clock_offset" in names
    changes["alignment"] = -found.alignment if inward else found.alignment
    return _with(model, changes), ()


def _with(model: Model, changes: dict[str, Any]) -> Parameters:
    params = model.parameters
    return params._replace(calibration=params.calibration._replace(**changes))


__getattr__ = renamed(
    __name__,
    {
        "Together": "CombinedAlignment",
        "drifts": "has_drift",
        "is_late": "has_latency",
        "together": "combine_runs",
        "turned_deg": "misalignment_deg",
    },
)
