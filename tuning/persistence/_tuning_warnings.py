"""Warnings about a tuning, in sentences, from its record `tuning.json`."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from tuning.results.tuned import LEAST_SHARE

CONSISTENT_NEES = (0.5, 2.0)
"""Range of the attitude NEES of a held-out run with a consistent filter."""
_FAR_FACTOR = 10.0
_FAR_SIGMAS = 3.0
_NEAR_BOUND = 0.01
_WORSE = 1.01
_MOST_NAMED = 6
_COLUMNS = {
    "attitude": ("attitude_rmse_deg", "attitude RMSE", "deg"),
    "rate": ("rate_rmse_deg_s", "rate RMSE", "deg/s"),
    "position": ("position_rmse_mm", "position RMSE", "mm"),
}


def cautions(record: Mapping[str, Any]) -> list[str]:
    """Sentences that a reader of a record should know before using its numbers; empty if there are none."""
    checks: tuple[Callable[[Mapping[str, Any]], Iterable[str]], ...] = (
        _rejected,
        _unseen,
        _ended,
        _left_open,
        _one_sided,
        _far,
        _bounded,
        _scaled,
        _worse,
        _inconsistent,
    )
    return [sentence for check in checks for sentence in check(record)]


def on_data(record: Mapping[str, Any]) -> list[str]:
    """The sentences on rejected samples, and on numbers that the data limit to one side only."""
    return [*_rejected(record), *_one_sided(record)]


def before(rows: Sequence[Mapping[str, Any]]) -> str:
    """Name of the variant before the tuning: ``start``, or the first that is neither `hold last` nor tuned;
    empty if there is none."""
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    others = [name for name in variants if name not in ("hold last", "tuned")]
    return "start" if "start" in variants else others[0] if others else ""


def _rejected(record: Mapping[str, Any]) -> Iterable[str]:
    shares = {
        name: used / visible
        for name, (used, visible) in record.get("accepted", {}).items()
        if visible
    }
    low = [f"{name}: {100 * s:.3g} %" for name, s in shares.items() if s < LEAST_SHARE]
    if low and record.get("gates_off"):
        yield (
            f"With the tuned parameters the gates accept only a part of the samples ({_listed(low)}); they"
            " were off during the search: look for outliers, or for what else this model leaves out"
        )
    elif low:
        yield (
            f"The tuning used only a part of the samples ({_listed(low)}), since gates rejected the rest:"
            " tune with the outlier method none, and free the calibration that may be wrong"
        )
    elif record.get("gates_off"):
        yield (
            f"Gates rejected over {100 * (1 - LEAST_SHARE):.0f} % of a sensor's samples at the start, so"
            " that they were off during the search: outliers, if any, count in the tuned noise"
        )


def _one_sided(record: Mapping[str, Any]) -> Iterable[str]:
    for number in record["numbers"]:
        if number["interval"] is None:
            continue
        low, high = number["interval"]
        unit = "" if number["unit"] == "1" else f" {number['unit']}"
        no_low = low is None or (number["logarithm"] and low == 0.0)
        if no_low and high is not None:
            shown = f"0 to {high:.3g}" if number["logarithm"] else f"up to {high:.3g}"
            yield f"The data give no lower limit to {called(number)}: {shown}{unit} (95 %)"
        elif high is None and not no_low:
            yield f"The data give no upper limit to {called(number)}: {low:.3g}{unit} or more (95 %)"


def _unseen(record: Mapping[str, Any]) -> Iterable[str]:
    if record["validation_runs"] or record["folds"] or record["judged_on"] == "other runs":
        return
    how = "was compared on" if record["rows"] else "was validated on"
    yield (
        f"No run was held out: the tuning {how} the training runs themselves, whose errors are"
        " optimistic; name validation runs, or ask for folds"
    )


def _ended(record: Mapping[str, Any]) -> Iterable[str]:
    stopped = record["stopped"]
    if "iterations asked for" in stopped:
        yield f"The search did not converge: {stopped}; ask for more"
    elif "interrupted" in stopped:
        yield f"The search did not converge: {stopped}"
    if count := record["rejected_steps"]:
        steps = "1 step was" if count == 1 else f"{count} steps were"
        yield f"{steps} not finite and rejected: the search went where the filter fails"


def _left_open(record: Mapping[str, Any]) -> Iterable[str]:
    by_motion: dict[str, list[str]] = {}
    for number in record["numbers"]:
        if number["left_open"]:
            by_motion.setdefault(number["would_tell"], []).append(called(number))
    for motion, names in by_motion.items():
        one = len(names) == 1
        kept = "it keeps its initial value" if one else "they keep their initial values"
        which = "it" if one else "them"
        yield (
            f"The data do not determine {_listed(names)}, so that {kept}: {motion} would determine {which}"
        )


def _far(record: Mapping[str, Any]) -> Iterable[str]:
    for number in record["numbers"]:
        change = number["change"]
        if number["logarithm"]:
            far = change is not None and not 1.0 / _FAR_FACTOR <= change <= _FAR_FACTOR
            limit = f"a factor of {_FAR_FACTOR:g}"
        else:
            far = change is not None and abs(change) > _FAR_SIGMAS
            limit = f"{_FAR_SIGMAS:g} deviations of its prior"
        if far:
            yield (
                f"{called(number)} moved by more than {limit} ({number['moved']}): check its start, and"
                " whether the model fits these recordings"
            )


def _bounded(record: Mapping[str, Any]) -> Iterable[str]:
    for number in record["numbers"]:
        bounds, value = number["bounds"], _searched(number)
        if bounds is None or value is None:
            continue
        for bound, which in zip(bounds, ("lower", "upper"), strict=True):
            # For a logarithm 1 % of the bound, else 1 % of the interval between both.
            reach = _NEAR_BOUND * (abs(bound) if number["logarithm"] else bounds[1] - bounds[0])
            left, start = abs(value - bound), number["start"]
            # A number that began near a bound of a wide interval and stayed there was not drawn to it.
            drawn = start is None or left < 0.9 * abs(start - bound) or left < 1e-6 * reach
            if left <= reach and drawn:
                yield (
                    f"{called(number)} is at its {which} bound ({bound:.5g} {number['unit']}): the data"
                    " ask for more; widen the bounds, or look for what makes it go there"
                )


def _scaled(record: Mapping[str, Any]) -> Iterable[str]:
    factor = record["covariance_scale"]
    past = []
    for number in record["numbers"]:
        bounds, value = number["bounds"], number["tuned"]
        if bounds is None or value is None:
            continue
        if not bounds[0] <= value <= bounds[1] and bounds[0] <= _searched(number) <= bounds[1]:
            past.append(called(number))
    if past:
        yield (
            f"The common scale of all covariances ({factor:.4g}) took {_listed(past)} past the bounds:"
            " widen them, or tune by likelihood, which needs no such scale"
        )
    if also := record.get("also_scaled"):
        yield (
            f"The common scale of all covariances ({factor:.4g}) also holds for {_listed(also)}, not free"
            " in this tuning: without it the estimate would change; tune by likelihood to keep them"
        )


def _worse(record: Mapping[str, Any]) -> Iterable[str]:
    for rows, where in _scored(record):
        for name in record["errors"] or ["attitude"]:
            column, head, unit = _COLUMNS[name]
            for run, first, last in _pairs(rows, column):
                if last > _WORSE * first:
                    more = 100.0 * (last / first - 1.0) if first else math.inf
                    yield (
                        f"{run} ({where}) got worse: its {head} is {last:.4g} {unit}, {more:.3g} % more"
                        f" than the {first:.4g} {unit} of the start"
                    )


def _inconsistent(record: Mapping[str, Any]) -> Iterable[str]:
    low, high = CONSISTENT_NEES
    for rows, where in _scored(record):
        if where == "training":
            continue
        outside = [
            f"{row['run']}: {row['nees']:.3g}"
            for row in rows
            if row["variant"] == "tuned"
            and row["nees"] is not None
            and not low <= row["nees"] <= high
        ]
        if outside:
            yield (
                f"The attitude's NEES after tuning is outside {low:g} to {high:g} in {_listed(outside)}"
                f" ({where}): there the covariance is not that of the error"
            )


def _scored(record: Mapping[str, Any]) -> Iterable[tuple[Sequence[Mapping[str, Any]], str]]:
    """Rows, and whether their runs were held out or training runs."""
    yield record["rows"], "training" if record["judged_on"] == "training runs" else "held out"
    if record["folds"]:
        yield record["folds"]["rows"], "held out by its fold"


def _pairs(rows: Sequence[Mapping[str, Any]], column: str) -> Iterable[tuple[str, float, float]]:
    """Runs with a number before and after tuning, if both are known."""
    first_of = before(rows)
    found = {(row["run"], row["variant"]): row[column] for row in rows}
    for run in dict.fromkeys(row["run"] for row in rows):
        first, last = found.get((run, first_of)), found.get((run, "tuned"))
        if first is not None and last is not None:
            yield run, first, last


def _searched(number: Mapping[str, Any]) -> Any:
    """The number before the common scale of all covariances."""
    found = number.get("searched")
    return number["tuned"] if found is None else found


def called(number: Mapping[str, Any]) -> str:
    """A free number by its name, and the run it belongs to."""
    return number["name"] + (f" of {number['run']}" if number["run"] else "")


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_MOST_NAMED])
    left = len(names) - _MOST_NAMED
    return f"{shown} and {left} more" if left > 0 else shown
