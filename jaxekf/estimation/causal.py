"""What was known at each time: late measurements, as a system that runs live has them.

A tracker's frame is known some time after it was taken. The past is then updated where the frame belongs
and carried on to the present by the input (Tobergte, Pomarlan, Hirzinger 2009, section III.D). Offline
every measurement simply stands at its own time; `estimate_online` tells what the live system would have
said, and `jaxekf.estimation.live.Stream` is that system.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxekf._support.compilation import jit
from jaxekf._support.errors import ModelError
from jaxekf.estimation import timeline
from jaxekf.estimation.batch import (
    Run,
    estimate_many,
    evaluate_outputs,
    named_outputs,
    read,
    sharing_devices,
)
from jaxekf.estimation.result import Estimate
from jaxekf.estimation.timeline import Timeline
from jaxekf.filtering import ekf
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Knots, Steps
from jaxekf.models import REGISTRY, get_model
from jaxekf.recordings.types import NANOSECONDS, Times, period_ns

_EPOCHS_AT_ONCE = 2048


class Outlook(NamedTuple):
    """From the end of each epoch (E of them) the instants at which its belief was the latest known."""

    steps: Steps
    """(E, A, 1) without samples and input: times since the start of the run."""
    time_ns: Times
    """(E, A)."""
    wanted: NDArray[np.bool_]
    """(E, A) where the belief, carried on to that instant, is what was known then."""
    knots: NDArray[np.intp]
    """(E, W) the input's knots that are needed."""

    def starting(self, first: int) -> "Outlook":
        """Of the epochs from `first` on."""
        steps = jax.tree.map(lambda a: a[first:], self.steps)
        return Outlook(steps, self.time_ns[first:], self.wanted[first:], self.knots[first:])

    def with_input(self, knots: Knots) -> Steps:
        """The steps with their windows of the run's input; also under `vmap` of `knots`."""
        return self.steps._replace(knots=jax.tree.map(lambda a: a[self.knots], knots))


def outlook(line: Timeline, latency_ns: int, shift_s: float = 0.0) -> Outlook:
    """Where the belief after each epoch of a timeline has to be carried on to.

    The belief at time s is known from ``s + latency_ns`` on until the next is; it is told at every sample
    of the input in between. `shift_s` is the most that the input's clock is off. The input is taken as
    known up to the instant it is asked at: with a latency shorter than the input's period use `Stream`.
    """
    if line.steps.knots is None:
        raise ModelError(
            f"run '{line.name}': got a model without input, expected one to carry beliefs on by; take"
            " the ordinary estimate, which only looks back"
        )
    start = int(line.time_ns[0, -1]) - round(float(line.steps.time[0, -1]) * NANOSECONDS)
    samples = start + np.round(np.asarray(line.steps.knots.time) * NANOSECONDS).astype(np.int64)
    taken = line.time_ns[:, -1]
    known = taken + latency_ns
    until = np.append(known[1:], samples[-1] + 1)
    low, high = np.searchsorted(samples, taken), np.searchsorted(samples, until)
    count = np.maximum(high - low, 0)
    ahead = max(1, int(count.max()))
    at = low[:, None] + np.arange(ahead)
    valid = np.arange(ahead) < count[:, None]
    last = samples[np.clip(high - 1, 0, len(samples) - 1)]
    times = np.where(valid, samples[np.minimum(at, len(samples) - 1)], last[:, None])
    times = np.maximum(times, taken[:, None])
    dt = np.diff(times, axis=1, prepend=taken[:, None]) / NANOSECONDS
    period = max(1, period_ns(samples))
    more = 2 + int(np.ceil(abs(shift_s) * NANOSECONDS / period))
    width = min(len(samples), ahead + 2 * more)
    window = np.clip(low - more, 0, len(samples) - width)[:, None] + np.arange(width)
    steps = Steps(
        ((times - start) / NANOSECONDS)[..., None], dt[..., None], valid[..., None], None, {}, {}
    )
    return Outlook(steps, times, valid & (times >= known[:, None]), window)


def carry_on(
    model: Model, params: Parameters, beliefs: Belief, steps: Steps, keep: ekf.Keep = "estimates"
) -> ekf.FilterOutput:
    """Beliefs (E, ...) carried on over `Outlook.with_input`'s steps; `params` for each of them."""
    return ekf.run_filter_batch(model, params, beliefs, steps, keep=keep, devices=sharing_devices())


@partial(jit, static_argnums=0)
def _told(model: Model, params: Parameters, beliefs: Belief, steps: Steps) -> Any:
    count = steps.dt.shape[0]
    every = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *jnp.shape(a))), params)
    output = carry_on(model, every, beliefs, steps)
    return output.instants.updated, evaluate_outputs(model, every, output)


def estimate_online(
    run: Run, model: str | Model = "tight", params: Parameters | None = None
) -> Estimate:
    """As `jaxekf.estimate`, but at each sample of the input only with what had arrived by then.

    It begins when the first measurement has arrived. Raises what `estimate` raises, and `ModelError` for
    a model without input or sensors whose latencies differ (use `Stream`).
    """
    recording = read([run])[0]
    _need_input(get_model(model))
    made = estimate_many([recording], model, params)[0]
    line = timeline.build(made.model, recording)
    latency = set(line.latency_ns.values())
    if len(latency) != 1:
        raise ModelError(
            f"run '{line.name}': got sensors with latencies of {sorted(line.latency_ns.items())} ns,"
            " expected one for all; feed a jaxekf.Stream instead"
        )
    chosen, late = made.model, latency.pop()
    shift = 0.0
    if chosen.input is not None:
        shift = float(
            jnp.max(jnp.abs(chosen.input.shift(made.params, jnp.asarray(line.steps.time))))
        )
    view = outlook(line, late, shift)
    at = np.searchsorted(made.time_ns, line.time_ns[:, -1])
    beliefs = Belief(jax.tree.map(lambda a: a[at], made.state), jnp.asarray(made.cov[at]))
    told = _in_parts(chosen, made.params, beliefs, view.with_input(_knots(line)))
    belief, outputs = jax.tree.map(lambda a: a[:, :, 0][view.wanted], told)
    return replace(
        made,
        time_ns=view.time_ns[view.wanted],
        state=belief.mean,
        cov=belief.cov,
        outputs=named_outputs(chosen, outputs),
        online=True,
        notes=(*made.notes, f"what was known at each time, measurements {late / 1e6:g} ms late"),
    )


def _need_input(model: Model) -> None:
    """Raise for a model that has nothing to carry it on to the present, before it is run."""
    if model.input is None:
        driven = ", ".join(name for name, other in REGISTRY.items() if other.input is not None)
        raise ModelError(
            f"got the model '{model.name}' without input, expected one that its input carries on to the"
            f" present ({driven}); try one of these, or the estimate that is not online"
        )


def _knots(line: Timeline) -> Knots:
    assert line.steps.knots is not None  # `outlook` has refused a line without
    return line.steps.knots


def _in_parts(model: Model, params: Parameters, beliefs: Belief, steps: Steps) -> Any:
    """`_told` of a few thousand epochs at a time, so that memory is bounded."""
    count = steps.dt.shape[0]
    size = min(count, _EPOCHS_AT_ONCE)
    parts = []
    for start in range(0, count, size):
        # The last part is filled with the last epoch: another size would be another program.
        index = np.minimum(np.arange(start, start + size), count - 1)
        given = jax.tree.map(lambda a, index=index: np.asarray(a)[index], (beliefs, steps))
        found = jax.tree.map(np.asarray, _told(model, params, *given))
        parts.append(jax.tree.map(lambda a, s=start: a[: min(size, count - s)], found))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)
