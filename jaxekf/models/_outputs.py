"""Outputs that several models share: position, attitude, velocity and angular rate of the body."""

from collections.abc import Callable
from functools import partial
from typing import Any

from jaxekf.filtering.interpolation import InputSample
from jaxekf.filtering.model import Output, Parameters
from jaxekf.geometry.manifold import SO3, Euclidean

METRES = Euclidean(3, "m", frame="reference")
RATE = Euclidean(3, "rad/s")
METRES_PER_SECOND = Euclidean(3, "m/s", frame="reference")


# Functions with names, so that a model can be pickled.
def _position(x: Any, u: Any, params: Parameters) -> Any:
    return x.position


def _attitude(x: Any, u: Any, params: Parameters) -> Any:
    return x.q_ref_body


def _velocity(x: Any, u: Any, params: Parameters) -> Any:
    return x.velocity


def rate_state(x: Any, u: Any, params: Parameters) -> Any:
    """The rate of a model that has it in its state."""
    return x.rate


def _of_reading(value: Callable[..., Any], x: Any, u: InputSample, params: Parameters) -> Any:
    return value(x, u.value, params)


POSITION = Output("position", METRES, "reference", _position)
ATTITUDE = Output("attitude", SO3(), "body", _attitude)
VELOCITY = Output("velocity", METRES_PER_SECOND, "reference", _velocity)


def rate(value: Callable[..., Any], noise: Callable[..., Any] | None = None) -> Output:
    """Angular rate ``value(x, u, params)`` (3,), rad/s, body frame.

    `noise` is the covariance (3, 3) by the input's own noise, ``noise(u, params)``.
    """
    return Output("rate", RATE, "body", value, noise)


def rate_of_reading(value: Callable[..., Any], noise: Callable[..., Any]) -> Output:
    """As `rate`, of the gyroscope's sample, ``value(x, sample, params)``."""
    return rate(partial(_of_reading, value), noise)
