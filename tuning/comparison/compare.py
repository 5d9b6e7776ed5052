"""Comparison of several sets of parameters on the same runs."""

from collections.abc import Mapping, Sequence

from jaxekf.estimation.batch import Run, estimate_many, read
from jaxekf.estimation.result import Estimate, trackers
from jaxekf.evaluation.metrics import score, score_hold_last, score_raw_rate
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Recording
from tuning.results.comparison import Comparison, Row


def compare(
    model: str | Model,
    runs: Sequence[Run],
    variants: Mapping[str, Parameters | Sequence[Parameters]],
    *,
    smooth: bool = False,
) -> Comparison:
    """Estimate every run with every set of parameters and score the estimates against the encoder.

    Parameters
    ----------
    model
        Model, or its name.
    runs
        Recordings, or their paths.
    variants
        Parameters by variant: one set for all runs, or a list with one for each run.
    smooth
        Whether to compare the smoothed estimates.

    Returns
    -------
    Comparison
        Its rows begin, for each run with a tracker, with `hold last`: the last tracker sample, and the
        gyroscope as rate. That has no covariance, so that NIS and NEES are NaN.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> params = jaxekf.get_model("loose").parameters
    >>> variants = {"start": params, "triple noise": tuning.scaled(params, 9.0)}
    >>> found = tuning.compare("loose", [jaxekf.demo.FOLDER / "free-5"], variants)
    >>> [(row.variant, round(row.nis, 1)) for row in found.rows]
    [('hold last', nan), ('start', 1.0), ('triple noise', 0.1)]
    """
    recordings = read(runs)
    estimates = {
        name: estimate_many(recordings, model, p, smooth=smooth) for name, p in variants.items()
    }
    return compare_estimates(recordings, estimates)


def compare_estimates(
    recordings: Sequence[Recording], estimates: Mapping[str, Sequence[Estimate]]
) -> Comparison:
    """As `compare`, for given estimates: for each variant one of every recording."""
    rows: list[Row] = []
    nan = float("nan")
    for i, recording in enumerate(recordings):
        times = next(iter(estimates.values()))[i].time_ns
        if recording.optical is not None:
            held = score_hold_last(recording, times)
            raw = nan if recording.imu is None else score_raw_rate(recording)
            rows.append(Row(recording.name, "hold last", held, raw, nan, nan))
        for name, made in estimates.items():
            scores = score(made[i], recording)
            rows.append(
                Row(
                    recording.name,
                    name,
                    scores.attitude_rmse_deg,
                    scores.rate_rmse_deg_s,
                    _tracker_nis(made[i]),
                    scores.attitude_nees,
                    scores.position_rmse_mm,
                    scores.position_nees,
                )
            )
    made = {name: list(every) for name, every in estimates.items()}
    return Comparison(rows, made, list(recordings))


def _tracker_nis(estimate: Estimate) -> float:
    """Mean NIS over the trackers of a model, or over all sensors if it has no tracker."""
    names = trackers(estimate.sensors) or list(estimate.sensors)
    return sum(estimate.mean_nis(name) for name in names) / len(names)
