"""Inspection of a recorded run: samples, gaps, clocks, units, and whether it can be used as it is.

`inspect` gathers the findings for `jaxekf check`; its verdict is ``fine``, ``warnings`` or ``faults``.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf._support.deprecations import renamed
from jaxekf._support.errors import RecordingError
from jaxekf.calibration.alignment import (
    RunAlignment,
    align_run,
    has_drift,
    has_latency,
    misalignment_deg,
    unobservable_turn,
)
from jaxekf.calibration.clock_step import ClockStepError, common_jump
from jaxekf.checks._camera_agreement import (
    CameraEvidence,
    camera_evidence,
    camera_warnings,
    check_camera,
)
from jaxekf.checks._field_offset import field_findings
from jaxekf.checks._held_values import held_findings
from jaxekf.checks._pose_findings import pose_findings, without_flips
from jaxekf.checks._rotation_match import rotation_findings
from jaxekf.checks._sensor_range import range_findings
from jaxekf.checks.plausibility import FARTHEST_M, Evidence, check, evidence
from jaxekf.checks.sensor_agreement import overlap_s
from jaxekf.recordings.types import NANOSECONDS, Flags, Recording, Times

GAP = 1.5
"""Median steps from which on a step is a gap."""
_LONG_IMU_GAP_S = 0.5
_GRAVITY_OFF, _RATE_OFF = 0.05, 0.05
_SEEN_TOO_LITTLE = 0.5
_EXPECTED = ("blank", "hidden", "missing tool", "status ")
_LAYOUT = ("cells are separated", "numbers have decimal commas")
"""Reasons that occur in good recordings, too: the tool was hidden."""

SENSOR_CHECKS = (
    range_findings,
    rotation_findings,
    pose_findings,
    held_findings,
    field_findings,
)
"""Checks that find faults of a sensor; each takes the run and the evidence to `Findings`."""
Span = tuple[float, float]


@dataclass(frozen=True)
class Gaps:
    """Gaps of a stream."""

    count: int
    longest_s: float
    lost_s: float
    """Total length of the gaps, s."""
    spans: list[Span]
    """Begin and end of each gap, s on the recording's clock."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"count": self.count, "longest_s": self.longest_s, "lost_s": self.lost_s}


class StreamSummary(NamedTuple):
    """Summary of one stream, or of one marker of a tool."""

    samples: int
    usable: int
    rate_hz: float
    """Rate by the median step, Hz; NaN for one sample."""
    begin_s: float
    """First time, s on the recording's clock, latency subtracted."""
    end_s: float
    gaps: Gaps
    """Gaps between time stamps, of samples usable or not: steps of more than 1.5 times the median."""
    hidden: Gaps
    """Intervals of samples that exist and are not usable."""
    masked: dict[str, int]
    """Masked rows by reason; samples that are not valid if no rows were read."""
    dropped: dict[str, int]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        document = self._asdict() | {"gaps": self.gaps.as_dict(), "hidden": self.hidden.as_dict()}
        return document | {"duration_s": self.end_s - self.begin_s}


class PointsSummary(NamedTuple):
    """Landmarks in the images of a camera."""

    landmarks: int
    images: int
    points_per_image: float
    """Usable points, mean over all images."""
    images_without_points: int


@dataclass(frozen=True)
class Inspection:
    """Findings on one run."""

    run: str
    streams: dict[str, StreamSummary]
    evidence: Evidence
    alignment: RunAlignment | None
    """None if it could not be estimated, or if there is nothing to align."""
    faults: tuple[str, ...] = ()
    """Findings that forbid using the run as it is."""
    warnings: tuple[str, ...] = ()
    """Findings to look at before using the run."""
    notes: tuple[str, ...] = ()
    """Findings that occur in good runs, too."""
    markers: dict[str, StreamSummary] = field(default_factory=dict)
    """Single markers by name."""
    points: PointsSummary | None = None
    """None without a camera."""
    camera: CameraEvidence | None = None
    """None without a camera, or if no image has landmarks enough for a pose."""

    @property
    def verdict(self) -> str:
        """``fine``, ``warnings`` or ``faults``."""
        return "faults" if self.faults else "warnings" if self.warnings else "fine"


def inspect(recording: Recording) -> Inspection:
    """Inspect a run; a finding is reported and never raises.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.checks import inspection
    >>> found = inspection.inspect(jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> found.verdict, found.faults
    ('fine', ())
    """
    streams = {label: _stream(recording, label) for label in recording.streams}
    found = evidence(recording)
    faults, warnings, notes = [], [], []
    try:
        check(recording, found)
    except RecordingError as error:
        faults.append(str(error))
    aligned, images = None, camera_evidence(recording)
    if images is not None and not faults:
        try:
            check_camera(recording, images)
        except RecordingError as error:
            faults.append(str(error))
    tracked = recording.optical is not None or recording.markers is not None
    if recording.imu is None or not (tracked or images is not None):
        lacking = "IMU" if recording.imu is None else "tracker"
        notes.append(f"without {lacking} neither clocks nor units can be compared")
    elif tracked and not faults:
        try:
            aligned = align_good_poses(recording, found)
        except RecordingError as error:
            warnings.append(f"clock and frame could not be estimated: {error}")
            if isinstance(error, ClockStepError):
                found = replace(found, clock_steps=True, rate_ratio=np.nan, explained=np.nan)
    if aligned is not None and (turn := unobservable_turn(aligned.tracker.alignment_cov)):
        notes.append(turn)
    for label in streams:
        _add_row_accounts(recording, label, warnings, notes)
    notes += _unread_files(recording)
    jump = None
    if recording.optical is not None and recording.imu is not None:
        jump = common_jump(recording.optical, recording.imu)
    warnings += _timing_warnings(streams, found, jump)
    warnings += [] if aligned is None else _clock_warnings(aligned)
    warnings += [] if faults else _unit_warnings(recording, found)
    warnings += [] if faults or images is None else camera_warnings(images)
    for more in (measure(recording, found) for measure in SENSOR_CHECKS):
        warnings += more.warnings
        notes += more.notes
    return Inspection(
        recording.name,
        streams,
        found,
        aligned,
        tuple(faults),
        tuple(warnings),
        tuple(notes),
        _markers(recording),
        _points(recording),
        images,
    )


def align_good_poses(recording: Recording, found: Evidence) -> RunAlignment:
    """`jaxekf.calibration.alignment.align_run` without the poses that are flipped against the gyroscope.

    Raises
    ------
    RecordingError
        As `align_run`.
    """
    optical = without_flips(recording, found)
    if optical is recording.optical or optical is None or recording.optical is None:
        return align_run(recording)
    count = int(recording.optical.valid.sum() - optical.valid.sum())
    made = align_run(recording.replace(optical=optical))
    return made._replace(notes=(*made.notes, f"{count} flipped poses are left out"))


def _unread_files(recording: Recording) -> list[str]:
    """Notes on sections of the description that look like streams and are none that is known."""
    sections = [key for key, value in recording.info.items() if isinstance(value, dict)]
    folder = recording.path
    return [
        f"{key}.csv is not read: [{key}] is no stream of this process; register its schema"
        " (jaxekf.io.register)"
        for key in sections
        if folder is not None and (folder / f"{key}.csv").is_file()
    ]


def _stream(recording: Recording, label: str) -> StreamSummary:
    stream = recording.streams[label]
    usable = stream.seen
    account = recording.intake.get(label)
    masked, dropped = {}, {}
    if account is not None:
        masked = {name: reason.count for name, reason in account.masked.items()}
        dropped = {name: reason.count for name, reason in account.dropped.items()}
    elif not usable.all():
        masked = {"not valid": int((~usable).sum())}
    return _summary(stream.time_ns - stream.latency_ns, usable, masked, dropped)


def _markers(recording: Recording) -> dict[str, StreamSummary]:
    markers = recording.markers
    if markers is None:
        return {}
    time_ns = markers.time_ns - markers.latency_ns
    return {
        name: _summary(time_ns, markers.usable[:, i], _masked_reason(markers.usable[:, i]), {})
        for i, name in enumerate(markers.names)
    }


def _points(recording: Recording) -> PointsSummary | None:
    camera = recording.camera
    if camera is None:
        return None
    count = camera.usable.sum(axis=1)
    return PointsSummary(
        len(camera.names), len(count), float(count.mean()), int((count == 0).sum())
    )


def _masked_reason(usable: Flags) -> dict[str, int]:
    return {} if usable.all() else {"hidden": int((~usable).sum())}


def _summary(
    time_ns: Times, usable: Flags, masked: dict[str, int], dropped: dict[str, int]
) -> StreamSummary:
    step = float(np.median(np.diff(time_ns))) / NANOSECONDS if len(time_ns) > 1 else np.nan
    return StreamSummary(
        len(time_ns),
        int(usable.sum()),
        1.0 / step if step > 0.0 else np.nan,
        float(time_ns[0]) / NANOSECONDS,
        float(time_ns[-1]) / NANOSECONDS,
        find_gaps(time_ns),
        _stretches(time_ns, ~usable),
        masked,
        dropped,
    )


def find_gaps(time_ns: Times) -> Gaps:
    """Gaps of a stream: steps of more than 1.5 times the median.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.checks import inspection
    >>> inspection.find_gaps(np.array([0, 10, 20, 30, 90, 100]) * 1_000_000)
    Gaps(count=1, longest_s=0.06, lost_s=0.06, spans=[(0.03, 0.09)])
    """
    step = np.diff(time_ns)
    if step.size == 0:
        return Gaps(0, 0.0, 0.0, [])
    at = np.flatnonzero(step > GAP * np.median(step))
    return _gaps(time_ns, at, at + 1)


def _stretches(time_ns: Times, bad: Flags) -> Gaps:
    """Intervals of bad samples, each from its first to the next good one, or to the last."""
    edges = np.flatnonzero(np.diff(np.r_[False, bad, False].astype(int)))
    return _gaps(time_ns, edges[::2], np.minimum(edges[1::2], len(time_ns) - 1))


def _gaps(time_ns: Times, begin: Any, end: Any) -> Gaps:
    lost = (time_ns[end] - time_ns[begin]) / NANOSECONDS
    ends = zip(time_ns[begin].tolist(), time_ns[end].tolist(), strict=True)
    spans = [(a / NANOSECONDS, b / NANOSECONDS) for a, b in ends]
    return Gaps(len(spans), float(lost.max(initial=0.0)), float(lost.sum()), spans)


def _add_row_accounts(
    recording: Recording, label: str, warnings: list[str], notes: list[str]
) -> None:
    """Add the account of rows: hidden tools and the layout of the file are notes, everything else
    warnings."""
    account = recording.intake.get(label)
    if account is None:
        return
    count = len(account.masked)
    for i, text in enumerate(account.sentences(label)):
        name = list(account.masked)[i] if i < count else text.partition(": ")[2]
        (notes if name.startswith((*_EXPECTED, *_LAYOUT)) else warnings).append(text)


def _timing_warnings(
    streams: dict[str, StreamSummary], found: Evidence, jump: str | None
) -> list[str]:
    warnings = []
    imu = streams.get("imu")
    if jump is not None:
        return [f"{jump}; the run is cut there and each part estimated by itself"]
    long = [b - a for a, b in imu.gaps.spans if b - a > _LONG_IMU_GAP_S] if imu else []
    if long:
        warnings.append(
            f"the IMU has {len(long)} gaps of more than {_LONG_IMU_GAP_S:g} s, the longest of"
            f" {max(long):.2f} s: estimates within a gap are not usable"
        )
    for label, name in (("optical", "tracker"), ("markers", "tracker"), ("camera", "camera")):
        seeing = streams.get(label)
        if seeing is None:
            continue
        span = max(seeing.end_s - seeing.begin_s, 1e-9)
        unseen = (seeing.gaps.lost_s + seeing.hidden.lost_s) / span
        if unseen > _SEEN_TOO_LITTLE:
            warnings.append(f"the {name} sees nothing for {100.0 * unseen:.0f} % of its time")
        overlap = overlap_s(found.ranges_s, label)
        if 0.0 <= overlap < _SEEN_TOO_LITTLE * span:
            warnings.append(
                f"{name} and IMU overlap for {overlap:.1f} s of the {name}'s {span:.1f} s"
            )
    return warnings


def _clock_warnings(aligned: RunAlignment) -> list[str]:
    match = aligned.tracker
    warnings = list(aligned.notes)
    if has_latency(match) and not has_drift(match):
        age = "older" if match.latency_s > 0.0 else "newer"
        warnings.append(
            f"the tracker's samples are {1e3 * abs(match.latency_s):.1f} ms {age} than stamped, by the"
            " IMU's clock: jaxekf align writes a calibration that corrects it"
        )
    if (misaligned := misalignment_deg(match)) is not None:
        partly = unobservable_turn(match.alignment_cov) is not None
        part = ", the turn about the axis of rotation left out" if partly else ""
        warnings.append(
            f"the tool frame is rotated by {misaligned[0]:.1f} deg relative to the IMU's{part}: jaxekf"
            " align writes a calibration that corrects it"
        )
    return warnings


def _unit_warnings(recording: Recording, found: Evidence) -> list[str]:
    """Warnings on implausible values that no wrong unit explains."""
    warnings = []
    gravity = float(np.linalg.norm(recording.info.get("gravity_ref", [STANDARD_GRAVITY])))
    at_rest = found.static_scatter < _GRAVITY_OFF
    if at_rest and abs(found.static_norm / max(gravity, 1e-9) - 1.0) > _GRAVITY_OFF:
        warnings.append(
            f"the accelerometer reads {found.static_norm:.2f} m/s^2 at rest; gravity is {gravity:.2f}"
        )
    # Noise of slow motion makes the gyroscope seem faster, by the share that is not common.
    if abs(found.rate_ratio - 1.0) > _RATE_OFF + (1.0 - found.rate_correlation**2):
        warnings.append(
            f"the gyroscope rotates {found.rate_ratio:.3f} times as fast as the tracker"
        )
    if found.farthest > FARTHEST_M:
        warnings.append(
            f"the tool is up to {found.farthest:.3g} m from the reference's origin: are these metres?"
        )
    return warnings


__getattr__ = renamed(__name__, "PointsFound>PointsSummary StreamFound>StreamSummary")
