"""What the recording of a saved result adds to it: measurements, truth, scores and errors."""

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.estimation.result import trackers
from jaxekf.evaluation import metrics
from jaxekf.evaluation.metrics import Score
from jaxekf.io import run_folder
from jaxekf.recordings.types import NANOSECONDS, Floats, Recording, period_ns
from jaxekf.reporting.plots._measurements import PoseMeasurements, Stretch, pose_measurements
from jaxekf.reporting.report._saved import SavedResult

_NAN = float("nan")
_GAP_PERIODS = 2.5


class Evidence(NamedTuple):
    """A result beside its recording, as far as that is still there."""

    result: SavedResult
    recording: Recording | None
    missing: str
    """Why there is no recording; empty where there is one."""
    sight: PoseMeasurements | None
    lost: list[Stretch]
    """Begin and end, in seconds, of what is without a pose of the tracker."""
    score: Score | None
    """Against the encoder."""
    held_deg: float
    """Attitude RMSE of holding the last sample of the tracker; NaN where it is not known."""
    raw_rate_deg_s: float
    """Rate RMSE of the gyroscope as it is."""
    errors: dict[str, Floats]
    """As `metrics.scored_errors`."""


def gather(result: SavedResult) -> Evidence:
    """Read the recording that a result names, and compare the two.

    A recording that is gone, broken, or another one than was estimated, is said in `missing`.
    """
    recording, missing = _load(result)
    sight = None
    if recording is not None:
        sight = pose_measurements(result, recording)
        sight = sight if sight.label else None
    lost = _unseen(result) if sight is None else sight.lost
    score, held, raw, errors = None, _NAN, _NAN, {}
    if recording is not None and recording.encoder is not None:
        score = metrics.score(result, recording)
        errors = metrics.scored_errors(result, recording)
        if recording.optical is not None and recording.optical.valid.any():
            held = metrics.score_hold_last(recording, result.time_ns)
        if recording.imu is not None and "rate" in result.outputs:
            raw = metrics.score_raw_rate(recording)
    return Evidence(result, recording, missing, sight, lost, score, held, raw, errors)


def _load(result: SavedResult) -> tuple[Recording | None, str]:
    """The recording, or why there is none."""
    named = result.document["provenance"].get("recording")
    if not isinstance(named, str) or not named:
        return None, "the result does not say where its recording is"
    try:
        recording = run_folder.load(Path(named))
    except (RecordingError, OSError) as error:
        return None, str(error)
    if differs := _difference(result, recording):
        return None, f"{named} is another recording than was estimated: {differs}"
    return recording, ""


def _difference(result: SavedResult, recording: Recording) -> str:
    """In what a recording is not the one a result was made of; empty where nothing tells."""
    if recording.name != result.run:
        return f"its name is '{recording.name}', not '{result.run}'"
    first, last = int(result.time_ns[0]), int(result.time_ns[-1])
    streams = {"optical": recording.optical, "gyroscope": recording.imu, "imu": recording.imu}
    for name, stream in streams.items():
        count = result.document["account"].get(name, {}).get("read")
        if stream is None or count is None:
            continue
        if len(stream.time_ns) != count:
            return f"it has {len(stream.time_ns)} samples of {name}, not {count}"
        if stream.time_ns[-1] < first or stream.time_ns[0] > last:
            return f"its {name} was recorded at another time"
    return ""


def _unseen(result: SavedResult) -> list[Stretch]:
    """Stretches without a sample of any tracker, told by the innovations alone."""
    seen = [result.sensors[name].time_ns for name in trackers(result.sensors)]
    if not seen:
        return []
    times = np.unique(np.concatenate(seen))
    longest = _GAP_PERIODS * period_ns(times) / NANOSECONDS
    t = np.append((times - result.time_ns[0]) / NANOSECONDS, result.time[-1])
    return [(float(a), float(b)) for a, b in pairwise(t) if b - a > longest]
