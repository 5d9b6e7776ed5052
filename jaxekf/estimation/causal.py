"""Causal estimates with late measurements: at each time only the measurements that had arrived are used.

A tracker's frame arrives some time after it was taken. The belief at the time of the frame is then updated,
and extrapolated to the present by the input (Tobergte, Pomarlan, Hirzinger 2009, section III.D).
`estimate_online` computes from a recording the estimates of such a live system; the live system itself is
`jaxekf.estimation.live.Stream`.
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
from jaxekf.estimation._assembly import named_outputs, on_clock
from jaxekf.estimation.batch import (
    Run,
    estimate_many,
    evaluate_outputs,
    read,
    sharing_devices,
)
from jaxekf.estimation.clock import ClockName, clock_of
from jaxekf.estimation.result import Estimate
from jaxekf.estimation.timeline import Timeline
from jaxekf.filtering import ekf
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Knots, Steps
from jaxekf.models import REGISTRY, get_model
from jaxekf.recordings.types import NANOSECONDS, Times, period_ns

_EPOCHS_AT_ONCE = 2048


class Extrapolation(NamedTuple):
    """For each of E epochs the A instants at which the belief at its end was the latest available one."""

    steps: Steps
    """(E, A, 1) prediction steps without samples and input; times since the start of the run."""
    time_ns: Times
    """(E, A)."""
    latest: NDArray[np.bool_]
    """(E, A) whether the extrapolated belief is the latest one available at that instant."""
    knots: NDArray[np.intp]
    """(E, W) indices of the input's knots that the steps need."""

    def from_epoch(self, first: int) -> "Extrapolation":
        """The same for the epochs from `first` on."""
        steps = jax.tree.map(lambda a: a[first:], self.steps)
        return Extrapolation(steps, self.time_ns[first:], self.latest[first:], self.knots[first:])

    def with_input(self, knots: Knots) -> Steps:
        """The steps with the input that they need; may be used under `vmap` of `knots`."""
        return self.steps._replace(knots=jax.tree.map(lambda a: a[self.knots], knots))


def plan_extrapolation(line: Timeline, latency_ns: int, shift_s: float = 0.0) -> Extrapolation:
    """The instants to which the belief after each epoch of a timeline is extrapolated.

    The belief at time s is available from ``s + latency_ns`` until the next one is; it is extrapolated to
    every sample of the input in between. The input is assumed to have no latency: for a tracker latency
    shorter than the input's period use `Stream`.

    Parameters
    ----------
    line
        The timeline of a model with an input.
    latency_ns
        Latency of the measurements.
    shift_s
        Largest absolute clock offset of the input, s.

    Raises
    ------
    ModelError
        The model has no input.
    """
    if line.steps.knots is None:
        raise ModelError(
            f"run '{line.name}': got a model without input, expected one to extrapolate by; use"
            " jaxekf.estimate, which does not extrapolate"
        )
    start = int(line.time_ns[0, -1]) - round(float(line.steps.time[0, -1]) * NANOSECONDS)
    samples = start + np.round(np.asarray(line.steps.knots.time) * NANOSECONDS).astype(np.int64)
    samples = line.clock.tracker_from_imu(samples)
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
    return Extrapolation(steps, times, valid & (times >= known[:, None]), window)


def extrapolate(
    model: Model, params: Parameters, beliefs: Belief, steps: Steps, keep: ekf.Keep = "estimates"
) -> ekf.FilterOutput:
    """Extrapolate beliefs (E, ...) over the steps of `Extrapolation.with_input`; `params` (E, ...)."""
    return ekf.run_filter_batch(model, params, beliefs, steps, keep=keep, devices=sharing_devices())


@partial(jit, static_argnums=0)
def _extrapolated_outputs(model: Model, params: Parameters, beliefs: Belief, steps: Steps) -> Any:
    count = steps.dt.shape[0]
    every = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *jnp.shape(a))), params)
    output = extrapolate(model, every, beliefs, steps)
    return output.instants.updated, evaluate_outputs(model, every, output)


def estimate_online(
    run: Run,
    model: str | Model = "tight",
    params: Parameters | None = None,
    *,
    clock: ClockName = "imu",
) -> Estimate:
    """Estimate one run as a live system: at each input sample only with measurements that had arrived.

    Parameters
    ----------
    run
        A `Recording`, or the path of a run folder.
    model
        Name of a model with an input, ``module:attribute``, or a `Model`.
    params
        As in `jaxekf.estimate`.
    clock
        As in `jaxekf.estimate`.

    Returns
    -------
    Estimate
        At the samples of the input, from the arrival of the first measurement on.

    Raises
    ------
    ModelError
        The model has no input, or its sensors have different latencies (then use `Stream`).
    RecordingError, FilterError, ResourceError, PrecisionError
        As in `jaxekf.estimate`.

    Examples
    --------
    The tracker's samples arrive 48 ms after they were taken:

    >>> from dataclasses import replace
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> optical = run.need_optical()
    >>> stamps = optical.time_ns + 48_000_000
    >>> run = run.replace(optical=replace(optical, time_ns=stamps, latency_ns=48_000_000))
    >>> live, after = jaxekf.estimate_online(run, "loose"), jaxekf.estimate(run, "loose")
    >>> print(f"first estimate after {(live.time_ns[0] - after.time_ns[0]) / 1e6:.0f} ms")
    first estimate after 48 ms
    >>> bool(jaxekf.score(live, run).attitude_rmse_deg > jaxekf.score(after, run).attitude_rmse_deg)
    True
    """
    recording = read([run])[0]
    _need_input(get_model(model))
    filtered = estimate_many([recording], model, params, clock="tracker")[0]
    known = clock_of(filtered.model, filtered.params, clock)
    line = timeline.build(filtered.model, recording, clock=known)
    latency = set(line.latency_ns.values())
    if len(latency) != 1:
        raise ModelError(
            f"run '{line.name}': got sensors with latencies of {sorted(line.latency_ns.items())} ns,"
            " expected the same for all; use a jaxekf.Stream instead"
        )
    chosen, late = filtered.model, latency.pop()
    shift = 0.0
    if chosen.input is not None:
        shift = float(
            jnp.max(jnp.abs(chosen.input.shift(filtered.params, jnp.asarray(line.steps.time))))
        )
    view = plan_extrapolation(line, late, shift)
    at = np.searchsorted(filtered.time_ns, line.time_ns[:, -1])
    beliefs = Belief(jax.tree.map(lambda a: a[at], filtered.state), jnp.asarray(filtered.cov[at]))
    extrapolated = _extrapolate_in_batches(
        chosen, filtered.params, beliefs, view.with_input(_knots(line))
    )
    belief, outputs = jax.tree.map(lambda a: a[:, :, 0][view.latest], extrapolated)
    made = replace(
        filtered,
        time_ns=view.time_ns[view.latest],
        state=belief.mean,
        cov=belief.cov,
        outputs=named_outputs(chosen, outputs),
        online=True,
        notes=(
            *filtered.notes,
            f"causal: only measurements that had arrived, {late / 1e6:g} ms late",
        ),
    )
    return on_clock(made, line)


def _need_input(model: Model) -> None:
    """Raise `ModelError` for a model without input, before it is run."""
    if model.input is None:
        driven = ", ".join(name for name, other in REGISTRY.items() if other.input is not None)
        raise ModelError(
            f"got the model '{model.name}' without input, expected one with an input to extrapolate by"
            f" ({driven}); use one of these, or the estimate that is not online"
        )


def _knots(line: Timeline) -> Knots:
    assert line.steps.knots is not None  # `plan_extrapolation` has raised for a timeline without
    return line.steps.knots


def _extrapolate_in_batches(model: Model, params: Parameters, beliefs: Belief, steps: Steps) -> Any:
    """`_extrapolated_outputs` in batches of epochs, so that memory is bounded."""
    count = steps.dt.shape[0]
    size = min(count, _EPOCHS_AT_ONCE)
    parts = []
    for start in range(0, count, size):
        # The last epoch fills up the last batch, since another size would need another program.
        index = np.minimum(np.arange(start, start + size), count - 1)
        given = jax.tree.map(lambda a, index=index: np.asarray(a)[index], (beliefs, steps))
        batch = jax.tree.map(np.asarray, _extrapolated_outputs(model, params, *given))
        parts.append(jax.tree.map(lambda a, s=start: a[: min(size, count - s)], batch))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)
