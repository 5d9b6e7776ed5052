"""Gyroscope, accelerometer and magnetometer."""

from collections.abc import Mapping
from typing import Any

from jaxekf.io.schema import StreamSchema, triple
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Intake, Place
from jaxekf.recordings.types import Imu


def _screen(place: Place, arrays: Mapping[str, Any], sort: bool) -> tuple[Imu, Intake]:
    others = [arrays.get(name) for name in ("accelerometer", "magnetometer")]
    return screening.imu(place, arrays["time_ns"], arrays["gyroscope"], *others, sort=sort)


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
    described={"kind": "imu", "frame": "body", "unit": "rad/s, m/s^2"},
    screen=_screen,
)
