"""A saved result with its recording: measurements, truth, scores and errors."""

from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs

from jaxekf._support.errors import RecordingError
from jaxekf.estimation.result import trackers
from jaxekf.evaluation import metrics
from jaxekf.evaluation.metrics import Score
from jaxekf.io import run_folder
from jaxekf.io.documents.result import ScoreNumbers
from jaxekf.recordings.types import NANOSECONDS, Floats, Recording, period_ns
from jaxekf.reporting.plots._measurements import PoseMeasurements, Stretch, pose_measurements
from jaxekf.reporting.report._saved import SavedResult

_NAN = float("nan")
_GAP_PERIODS = 2.5


class ComparedResult(NamedTuple):
    """A result and its recording, if that can still be read."""

    result: SavedResult
    recording: Recording | None
    missing: str
    """Why there is no recording; empty where there is one."""
    sight: PoseMeasurements | None
    gaps: list[Stretch]
    """Begin and end, in seconds, of the stretches without a pose of the tracker."""
    score: Score | None
    """Against the encoder."""
    hold_last_deg: float
    """Attitude RMSE of holding the last sample of the tracker; NaN if unknown."""
    raw_rate_deg_s: float
    """Rate RMSE of the gyroscope as it is."""
    errors: dict[str, Floats]
    """As `metrics.scored_errors`."""


def compare(result: SavedResult) -> ComparedResult:
    """Read the recording that a result names, and compare the two.

    `missing` is the reason for which a recording cannot be used: it is gone, broken, or another one
    than was estimated. The score is the saved one; it is computed for results of earlier versions,
    which have none.
    """
    recording, missing = _load(result)
    sight = None
    if recording is not None:
        sight = pose_measurements(result, recording)
        sight = sight if sight.label else None
    gaps = _gaps(result) if sight is None else sight.lost
    score, held, raw, errors = None, _NAN, _NAN, {}
    if recording is not None and recording.encoder is not None:
        score = _saved_score(result) or metrics.score(result, recording)
        errors = metrics.scored_errors(result, recording)
        if recording.optical is not None and recording.optical.valid.any():
            held = metrics.score_hold_last(recording, result.time_ns)
        if recording.imu is not None and "rate" in result.outputs:
            raw = metrics.score_raw_rate(recording)
    return ComparedResult(result, recording, missing, sight, gaps, score, held, raw, errors)


def _saved_score(result: SavedResult) -> Score | None:
    """The score in `result.json`; null is NaN."""
    saved = result.document.score
    if not isinstance(saved, ScoreNumbers):
        return None
    numbers: dict[str, Any] = {
        key: _NAN if value is None else value for key, value in structs.asdict(saved).items()
    }
    return Score(**numbers)


def _load(result: SavedResult) -> tuple[Recording | None, str]:
    """The recording, or why there is none."""
    named = result.document.provenance.get("recording")
    if not isinstance(named, str) or not named:
        return None, "the result has no path of its recording"
    try:
        recording = run_folder.load(Path(named))
    except (RecordingError, OSError) as error:
        return None, str(error)
    if differs := _difference(result, recording):
        return None, f"{named} is another recording than was estimated: {differs}"
    return recording, ""


def _difference(result: SavedResult, recording: Recording) -> str:
    """How a recording differs from the one that was estimated; empty for no difference."""
    if recording.name != result.run:
        return f"its name is '{recording.name}', not '{result.run}'"
    first, last = int(result.time_ns[0]), int(result.time_ns[-1])
    streams = {"optical": recording.optical, "gyroscope": recording.imu, "imu": recording.imu}
    for name, stream in streams.items():
        count = result.document.account.get(name, {}).get("read")
        if stream is None or count is None:
            continue
        if len(stream.time_ns) != count:
            return f"it has {len(stream.time_ns)} samples of {name}, not {count}"
        placed = result.clock.from_tracker if name == "optical" else result.clock.from_imu
        begin, end = placed(stream.time_ns[[0, -1]]).tolist()
        if end < first or begin > last:
            return f"its {name} was recorded at another time"
    return ""


def _gaps(result: SavedResult) -> list[Stretch]:
    """Stretches without a sample of any tracker, by the innovations alone."""
    sampled = [result.sensors[name].time_ns for name in trackers(result.sensors)]
    if not sampled:
        return []
    times = np.unique(np.concatenate(sampled))
    longest = _GAP_PERIODS * period_ns(times) / NANOSECONDS
    t = np.append((times - result.time_ns[0]) / NANOSECONDS, result.time[-1])
    return [(float(a), float(b)) for a, b in pairwise(t) if b - a > longest]
