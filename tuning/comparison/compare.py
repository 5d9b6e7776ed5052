"""Tables that set estimates beside each other on the same runs."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxekf.estimation.batch import Run, estimate_many
from jaxekf.estimation.result import Estimate, trackers
from jaxekf.evaluation.metrics import score, score_hold_last, score_raw_rate
from jaxekf.filtering.model import Model, Parameters
from jaxekf.io import run_folder
from jaxekf.recordings.types import Recording


class Row(NamedTuple):
    """One run under one choice of noise."""

    run: str
    variant: str
    attitude_rmse_deg: float
    rate_rmse_deg_s: float
    nis: float
    """Mean normalised innovation squared of the tracker by degree of freedom; 1 where consistent."""
    nees: float
    """Mean normalised attitude error squared by degree of freedom; 1 where honest."""
    position_rmse_mm: float = float("nan")
    """NaN where the model puts out no position, or the encoder tells none."""
    position_nees: float = float("nan")
    """As `nees`, of the position."""


class Comparison(NamedTuple):
    """Rows of all runs and variants, and the estimates they came from."""

    rows: list[Row]
    estimates: dict[str, list[Estimate]]
    recordings: list[Recording]


def compare(
    model: str | Model,
    runs: Sequence[Run],
    variants: Mapping[str, Parameters | Sequence[Parameters]],
    *,
    smooth: bool = False,
) -> Comparison:
    """Estimate every run with every choice of parameters, one set or a list of each run's own; the first
    rows hold the last tracker sample. With `smooth` the estimates are the smoothed ones.

    The rate of `hold last` is the gyroscope's own; it has no covariance, so that NIS and NEES are NaN.
    """
    recordings = [run if isinstance(run, Recording) else run_folder.load(run) for run in runs]
    estimates = {
        name: estimate_many(recordings, model, p, smooth=smooth) for name, p in variants.items()
    }
    return compare_estimates(recordings, estimates)


def compare_estimates(
    recordings: Sequence[Recording], estimates: Mapping[str, Sequence[Estimate]]
) -> Comparison:
    """As `compare`, of estimates that are made already: for each variant one of every recording."""
    rows: list[Row] = []
    nan = float("nan")
    for i, recording in enumerate(recordings):
        times = next(iter(estimates.values()))[i].time_ns
        if recording.optical is not None:
            held = score_hold_last(recording, times)
            raw = nan if recording.imu is None else score_raw_rate(recording)
            rows.append(Row(recording.name, "hold last", held, raw, nan, nan))
        for name, made in estimates.items():
            judged = score(made[i], recording)
            rows.append(
                Row(
                    recording.name,
                    name,
                    judged.attitude_rmse_deg,
                    judged.rate_rmse_deg_s,
                    _tracker_nis(made[i]),
                    judged.attitude_nees,
                    judged.position_rmse_mm,
                    judged.position_nees,
                )
            )
    made = {name: list(every) for name, every in estimates.items()}
    return Comparison(rows, made, list(recordings))


def _tracker_nis(estimate: Estimate) -> float:
    """Of what sees where the body is, or of all sensors of a model that has nothing of the kind."""
    names = trackers(estimate.sensors) or list(estimate.sensors)
    return sum(estimate.mean_nis(name) for name in names) / len(names)


def mean_by_variant(rows: Sequence[Row], field: str = "attitude_rmse_deg") -> dict[str, float]:
    """Mean of one column over the runs that have a number there, by variant; NaN of none."""
    grouped: dict[str, list[float]] = {}
    for row in rows:
        value = float(getattr(row, field))
        grouped.setdefault(row.variant, []).extend([] if value != value else [value])
    return {
        name: sum(values) / len(values) if values else float("nan")
        for name, values in grouped.items()
    }


def as_dicts(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Rows for JSON; what is not known is None."""
    return [
        {key: None if isinstance(v, float) and v != v else v for key, v in row._asdict().items()}
        for row in rows
    ]
