"""Gyroscope, accelerometer and magnetometer."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxekf.io.schema import Option, StreamSchema, triple
from jaxekf.recordings import facts, screening
from jaxekf.recordings.accounts import Intake, Place
from jaxekf.recordings.types import Floats, Imu


def _screen(place: Place, arrays: Mapping[str, Any], sort: bool) -> tuple[Imu, Intake]:
    others = [arrays.get(name) for name in ("accelerometer", "magnetometer")]
    if others[1] is not None and (offset := arrays.get("magnetometer_offset")) is not None:
        others[1] = others[1] - offset
    return screening.imu(place, arrays["time_ns"], arrays["gyroscope"], *others, sort=sort)


def _offset(section: Mapping[str, Any], label: str, place: Path | str) -> Floats | None:
    if _OFFSET not in section:
        return None
    return facts.finite_vector(section[_OFFSET], 3, place, f"{label}.{_OFFSET}")


_OFFSET = "magnetometer_offset"

SCHEMA = StreamSchema(
    "imu",
    "Angular rate, and where recorded specific force and magnetic field, in the body frame.",
    {
        "gyroscope": triple("g", "rad/s", "body", "angular rate", needed=True),
        "accelerometer": triple("a", "m/s^2", "body", "specific force"),
        "magnetometer": triple(
            "m", "", "body", "magnetic field in any unit; blank where it was not read"
        ),
    },
    options={
        _OFFSET: Option(
            "[x, y, z]",
            "offset of the magnetometer (hard iron) in its unit, subtracted when read (default 0)",
            parse=_offset,
        ),
    },
    described={"kind": "imu", "frame": "body", "unit": "rad/s, m/s^2"},
    screen=_screen,
)
