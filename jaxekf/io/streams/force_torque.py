"""Force and torque at the tool, for a model of one's own."""

from jaxekf.io.schema import StreamSchema, latency, triple

SCHEMA = StreamSchema(
    "force_torque",
    "Force and torque of a six-axis sensor, in its own frame.",
    {
        "force": triple("f", "N", "sensor", "force", needed=True),
        "torque": triple("t", "N m", "sensor", "torque about the sensor's origin", needed=True),
        "latency_ns": latency(),
    },
)
