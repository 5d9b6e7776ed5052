"""Poses of an optical tracker."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxekf.io import description
from jaxekf.io.csv_table import POSITION
from jaxekf.io.schema import TEXT, Field, Option, StreamSchema, attitude, latency, validity
from jaxekf.recordings import facts, screening
from jaxekf.recordings.accounts import Intake, Place
from jaxekf.recordings.types import Optical


def _screen(place: Place, arrays: Mapping[str, Any], sort: bool) -> tuple[Optical, Intake]:
    arm = arrays.get("p_body_tool")
    return screening.optical(
        place,
        arrays["time_ns"],
        arrays["q_ref_body"],
        arrays.get("position"),
        status=arrays.get("status"),
        status_ok=arrays.get("status_ok", screening.STATUS_OK),
        error=screening.check_reported(place, "error", arrays.get("error"), least=0.0),
        error_max=arrays.get("error_max", float("inf")),
        hidden=~arrays["valid"] if "valid" in arrays else None,
        sort=sort,
        p_body_tool=arm if arm is None else facts.finite_vector(arm, 3, place.path, "p_body_tool"),
        latency_ns=int(arrays.get("latency_ns", 0)),
    )


def _status_ok(section: Mapping[str, Any], label: str, place: Path | str) -> Sequence[str]:
    return description.words(section, label, "status_ok", screening.STATUS_OK, place)


def _error_max(section: Mapping[str, Any], label: str, place: Path | str) -> float:
    return description.limit(section, label, "error_max", place)


SCHEMA = StreamSchema(
    "optical",
    "Attitude, and often position, of the tool in the tracker's reference frame.",
    {
        "q_ref_body": attitude("attitude; blank where the tool was not seen", hideable=True),
        "valid": validity(),
        "position": Field(
            shape=("N", 3),
            unit="m",
            frame="reference",
            columns=POSITION,
            about="position of the point `p_body_tool`",
            hideable=True,
        ),
        "status": Field(
            TEXT, columns=("status",), about="status word of the tracker", stored=False
        ),
        "error": Field(
            unit="m", columns=("error",), about="fit error that the tracker reports", least=0.0
        ),
        "p_body_tool": Field(
            shape=(3,),
            unit="m",
            frame="body",
            about="point whose position is given (default: the body's origin)",
            option="p_body_tool",
        ),
        "latency_ns": latency(),
    },
    options={
        "status_ok": Option(
            '["ok"]', "status words of good samples (default ok, 0)", parse=_status_ok
        ),
        "error_max": Option(
            "m", "largest fit error of a good sample (default: no limit)", parse=_error_max
        ),
    },
    described={"kind": "pose", "quaternion": facts.BODY_TO_REFERENCE, "unit": "1, m"},
    screen=_screen,
)
