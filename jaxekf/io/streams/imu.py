"""Gyroscope, accelerometer and magnetometer."""

from collections.abc import Mapping
from typing import Any

from jaxekf.io.schema import Field, StreamSchema
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Intake, Place
from jaxekf.recordings.types import Imu


def _screen(place: Place, arrays: Mapping[str, Any], sort: bool) -> tuple[Imu, Intake]:
    others = [arrays.get(name) for name in ("accelerometer", "magnetometer")]
    return screening.imu(place, arrays["time_ns"], arrays["gyroscope"], *others, sort=sort)


def _triple(unit: str, head: str, about: str, *, needed: bool = False) -> Field:
    columns = tuple(f"{head}{axis}" for axis in "xyz")
    return Field(
        shape=("N", 3), unit=unit, frame="body", needed=needed, columns=columns, about=about
    )


SCHEMA = StreamSchema(
    "imu",
    "Angular rate, and where recorded specific force and magnetic field, in the body frame.",
    {
        "gyroscope": _triple("rad/s", "g", "angular rate", needed=True),
        "accelerometer": _triple("m/s^2", "a", "specific force"),
        "magnetometer": _triple("", "m", "magnetic field in any unit; blank where it was not read"),
    },
    described={"kind": "imu", "frame": "body", "unit": "rad/s, m/s^2"},
    screen=_screen,
)
