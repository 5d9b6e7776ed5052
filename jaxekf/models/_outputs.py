"""Outputs that several models share: position, attitude, velocity and angular rate of the body."""

from collections.abc import Callable
from typing import Any

from jaxekf.filtering.model import Output
from jaxekf.geometry.manifold import SO3, Euclidean

METRES = Euclidean(3, "m", frame="reference")
RATE = Euclidean(3, "rad/s")
METRES_PER_SECOND = Euclidean(3, "m/s", frame="reference")

POSITION = Output("position", METRES, "reference", lambda x, u, params: x.position)
ATTITUDE = Output("attitude", SO3(), "body", lambda x, u, params: x.q_ref_body)
VELOCITY = Output("velocity", METRES_PER_SECOND, "reference", lambda x, u, params: x.velocity)


def rate(value: Callable[..., Any], noise: Callable[..., Any] | None = None) -> Output:
    """Angular rate ``value(x, u, params)`` (3,), rad/s, body frame.

    `noise` is the covariance (3, 3) by the input's own noise, ``noise(u, params)``.
    """
    return Output("rate", RATE, "body", value, noise)
