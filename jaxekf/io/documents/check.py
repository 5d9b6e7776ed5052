"""`check.json`: streams, alignment and faults of recorded runs."""

from typing import Any

from msgspec import UNSET, Struct, UnsetType

from jaxekf.io.documents.alignment import RunAlignment, StreamAlignment
from jaxekf.io.documents.codec import Document


class StreamCheck(Struct, kw_only=True):
    """One stream, or one marker of a tool."""

    samples: int
    usable: int
    rate_hz: float
    begin_s: float
    end_s: float
    gaps: dict[str, float]
    hidden: dict[str, float]
    masked: dict[str, int]
    dropped: dict[str, int]
    duration_s: float
    each: "dict[str, StreamCheck] | UnsetType" = UNSET
    """Single markers by their names."""


class CameraCheck(StreamCheck, kw_only=True):
    """A camera's images; counts are those of `jaxekf.checks.inspection`."""

    landmarks: int
    images: int
    points_per_image: float
    images_without_points: int
    images_with_enough_landmarks: int | UnsetType = UNSET
    images_with_a_pose: int | UnsetType = UNSET
    error_px: float | UnsetType = UNSET
    reported_sigma_px: float | UnsetType = UNSET
    evidence: dict[str, Any] | UnsetType = UNSET
    alignment: StreamAlignment | UnsetType = UNSET


class RunCheck(Struct, kw_only=True):
    """One run; a run that cannot be read has faults only."""

    path: str
    verdict: str
    run: str | UnsetType = UNSET
    streams: dict[str, StreamCheck] | UnsetType = UNSET
    alignment: RunAlignment | UnsetType | None = UNSET
    evidence: dict[str, Any] | UnsetType = UNSET
    """Agreement of tracker and IMU in units, order and time."""
    faults: list[str]
    warnings: list[str]
    notes: list[str]


class CheckDocument(Document, kw_only=True):
    """`check.json`."""

    kind: str = "jaxekf check"
    verdict: str
    runs: list[RunCheck]
