"""Clock, frames and origin of an encoder relative to the tracker, as parameters with a gradient.

Unknown ones are estimated with the rest, so that a wrong truth neither counts as an error of the estimate
nor biases its parameters. They are reported separately: errors against a fitted frame are optimistic.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxekf.geometry import rotation


class TruthFrame(NamedTuple):
    """Corrections of an encoder; zero changes nothing.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> encoder = run.need_encoder()
    >>> late = run.replace(encoder=replace(encoder, time_ns=encoder.time_ns + 5_000_000))
    >>> problem = {"objective": "attitude", "free": ["truth.clock_offset"], "iterations": 5}
    >>> print(f"{1e3 * tuning.tune([late], **problem).truth.clock_offset:.1f} ms")
    5.0 ms
    """

    clock_offset: Any
    """Seconds to add to the timeline's time to get the encoder's, within some 20 ms; ()."""
    alignment: Any
    """Rotation vector that turns the encoder's body frame into the model's, rad; (3,)."""
    reference: Any
    """Rotation vector that turns the encoder's reference frame into the tracker's, rad; (3,)."""
    origin: Any
    """Origin of the encoder in the tracker's reference frame, m; (3,)."""


TRUTH_UNITS = TruthFrame("s", "rad", "rad", "m")


def no_correction() -> TruthFrame:
    """The encoder as it is recorded."""
    return TruthFrame(jnp.zeros(()), jnp.zeros(3), jnp.zeros(3), jnp.zeros(3))


def corrected(frame: TruthFrame, name: str, value: Array, first: Array, second: Array) -> Array:
    """True attitude (w, x, y, z), body rate or position, corrected by a frame.

    `first` and `second` are the time derivatives (3,) of the recorded value; for an attitude its body rate
    and the derivative of that.
    """
    late = frame.clock_offset
    turn = rotation.exp(frame.alignment)
    if name == "attitude":
        moved = rotation.product(value, rotation.exp(late * first + 0.5 * late**2 * second))
        return rotation.product(
            rotation.product(rotation.exp(frame.reference), moved), rotation.conjugate(turn)
        )
    moved = value + late * first + 0.5 * late**2 * second
    if name == "rate":
        return rotation.rotate(turn, moved)
    return frame.origin + rotation.rotate(rotation.exp(frame.reference), moved)
