"""Runs with truth as arrays that stay on the device while the tuner works."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxekf._support.compilation import require_float64
from jaxekf._support.errors import TuningError
from jaxekf.estimation import padding, timeline
from jaxekf.estimation.batch import Run, read
from jaxekf.estimation.timeline import Timeline
from jaxekf.filtering.model import Model
from jaxekf.filtering.steps import Steps
from jaxekf.recordings.truth import encoder_at, encoder_rate_at, encoder_velocity_at
from jaxekf.recordings.types import NANOSECONDS, Encoder, Floats, Recording, Times

_SLOPE_NS = 10_000_000


class Truth(NamedTuple):
    """True values of an output, and the instants at which they are known and judged."""

    value: Any
    """(runs, K, S, ...) in the output's space."""
    judged: Any
    """(runs, K, S)."""
    first: Any
    """(runs, K, S, 3) derivative by time; the body rate for an attitude."""
    second: Any
    """(runs, K, S, 3) derivative of `first`."""


class Data(NamedTuple):
    """Several runs, padded to one length, on the first axis.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> data = tuning.prepare(jaxekf.get_model("loose"), jaxekf.demo.paths(("free-1", "free-2")))
    >>> data.truth["attitude"].value.shape  # runs, epochs, substeps, w x y z
    (2, 1536, 2, 4)
    >>> data.place.tolist()
    [0, 1]
    """

    means: Any
    """Initial mean of each run."""
    setup: Any
    """`Parameters.setup` of each run."""
    steps: Steps
    """Time steps and measurements, leading axes (runs, K, S)."""
    truth: dict[str, Truth]
    """Truth of each output by its name; empty for a model without any of them."""
    counted: Any
    """(runs, K, S) instants past the burn-in, at which the likelihood counts."""
    place: Any
    """(runs,) index of each run among all that were given."""


def prepare(
    model: Model, runs: Sequence[Run], *, burn_in_s: float = 0.0, need_truth: bool = True
) -> Data:
    """Timelines, initial means and truth of runs, stacked and padded to one length.

    Parameters
    ----------
    model
        The model.
    runs
        Recordings or paths of runs.
    burn_in_s
        Seconds at the start of each run that do not count.
    need_truth
        Whether at least one run must have an encoder.

    Raises
    ------
    TuningError
        Without any run, or if truth is needed and none is scored.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> data = tuning.prepare(model, jaxekf.demo.paths(("free-1", "free-2")), burn_in_s=2.0)
    >>> data.counted.shape  # runs, epochs, substeps
    (2, 1536, 2)
    >>> sorted(data.truth)
    ['attitude', 'rate']
    """
    recordings, lines = _read(model, runs)
    data = _stack(model, recordings, lines, burn_in_s, range(len(lines)))
    _check([data], recordings, burn_in_s, need_truth)
    return data


def prepare_groups(
    model: Model, runs: Sequence[Run], *, burn_in_s: float = 0.0, need_truth: bool = True
) -> tuple[Data, ...]:
    """As `prepare`, but runs of like length together: a short run is not padded to the longest."""
    recordings, lines = _read(model, runs)
    found = []
    for members in padding.groups(lines):
        chosen = [recordings[i] for i in members], [lines[i] for i in members]
        found.append(_stack(model, *chosen, burn_in_s, members))
    _check(found, recordings, burn_in_s, need_truth)
    return tuple(found)


def _read(model: Model, runs: Sequence[Run]) -> tuple[list[Recording], list[Timeline]]:
    require_float64()
    if not runs:
        raise TuningError("got no run to tune on, expected at least one; name some recordings")
    recordings = read(runs)
    return recordings, timeline.build_many(model, recordings)


def _check(
    found: Sequence[Data], recordings: Sequence[Recording], burn_in_s: float, need_truth: bool
) -> None:
    plain = [on_host(data) for data in found]
    if not any(bool(data.counted.any()) for data in plain):
        raise TuningError(
            f"got no instant after a burn-in of {burn_in_s} s, expected some; ask for a shorter one"
        )
    if need_truth and not any(bool(t.judged.any()) for data in plain for t in data.truth.values()):
        raise TuningError(
            f"got no scored encoder sample in {[r.name for r in recordings]}, expected some to"
            " compare with; add encoder.csv or tune by likelihood"
        )


def _stack(
    model: Model,
    recordings: Sequence[Recording],
    lines: Sequence[Timeline],
    burn_in_s: float,
    place: Sequence[int],
) -> Data:
    steps = padding.bucketed(lines)
    starts = [(model.initial_mean(line.first), line.setup) for line in lines]
    shape = steps.dt.shape
    names = [out.name for out in model.outputs if out.name in ("attitude", "rate", "position")]
    truth = {
        name: Truth(
            _blank(name, shape), np.zeros(shape, bool), np.zeros((*shape, 3)), np.zeros((*shape, 3))
        )
        for name in names
    }
    counted = np.zeros(shape, bool)
    for i, (recording, line) in enumerate(zip(recordings, lines, strict=True)):
        at = np.s_[i, : line.time_ns.shape[0], shape[2] - line.time_ns.shape[1] :]
        settled = (np.asarray(line.steps.time) >= burn_in_s) & line.valid
        counted[at] = settled
        if recording.encoder is None:
            continue
        for name, known in _truth(recording, line).items():
            if name in truth:
                truth[name].value[at] = known.value
                truth[name].judged[at] = known.judged & settled
                truth[name].first[at] = known.first
                truth[name].second[at] = known.second
    means, setup = jax.tree.map(lambda *leaves: np.stack(leaves), *starts)
    found = Data(means, setup, steps, truth, counted, np.array(place))
    # `jnp.asarray` would compile a program for each shape there is.
    return jax.tree.map(lambda a: jax.device_put(np.asarray(a)), found)


def on_host(data: Data) -> Data:
    """The data as NumPy arrays, to count in without compiling anything."""
    return jax.tree.map(np.asarray, data)


def _blank(name: str, shape: tuple[int, ...]) -> Any:
    """Truth before it is filled in: no turn, no rate, the origin."""
    if name != "attitude":
        return np.zeros((*shape, 3))
    blank = np.zeros((*shape, 4))
    blank[..., 0] = 1.0
    return blank


def _truth(recording: Recording, line: Timeline) -> dict[str, Truth]:
    """True attitude, rate and position at every instant of a timeline, and the instants that have them."""
    flat = line.time_ns.reshape(-1)
    encoder = recording.need_encoder()
    at = encoder_at(encoder, flat)
    rate = encoder_rate_at(encoder, flat)
    known = np.isfinite(rate).all(axis=1) & at.scored
    jerk = _slope(encoder, flat, encoder_rate_at)
    shape = line.time_ns.shape

    def shaped(values: Any) -> Any:
        return np.nan_to_num(values).reshape(*shape, values.shape[1])

    found = {
        "attitude": Truth(
            shaped(at.q_ref_body), at.scored.reshape(shape), shaped(rate), shaped(jerk)
        ),
        # Further derivatives would be mostly noise.
        "rate": Truth(shaped(rate), known.reshape(shape), shaped(jerk), np.zeros((*shape, 3))),
    }
    if at.position is not None:
        there = np.isfinite(at.position).all(axis=1) & at.scored
        speed = encoder_velocity_at(encoder, flat)
        found["position"] = Truth(
            shaped(at.position),
            there.reshape(shape),
            shaped(speed),
            shaped(_slope(encoder, flat, encoder_velocity_at)),
        )
    return found


def _slope(encoder: Encoder, time_ns: Times, of: Callable[[Encoder, Times], Floats]) -> Floats:
    """Derivative (N, 3) of a function of encoder and time, by central differences."""
    half = _SLOPE_NS
    return (of(encoder, time_ns + half) - of(encoder, time_ns - half)) / (2 * half / NANOSECONDS)
