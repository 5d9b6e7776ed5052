"""`result.json`: summary, account, parameters and provenance of an estimate."""

from typing import Any

from msgspec import UNSET, Struct, UnsetType, field

from jaxekf.io.documents.codec import Document
from jaxekf.recordings.types import Floats


class Column(Struct):
    """A column of `estimate.csv`."""

    name: str
    unit: str
    frame: str = ""


class Quantity(Struct):
    """A parameter with its unit."""

    value: Floats
    unit: str


class Innovations(Struct):
    """The file that holds the innovations of all sensors to the last bit."""

    file: str
    samples: dict[str, int]
    """By sensor."""


class ClockOfTimes(Struct):
    """The clock of all times of a result, and how the IMU's clock differs from the tracker's."""

    name: str
    """``imu``, ``tracker``, or ``recording`` where no two clocks differ."""
    offset_s: float = 0.0
    """IMU's clock minus the tracker's at `start_ns`, s."""
    drift: float = 0.0
    """Growth of the offset, s per s."""
    start_ns: int = 0
    """Start of the estimate on the tracker's clock, ns."""


class ScoreNumbers(Struct):
    """Agreement with the encoder, as `jaxekf.score`; None is not known."""

    attitude_rmse_deg: float | None
    rate_rmse_deg_s: float | None
    attitude_nees: float | None
    position_rmse_mm: float | None
    position_nees: float | None
    samples: int
    time_shift_s: float | None = None
    time_shift_sigma_s: float | None = None
    shifted_rmse_deg: float | None = None
    rate_shift_s: float | None = None
    rate_shift_sigma_s: float | None = None


class SquaresTest(Struct):
    """Mean of normalised squares and its 95 % interval, of NIS or NEES."""

    samples: int = 0
    mean: float | None = None
    interval: tuple[float | None, float | None] = (None, None)


class WhitenessTest(Struct):
    """Autocorrelation of whitened innovations; the curves are None where they were not saved."""

    lag_s: Floats | None = None
    autocorrelation: Floats | None = None
    """(rows, lags)"""
    bound: Floats | None = None


class SensorTest(Struct):
    """Consistency of one sensor's innovations."""

    nis: SquaresTest
    whiteness: WhitenessTest


class VerdictText(Struct):
    """A fault that was found, as a sentence."""

    sentence: str


class DiagnosisDocument(Struct):
    """Those parts of `Diagnosis.as_dict` that the report shows."""

    verdicts: list[VerdictText]
    notes: list[str]
    sensors: dict[str, SensorTest]
    parts: dict[str, SquaresTest]
    """NEES by output."""


class ResultDocument(Document, kw_only=True):
    """`result.json`; keys with a default are missing in results of earlier versions."""

    run: str
    model: str
    smoothed: bool
    online: bool = False
    clock: ClockOfTimes = field(default_factory=lambda: ClockOfTimes("recording"))
    instants: int | None = None
    requested: int | None = None
    duration_s: float
    log_likelihood: float | None = None
    mean_nis: dict[str, float | None]
    """By sensor; None for a sensor without samples."""
    outliers: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Gate and weighting by sensor."""
    account: dict[str, dict[str, int]]
    """Rows read, used, masked, gated and dropped, by stream."""
    notes: list[str]
    estimate_columns: list[Column]
    innovation_units: dict[str, list[str]]
    innovations: Innovations | UnsetType = UNSET
    provenance: dict[str, Any]
    parameters: dict[str, dict[str, Quantity]] = field(default_factory=dict)
    diagnosis: DiagnosisDocument | UnsetType = UNSET
    score: ScoreNumbers | UnsetType = UNSET
