"""Asynchronous streams merged into one sequence of steps, with exact times.

The steps form *epochs* of a fixed number of substeps. A fast sensor may have a sample at every substep, a
slow one (a tracker beside a gyroscope) only at the last substep of an epoch, so that its update is not
computed at every fast step. Epochs that are not full are padded **in front** with substeps of ``dt = 0``,
which have no effect. A missing sample is masked, never held.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.estimation._excess_rotation import excess_rotation
from jaxekf.estimation._run_samples import check_input, extrapolation_notes, read_sensor
from jaxekf.estimation._step_layout import arrange, epochs_of, slow_sensors
from jaxekf.estimation.clock import Clock
from jaxekf.estimation.output_times import OutputTimes, select_output_times
from jaxekf.filtering.model import Model, Start
from jaxekf.filtering.steps import Knots, Steps
from jaxekf.recordings.sample_selection import (
    count,
    cut,
    first_visible,
    hold,
    of_rows,
    visible,
)
from jaxekf.recordings.types import NANOSECONDS, Recording, Samples, Times


@dataclass(frozen=True)
class Timeline:
    """The steps of one run, with the data that stays on the host.

    Examples
    --------
    Two samples of the gyroscope for one of the tracker make epochs of two substeps:

    >>> import jaxekf
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> line = jaxekf.timeline.build(jaxekf.get_model("loose"), run)
    >>> line.time_ns.shape, list(line.first), int(line.valid.sum())
    ((1501, 2), ['optical'], 3001)
    >>> line.account["optical"]["fed"], line.account["optical"]["masked"]
    (1272, 229)
    """

    name: str
    """Name of the run."""
    steps: Steps
    """The inputs of the filter, leading axes (K, S)."""
    time_ns: Times
    """(K, S) int64 nanoseconds at the end of each substep, on the tracker's clock."""
    first: dict[str, Any]
    """First visible sample of each sensor."""
    account: dict[str, dict[str, int]] = field(default_factory=dict)
    """For each stream the number of rows read, passed to the filter (``fed``), masked and dropped."""
    notes: tuple[str, ...] = ()
    """Notes for the user, such as the part of the run that is extrapolated."""
    setup: Any = ()
    """`Parameters.setup` of this run."""
    latency_ns: dict[str, int] = field(default_factory=dict)
    """Latency of each sensor: from the time a sample is taken to the time it is known."""
    requested_ns: Times | None = None
    """(N,) requested output times, a subset of `time_ns`; None without a request."""
    measured_ns: Times | None = None
    """(M,) instants of the measurements, if there are output times; None without a request."""
    clock: Clock = field(default_factory=Clock)
    """The clock of the estimate, and what the tracker's differs from it."""
    exact_ns: tuple[Times, Times] | None = None
    """Instants whose time on the IMU's clock is known to the nanosecond, and that time; None if no clock
    differs."""

    def on_clock(self, time_ns: Times) -> Times:
        """Instants of the timeline on the clock of the estimate."""
        if self.clock.name != "imu" or self.exact_ns is None:
            return time_ns
        instants, exact = self.exact_ns
        at = np.clip(np.searchsorted(instants, time_ns), 0, len(instants) - 1)
        moved = np.where(instants[at] == time_ns, exact[at], self.clock.from_tracker(time_ns))
        # Instants a nanosecond apart must not become one.
        count = np.arange(len(moved))
        return np.maximum.accumulate(moved - count) + count

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(K, S) substeps that are not padding."""
        return np.asarray(self.steps.valid)


def build(
    model: Model,
    recording: Recording,
    slow: tuple[str, ...] | None = None,
    at: OutputTimes | None = None,
    clock: Clock | None = None,
) -> Timeline:
    """The timeline of one recording for one model.

    It is on the tracker's clock; the IMU's samples have their place on it by `clock`.

    Parameters
    ----------
    model
        The model; it chooses streams and start.
    recording
        The run.
    slow
        Names of the sensors that are sampled only at the ends of epochs; None chooses them by their rates.
    at
        Output times, (N,) int64 nanoseconds or a grid, added as instants without samples, on the clock of
        the estimate. Times outside the run are left out, with a note.
    clock
        The clock of the estimate, by `jaxekf.estimation.clock.clock_of`; None takes all stamps for those of
        one clock.

    Returns
    -------
    Timeline
        Steps with leading axes (K, S): epochs and substeps.

    Raises
    ------
    RecordingError
        A stream is missing, streams do not overlap, the model cannot start, or no output time is within
        the run.
    ModelError
        A sensor has no source, or `at` is given for a model whose steps are the samples of one stream
        (`Model.hold_to`).

    Examples
    --------
    >>> import jaxekf
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> model = jaxekf.get_model("loose")
    >>> jaxekf.timeline.build(model, run).steps.dt.shape
    (1501, 2)
    >>> jaxekf.timeline.build(model, run, at=jaxekf.every(0.01)).requested_ns.shape
    (2401,)
    """
    samples = {s.name: read_sensor(s, recording) for s in model.sensors}
    driver, counted, clock = None, dict(samples), clock or Clock()
    if model.input is not None:
        counted[model.input.name] = raw = model.input.source(recording)
        driver = check_input(raw, recording, model.input.name)
        clock = clock.starting_with(int(driver.time_ns[0]))
    start, end, start_sample = _run_interval(model, recording, samples, driver, clock)
    clock = replace(clock, start_ns=start)
    if model.input is not None:
        raw = counted[model.input.name]
        counted[model.input.name] = replace(raw, time_ns=clock.tracker_from_imu(raw.time_ns))
    account = {
        name: of_rows(count(stream, start, end), stream, recording.intake, start, end)
        for name, stream in counted.items()
    }
    samples = _cut_to_run(model, recording, samples, start, end)
    if model.hold_to is not None:
        samples = hold(samples, model.hold_to, account)
    events = [stream.time_ns for stream in samples.values()]
    exact = placed = None
    if driver is not None:
        placed = clock.tracker_from_imu(driver.time_ns)
        inside = (placed >= start) & (placed <= end)
        events.append(placed[inside])
        exact = placed[inside], driver.time_ns[inside]
    notes = (start_sample.note,) if start_sample is not None and start_sample.note else ()
    if part := recording.info.get("part"):
        notes = (f"part {part}", *notes)
    if driver is None and model.hold_to is None:
        notes += extrapolation_notes(samples, start)
    requested = measured = None
    if at is not None and model.hold_to is not None:
        raise ModelError(
            f"model '{model.name}' got times to estimate at, expected none because its steps are the"
            f" samples of {model.hold_to}, and more steps would change it; use another model, such as loose"
        )
    if at is not None:
        first, last = clock.from_tracker(np.array([start, end])).tolist()
        asked, note = select_output_times(at, first, last, recording.path or recording.name)
        requested = asked
        if clock.name == "imu":
            requested = np.clip(clock.tracker_from_imu(asked), start, end)
            exact = _joined(exact, (requested, asked))
        measured = np.unique(np.concatenate([*events, np.array([start], np.int64)]))
        events.append(requested)
        notes += (note,) if note else ()
    times = np.unique(np.concatenate([*events, np.array([start], np.int64)]))
    if slow is None:
        slow = slow_sensors(samples, times)
    index = epochs_of(times, [samples[name].time_ns for name in slow])
    steps, step_times = arrange(times, index, samples, slow, start)
    if driver is not None:
        steps = steps._replace(knots=knots_from(driver.time_ns, driver.value, start))
    rate = None if driver is None else replace(driver, time_ns=placed)
    excess, beyond = excess_rotation(model.space, rate, samples, step_times, steps.dt)
    steps, notes = steps._replace(excess=excess), (*notes, *beyond)
    if start_sample is None:
        start_sample = Start(start, {name: first_visible(s) for name, s in samples.items()})
    latency = {name: stream.latency_ns for name, stream in samples.items()}
    setup = model.parameters.setup if model.setup is None else model.setup(recording)
    return Timeline(
        recording.name,
        steps,
        step_times,
        start_sample.first,
        account,
        notes,
        setup,
        latency,
        requested,
        measured,
        clock,
        exact,
    )


def _joined(exact: tuple[Times, Times] | None, more: tuple[Times, Times]) -> tuple[Times, Times]:
    """Instants with their exact times, each once, `more` before `exact`."""
    both = (
        more if exact is None else tuple(np.concatenate(p) for p in zip(more, exact, strict=True))
    )
    instants, first = np.unique(both[0], return_index=True)
    return instants, both[1][first]


def _cut_to_run(
    model: Model, recording: Recording, samples: dict[str, Samples], start: int, end: int
) -> dict[str, Samples]:
    """The samples from start to end of the run, at least one of each sensor."""
    samples = {name: cut(stream, start, end) for name, stream in samples.items()}
    for name, stream in samples.items():
        if len(stream.time_ns) == 0:
            raise RecordingError(
                recording.path or recording.name,
                f"no sample of {name} from {start / NANOSECONDS:.6f} to {end / NANOSECONDS:.6f} s, the"
                f" interval that model '{model.name}' estimates",
                "at least one",
                "streams that overlap, or a model without that sensor",
            )
    return samples


def build_many(
    model: Model,
    recordings: Sequence[Recording],
    at: Sequence[OutputTimes | None] | None = None,
    clocks: Sequence[Clock] | None = None,
) -> list[Timeline]:
    """Timelines of several recordings, with the same slow sensors so that they can be stacked.

    Parameters
    ----------
    model, recordings
        As in `build`.
    at
        Output times of each recording, None for one without.
    clocks
        The clock of each estimate; None takes all stamps of a run for those of one clock.

    Returns
    -------
    list of Timeline
        In the order of `recordings`.

    Raises
    ------
    RecordingError, ModelError
        As in `build`.

    Examples
    --------
    >>> import jaxekf
    >>> runs = [jaxekf.load(path) for path in jaxekf.demo.paths(("free-4", "free-5"))]
    >>> lines = jaxekf.timeline.build_many(jaxekf.get_model("loose"), runs)
    >>> [(line.name, line.steps.dt.shape) for line in lines]
    [('free-4', (1501, 2)), ('free-5', (1501, 2))]
    """
    timelines: list[Timeline] = []
    at = [None] * len(recordings) if at is None else at
    clocks = [Clock()] * len(recordings) if clocks is None else clocks
    for recording, requested, clock in zip(recordings, at, clocks, strict=True):
        slow = tuple(timelines[0].steps.slow) if timelines else None
        timelines.append(build(model, recording, slow, requested, clock))
    return timelines


def from_steps(name: str, steps: Steps, first: dict[str, Any], start_ns: int = 0) -> Timeline:
    """A timeline from arrays instead of a recording.

    Parameters
    ----------
    name
        Name of the run.
    steps
        Steps with leading axes (K, S); ``time`` in seconds since `start_ns`.
    first
        First visible sample of each sensor, for the initial state.
    start_ns
        Time of the start, int64 nanoseconds.

    Returns
    -------
    Timeline
        Without account and notes.

    Examples
    --------
    Two epochs of one substep each, without samples and input, from 1 s on:

    >>> import numpy as np
    >>> import jaxekf
    >>> steps = jaxekf.Steps(
    ...     time=np.array([[0.0], [0.5]]),
    ...     dt=np.array([[0.0], [0.5]]),
    ...     valid=np.ones((2, 1), bool),
    ...     knots=None,
    ...     fast={},
    ...     slow={},
    ... )
    >>> jaxekf.timeline.from_steps("simulated", steps, {}, 1_000_000_000).time_ns.ravel()
    array([1000000000, 1500000000])
    """
    time_ns = start_ns + np.round(np.asarray(steps.time) * NANOSECONDS).astype(np.int64)
    return Timeline(name, steps, time_ns, first)


def _describe(times: Times) -> str:
    return f"{times[0] / NANOSECONDS:.6f} to {times[-1] / NANOSECONDS:.6f} s"


def _run_interval(
    model: Model,
    recording: Recording,
    samples: dict[str, Samples],
    driver: Samples | None,
    clock: Clock,
) -> tuple[int, int, Start | None]:
    """First and last time of the run, and the start that the model found.

    The run begins with the first usable samples and ends with the input or the last sample.
    """
    place = recording.path or recording.name
    start = min(int(s.time_ns[0]) for s in samples.values())
    end = max(int(s.time_ns[-1]) for s in samples.values())
    if driver is not None:
        times = clock.tracker_from_imu(driver.time_ns)
        for name, stream in samples.items():
            _need_overlap(place, name, stream.time_ns, "the input", times)
        start, end = int(times[0]), int(times[-1])
    elif model.hold_to is None:
        first, *others = samples
        for other in others:
            _need_overlap(place, first, samples[first].time_ns, other, samples[other].time_ns)
    for name in model.start_with:
        stream = samples[name]
        seen = stream.time_ns[visible(stream) & (stream.time_ns >= start)]
        if seen.size == 0 or seen[0] > end:
            raise RecordingError(
                place,
                f"no visible sample of {name} within the run",
                "at least one to start from",
                "a run in which the tool is seen",
            )
        start = max(start, int(seen[0]))
    if model.find_start is None:
        return start, end, None
    inside = {name: cut(stream, start, end) for name, stream in samples.items()}
    start_sample = model.find_start(recording, inside)
    if start_sample is None:
        raise RecordingError(
            place,
            f"no instant at which '{model.name}' can start",
            "at least one (see the model)",
            "a run in which enough is seen at once: markers of the tool, or landmarks in an image",
        )
    return start_sample.time_ns, end, start_sample


def _need_overlap(place: Any, name: str, times: Times, other: str, others: Times) -> None:
    if times[0] > others[-1] or times[-1] < others[0]:
        raise RecordingError(
            place,
            f"{name} over {_describe(times)} and {other} over {_describe(others)}",
            "streams that overlap in time",
            "checking the clocks and units of both",
        )


def knots_from(time_ns: Times, value: Any, start: int) -> Knots:
    """Knots of an input with samples `value` (N, C) at `time_ns` (N,), in seconds since `start` (ns).

    Examples
    --------
    A rate of 2 rad/s for half a second:

    >>> import numpy as np
    >>> import jaxekf
    >>> knots = jaxekf.timeline.knots_from(np.array([0, 500_000_000]), [[2.0], [2.0]], start=0)
    >>> knots.integral
    array([[0.],
           [1.]])
    """
    time = (time_ns - start) / NANOSECONDS
    value = np.asarray(value, float)
    steps = 0.5 * (value[1:] + value[:-1]) * np.diff(time)[:, None]
    integral = np.concatenate([np.zeros_like(value[:1]), np.cumsum(steps, axis=0)])
    return Knots(time, value, integral)
