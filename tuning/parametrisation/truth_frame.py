"""How an encoder lies to the tracker it judges: clock, frames and origin, as parameters with a gradient.

An encoder has its own clock and its own frames. Where they are not known they are found with the rest, so
that an estimate is not blamed, nor bent, for what is wrong with its truth. What was found so is told apart:
a frame fitted to truth flatters an error that is then counted against it.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxekf.geometry import rotation


class TruthFrame(NamedTuple):
    """Corrections of an encoder, zero where it is right."""

    clock_offset: Any
    """Seconds to add to the timeline's time to get the encoder's, within some 20 ms; ()."""
    alignment: Any
    """Rotation vector that turns the encoder's body frame into the model's, rad; (3,)."""
    reference: Any
    """Rotation vector that turns the encoder's reference frame into the tracker's, rad; (3,)."""
    origin: Any
    """Where the encoder's origin is in the tracker's reference frame, m; (3,)."""


TRUTH_UNITS = TruthFrame("s", "rad", "rad", "m")


def no_correction() -> TruthFrame:
    """The encoder as it is recorded."""
    return TruthFrame(jnp.zeros(()), jnp.zeros(3), jnp.zeros(3), jnp.zeros(3))


def corrected(frame: TruthFrame, name: str, value: Array, first: Array, second: Array) -> Array:
    """True attitude (w, x, y, z), body rate or position as it is by this frame.

    `first` and `second` are the derivatives (3,) of the recorded one by time: of an attitude its body rate
    and that one's derivative.
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
