"""The input of a step from a sampled input, differentiable in a clock offset of any size."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxekf.filtering.steps import Knots


class InputSample(NamedTuple):
    """The input of one step, as transition, sensors and outputs get it.

    Examples
    --------
    Half a turn in a second about z, by the transition of `loose`:

    >>> import jax.numpy as jnp
    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> rate = jnp.array([0.0, 0.0, jnp.pi])
    >>> u = jaxekf.InputSample(mean=rate, value=rate, bandwidth=0.0)
    >>> before = model.initial_mean({"optical": jnp.array([1.0, 0.0, 0.0, 0.0])})
    >>> after = model.transition(before, u, 1.0, jnp.zeros(6), model.parameters)
    >>> print(np.abs(after.q_ref_body).round(3))
    [0. 0. 0. 1.]
    """

    mean: Any
    """Mean of the linearly interpolated input over the step, (c,)."""
    value: Any
    """The interpolated input at the end of the step, (c,)."""
    bandwidth: Any
    """Hz: a white density ``d`` of the input puts the variance ``d**2 * bandwidth`` on `value`."""


def sample(
    knots: Knots, time: Array, dt: Array, shift: Callable[[Array], Array] = jnp.zeros_like
) -> InputSample:
    """The input over each ``[time - dt, time]`` of the timeline.

    The mean is the difference of the running integral at the two ends, divided by the time between them on
    the input's clock; it is continuously differentiable in the shift. Beyond the first and last knot the
    input is held.

    Parameters
    ----------
    knots
        The sampled input.
    time, dt
        (K, S) seconds.
    shift
        ``shift(time)``: seconds by which the input's clock is ahead of the timeline.

    Returns
    -------
    `InputSample`, leading axes (K, S).
    """
    late, early = shift(time), shift(time - dt)
    value, integral, bandwidth = _evaluate(knots, time + late)
    _, before, _ = _evaluate(knots, time - dt + early)
    moving = (dt > 0.0)[..., None]
    # Not the difference of the two end times: in a long run it has lost its last digits.
    step = jnp.where(moving, (dt + (late - early))[..., None], 1.0)
    return InputSample(jnp.where(moving, (integral - before) / step, value), value, bandwidth)


def _evaluate(knots: Knots, time: Array) -> tuple[Array, Array, Array]:
    """Value, running integral and noise bandwidth at `time`, any shape."""
    last = knots.time.shape[0] - 1
    lower = jnp.clip(jnp.searchsorted(knots.time, time, side="right") - 1, 0, last - 1)
    span = knots.time[lower + 1] - knots.time[lower]
    since = time - knots.time[lower]
    inside = jnp.clip(since, 0.0, span)
    beyond = (since - inside)[..., None]
    rise = (knots.value[lower + 1] - knots.value[lower]) / span[..., None]
    value = knots.value[lower] + rise * inside[..., None]
    mean = knots.value[lower] + 0.5 * rise * inside[..., None]
    integral = knots.integral[lower] + mean * inside[..., None] + value * beyond
    share = inside / span
    return value, integral, (share * share + (1.0 - share) * (1.0 - share)) / span
