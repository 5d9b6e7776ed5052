"""Tuned folders of `jaxekf tune`, read again: the record of the tuning, and runs in it compared."""

import json
import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.run_folder import SCHEMA_VERSION

FILE = "tuning.json"
HELD = "hold last"
_AGAIN = "tuning again with this version of jaxekf"
BEST_AT_ONE = ("nis", "nees", "position_nees")


class Spread(NamedTuple):
    """A column of one variant over the runs; NaN where there are too few."""

    mean: float
    deviation: float
    """Standard deviation of a run, by n - 1."""
    worst: float
    """The largest error; of NIS and NEES what is farthest from 1 as a factor."""


@dataclass(frozen=True)
class SavedTuning:
    """A tuned folder in memory."""

    folder: Path
    document: dict[str, Any]
    """As `tuning.persistence.tuning_document` makes it."""

    @property
    def judged(self) -> tuple[Sequence[dict[str, Any]], str]:
        """The rows that tell most of how well the tuning does, and on what they are: those of runs that
        were not learnt from, where there are any."""
        rows, folds = self.document["rows"], self.document["folds"]
        if folds is not None and (not rows or self.document["judged_on"] == "training runs"):
            return folds["rows"], "runs held out by folds"
        return rows, self.document["judged_on"] or ""


def variants(rows: Sequence[dict[str, Any]]) -> list[str]:
    """In the order of the rows."""
    return list(dict.fromkeys(row["variant"] for row in rows))


def before_and_after(rows: Sequence[dict[str, Any]]) -> tuple[str, str]:
    """The variants to set beside each other: start and tuned, or the first and the last there are."""
    known = [name for name in variants(rows) if name != HELD]
    if not known:
        return "", ""
    first = "start" if "start" in known else known[0]
    return first, "tuned" if "tuned" in known else known[-1]


def spread(rows: Sequence[dict[str, Any]], variant: str, column: str) -> Spread:
    """One column over the runs that have a number there."""
    told = [row[column] for row in rows if row["variant"] == variant and row[column] is not None]
    if not told:
        return Spread(math.nan, math.nan, math.nan)
    values = np.array(told, float)
    with np.errstate(divide="ignore"):
        badness = np.abs(np.log(values)) if column in BEST_AT_ONE else values
    deviation = float(values.std(ddof=1)) if len(values) > 1 else math.nan
    return Spread(float(values.mean()), deviation, float(values[np.argmax(badness)]))


def read_tuning(folder: Path | str) -> SavedTuning:
    """Read `tuning.json` of a tuned folder.

    Raises `RecordingError` where it is missing, broken, of another version, or not what is written there.
    """
    file = Path(folder) / FILE
    try:
        document = json.loads(file.read_text("utf-8"), parse_constant=_refuse)
    except FileNotFoundError:
        raise RecordingError(file, "no such file", "the record of a tuning", _AGAIN) from None
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(file, f"text that is not JSON ({error})", "JSON", _AGAIN) from error
    version = document.get("schema_version") if isinstance(document, dict) else None
    if version != SCHEMA_VERSION:
        raise RecordingError(file, f"schema_version {version!r}", f"{SCHEMA_VERSION}", _AGAIN)
    if fault := _fault(document, _RECORD, ""):
        raise RecordingError(
            file,
            f"a record with another {fault.removeprefix('.')} or none",
            "what jaxekf tune writes there",
            _AGAIN,
        )
    _check_noise(Path(folder), document.get("tuning"))
    return SavedTuning(Path(folder), document)


def _check_noise(folder: Path, tuning: Any) -> None:
    """What a kill left of two tunings is not shown as one."""
    file = folder / "noise.toml"
    try:
        origin = tomllib.loads(file.read_text("utf-8-sig")).get("origin")
    except (OSError, ValueError):
        return
    beside = origin.get("tuning") if isinstance(origin, dict) else None
    if None not in (beside, tuning) and beside != tuning:
        raise RecordingError(
            folder / FILE,
            f"the record of the tuning {tuning} beside {file.name} of {beside}",
            "both of one, which a kill while they were written may have prevented",
            "tuning again",
        )


def _refuse(constant: str) -> None:
    raise ValueError(f"it holds {constant}")


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _flag(value: Any) -> bool:
    return isinstance(value, bool)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not _flag(value) and math.isfinite(value)


def _numbers(value: Any) -> bool:
    """A number, none, or lists of them, all of one shape."""
    try:
        array = np.array(value, float)
    except (TypeError, ValueError):
        return False
    return array.size > 0 and not np.isinf(array).any()


def _pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_number, value))


def _maybe(kind: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or kind(value)


def _table(value: Any) -> bool:
    return isinstance(value, dict)


_ROW = {"run": _text, "variant": _text} | dict.fromkeys(
    ("attitude_rmse_deg", "rate_rmse_deg_s", "nis", "nees", "position_rmse_mm", "position_nees"),
    _maybe(_number),
)
_SPREAD = dict.fromkeys(("start", "mean", "deviation"), _numbers)
_RECORD = {
    "model": _text,
    "objective": _text,
    "runs": [_text],
    "validation_runs": [_text],
    "date": _maybe(_text),
    "provenance": _table,
    "stopped": _text,
    "evaluations": _number,
    "rejected_steps": _number,
    "covariance_scale": _number,
    "best_iteration": _number,
    "starts": [{"value": _maybe(_number), "iterations": _number, "ending": _text}],
    "history": [
        {
            "number": _number,
            "training": _maybe(_number),
            "validation": _maybe(_number),
            "rejected": _flag,
        }
    ],
    "numbers": [
        {
            "name": _text,
            "run": _maybe(_text),
            "truth": _flag,
            "unit": _text,
            "logarithm": _flag,
            "start": _maybe(_number),
            "tuned": _maybe(_number),
            "written": _maybe(_number),
            "interval": _maybe(_pair),
            "moved": _text,
            "left_open": _flag,
        }
    ],
    "units": _table,
    "truth": lambda value: value is None or not _fault(value, {...: _ENTRY}, ""),
    "judged_on": _maybe(_text),
    "rows": [_ROW],
    "folds": lambda value: value is None or not _fault(value, _FOLDS, ""),
    "warnings": [_text],
}
_ENTRY = {"value": _numbers, "unit": _text}
_FOLDS = {"rows": [_ROW], "held_out": [[_text]], "parameters": {...: _SPREAD}}


def _fault(value: Any, shape: Any, place: str) -> str:
    """Where a document is not of a shape: a table, of which ``...`` stands for any key, a list of one
    shape, or what a function says yes to; empty where it is."""
    if isinstance(shape, list):
        if not isinstance(value, list):
            return place
        found = (_fault(item, shape[0], f"{place}[{i}]") for i, item in enumerate(value))
    elif isinstance(shape, dict):
        if not isinstance(value, dict):
            return place
        if ... in shape:
            shape = dict.fromkeys(value, shape[...])
        found = (
            _fault(value.get(key, _MISSING), kind, f"{place}.{key}") for key, kind in shape.items()
        )
    else:
        return "" if value is not _MISSING and shape(value) else place
    return next(filter(None, found), "")


_MISSING = object()
