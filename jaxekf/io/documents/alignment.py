"""`align.json`: clock and frame of trackers and encoders against the IMU."""

from typing import Any

from msgspec import UNSET, Struct, UnsetType, field

from jaxekf.io.documents.codec import Document
from jaxekf.recordings.types import Floats


class StreamAlignment(Struct):
    """One stream of a run against the IMU."""

    latency_s: float
    latency_sigma_s: float
    middle_s: float
    duration_s: float
    drift: float
    drift_sigma: float
    alignment_deg: Floats
    """(3,) rotation vector."""
    alignment_sigma_deg: Floats
    """Null where an unobservable axis leaves a component open."""
    bias_deg_s: Floats
    scatter_deg: float
    unobservable_axis: Floats | UnsetType = UNSET
    """(3,) axis of the tool frame about which all rotation was; the turn about it is left at zero."""


class RunAlignment(Struct):
    """One run."""

    run: str
    tracker: StreamAlignment
    encoder: StreamAlignment | UnsetType = UNSET
    notes: tuple[str, ...] = ()


class MeanAlignment(Struct):
    """All runs together, and whether they agree."""

    latency_s: float
    latency_sigma_s: float
    latency_chi2: float
    latency_p: float
    alignment_deg: Floats
    alignment_sigma_deg: Floats
    alignment_chi2: float
    alignment_p: float
    drift: float
    drift_sigma: float
    start_latency_s: float
    unobservable_axis: Floats | UnsetType = UNSET


class AlignmentDocument(Document, kw_only=True):
    """`align.json`."""

    kind: str = "jaxekf alignment"
    model: str
    runs: list[RunAlignment]
    together: MeanAlignment
    calibration: dict[str, Any]
    notes: list[str]
    failed: dict[str, str] = field(default_factory=dict)
    """Errors of the runs that were left out, by path."""
    provenance: dict[str, Any]
