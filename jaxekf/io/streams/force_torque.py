"""Force and torque at the tool, for a model of one's own."""

from jaxekf.io.schema import Field, StreamSchema, latency


def _triple(unit: str, head: str, about: str) -> Field:
    columns = tuple(f"{head}{axis}" for axis in "xyz")
    return Field(
        shape=("N", 3), unit=unit, frame="sensor", needed=True, columns=columns, about=about
    )


SCHEMA = StreamSchema(
    "force_torque",
    "Force and torque of a six-axis sensor, in its own frame.",
    {
        "force": _triple("N", "f", "force"),
        "torque": _triple("N m", "t", "torque about the sensor's origin"),
        "latency_ns": latency(),
    },
)
