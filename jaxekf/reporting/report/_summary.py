"""A run in one row: its errors before and after, and its verdicts."""

import math
from typing import Any, NamedTuple

from jaxekf.estimation.result import trackers
from jaxekf.io.documents.result import SquaresTest
from jaxekf.reporting.report._comparison import ComparedResult

_NAN = float("nan")


class Number(NamedTuple):
    """A column of the overview."""

    name: str
    """The field of `Summary`."""
    head: str
    decimals: int


class Summary(NamedTuple):
    """Numbers of one run; NaN is unknown."""

    model: str
    duration_s: float
    samples: int
    """Instants of the estimate."""
    tracker_used: int
    tracker_read: int
    held_attitude_deg: float
    """RMSE of holding the last sample of the tracker."""
    attitude_rmse_deg: float
    gyroscope_rmse_deg_s: float
    """RMSE of the gyroscope as it is."""
    rate_rmse_deg_s: float
    position_rmse_mm: float
    attitude_nees: float
    position_nees: float
    tracker_nis: float
    verdicts: tuple[str, ...]


NUMBERS = (
    Number("duration_s", "duration (s)", 1),
    Number("samples", "samples", 0),
    Number("tracker_used", "tracker samples used", 0),
    Number("tracker_read", "of", 0),
    Number("held_attitude_deg", "attitude RMSE (deg), holding the tracker", 3),
    Number("attitude_rmse_deg", "attitude RMSE (deg), estimate", 3),
    Number("gyroscope_rmse_deg_s", "rate RMSE (deg/s), gyroscope", 3),
    Number("rate_rmse_deg_s", "rate RMSE (deg/s), estimate", 3),
    Number("position_rmse_mm", "position RMSE (mm)", 3),
    Number("attitude_nees", "NEES attitude", 3),
    Number("position_nees", "NEES position", 3),
    Number("tracker_nis", "NIS tracker", 3),
)


def shown(value: Any, decimals: int) -> str:
    """A number with the given number of decimals; a dash for none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def summarise(compared: ComparedResult) -> Summary:
    """Numbers and verdicts of one run."""
    document, score = compared.result.document, compared.score
    account, mean_nis = document.account, document.mean_nis
    seeing = trackers(account)
    known = [v for v in (mean_nis.get(name) for name in seeing) if v is not None]
    return Summary(
        model=compared.result.model,
        duration_s=document.duration_s,
        samples=len(compared.result.time_ns),
        tracker_used=sum(account[name].get("used", 0) for name in seeing),
        tracker_read=sum(account[name].get("read", 0) for name in seeing),
        held_attitude_deg=compared.hold_last_deg,
        attitude_rmse_deg=_NAN if score is None else score.attitude_rmse_deg,
        gyroscope_rmse_deg_s=compared.raw_rate_deg_s,
        rate_rmse_deg_s=_NAN if score is None else score.rate_rmse_deg_s,
        position_rmse_mm=_NAN if score is None else score.position_rmse_mm,
        attitude_nees=_NAN if score is None else score.attitude_nees,
        position_nees=_NAN if score is None else score.position_nees,
        tracker_nis=sum(known) / len(known) if known else _NAN,
        verdicts=_verdicts(compared),
    )


def _verdicts(compared: ComparedResult) -> tuple[str, ...]:
    """Sentences of the saved diagnosis, as `Diagnosis.sentences` makes them."""
    found = compared.result.diagnosis
    if found is None:
        return (
            "no diagnosis is saved in this result: estimate the run again by jaxekf estimate, or save it"
            " with diagnosis=jaxekf.diagnose(estimate, run).as_dict(curves=True)",
        )
    if found.verdicts:
        return tuple(verdict.sentence for verdict in found.verdicts)
    tests = [(f"NIS of {name}", sensor.nis) for name, sensor in found.sensors.items()]
    tests += [(f"NEES of {name}", part) for name, part in found.parts.items()]
    numbers = "; ".join(_mean(name, test) for name, test in tests if test.samples)
    return (f"no fault found: {numbers}",) if numbers else ("too few samples to judge",)


def _mean(name: str, test: SquaresTest) -> str:
    low, high = test.interval
    return f"{name} {shown(test.mean, 2)} ({shown(low, 2)} to {shown(high, 2)})"
