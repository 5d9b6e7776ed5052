"""A run in one row: how large its errors are, before and after, and what speaks against it."""

import math
from typing import Any, NamedTuple

from jaxekf.estimation.result import trackers
from jaxekf.reporting.report._evidence import Evidence

_NAN = float("nan")


class Number(NamedTuple):
    """A column of the overview."""

    name: str
    """The field of `Summary`."""
    head: str
    decimals: int


class Summary(NamedTuple):
    """Numbers are NaN where there is nothing to tell them."""

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
    """A number with so many decimals; a dash for none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def summarise(seen: Evidence) -> Summary:
    """The row of one run."""
    document, score = seen.result.document, seen.score
    account, mean_nis = document["account"], document["mean_nis"]
    seeing = trackers(account)
    known = [v for v in (mean_nis.get(name) for name in seeing) if v is not None]
    return Summary(
        model=seen.result.model,
        duration_s=float(document["duration_s"]),
        samples=len(seen.result.time_ns),
        tracker_used=sum(account[name].get("used", 0) for name in seeing),
        tracker_read=sum(account[name].get("read", 0) for name in seeing),
        held_attitude_deg=seen.held_deg,
        attitude_rmse_deg=_NAN if score is None else score.attitude_rmse_deg,
        gyroscope_rmse_deg_s=seen.raw_rate_deg_s,
        rate_rmse_deg_s=_NAN if score is None else score.rate_rmse_deg_s,
        position_rmse_mm=_NAN if score is None else score.position_rmse_mm,
        attitude_nees=_NAN if score is None else score.attitude_nees,
        position_nees=_NAN if score is None else score.position_nees,
        tracker_nis=sum(known) / len(known) if known else _NAN,
        verdicts=_verdicts(seen),
    )


def _verdicts(seen: Evidence) -> tuple[str, ...]:
    """What the saved diagnosis says, as `Diagnosis.sentences` does."""
    found = seen.result.diagnosis
    if found is None:
        return (
            "no diagnosis is saved in this result: estimate the run again by jaxekf estimate, or save it"
            " with diagnosis=jaxekf.diagnose(estimate, run).as_dict(curves=True)",
        )
    if found["verdicts"]:
        return tuple(str(verdict.get("sentence", verdict)) for verdict in found["verdicts"])
    told = [_told(f"NIS of {name}", each.get("nis", {})) for name, each in found["sensors"].items()]
    told += [_told(f"NEES of {name}", each) for name, each in found["parts"].items()]
    numbers = "; ".join(text for text in told if text)
    return (f"nothing speaks against it: {numbers}",) if numbers else ("too little to judge",)


def _told(about: str, squares: dict[str, Any]) -> str:
    if not squares.get("samples"):
        return ""
    low, high = squares["interval"]
    return f"{about} {squares['mean']:.2f} ({low:.2f} to {high:.2f})"
