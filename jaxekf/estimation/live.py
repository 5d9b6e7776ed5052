"""Live estimates: late measurements update past beliefs, the input extrapolates them to the present."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxekf._support import arrays
from jaxekf._support.compilation import jit, require_float64
from jaxekf._support.errors import FilterError, ModelError
from jaxekf.estimation import padding
from jaxekf.estimation.batch import evaluate_outputs
from jaxekf.estimation.clock import clock_of
from jaxekf.estimation.parameters import for_model
from jaxekf.estimation.timeline import knots_from
from jaxekf.filtering import ekf
from jaxekf.filtering.arguments import float_leaves
from jaxekf.filtering.model import Belief, Model, Parameters, Sensor
from jaxekf.filtering.steps import Rows, Steps
from jaxekf.geometry import manifold
from jaxekf.recordings.gaps import LONGEST_INPUT_GAP_S
from jaxekf.recordings.types import NANOSECONDS, Floats

_INPUT_KEPT_NS = NANOSECONDS
"""Input kept before the horizon, ns, because a clock offset may need it."""


class Known(NamedTuple):
    """The estimate at one instant.

    Examples
    --------
    The present after 0.1 s of samples of the gyroscope:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model, run = jaxekf.get_model("loose"), jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> optical, imu = run.need_optical(), run.need_imu()
    >>> first = {"optical": optical.q_ref_body[0]}
    >>> belief = jaxekf.initial_belief(model, model.parameters, first)
    >>> start = int(optical.time_ns[0])
    >>> stream = jaxekf.Stream(model, model.parameters, belief, start)
    >>> for time, rate in zip(imu.time_ns[:13].tolist(), imu.gyroscope):
    ...     stream.put_input(time, rate)
    >>> known = stream.known()
    >>> (known.time_ns - start) / 1e9, known.belief.cov.shape
    (0.096, (6, 6))
    >>> for name, (value, cov) in known.outputs.items():
    ...     print(name, value.shape, cov.shape)
    attitude (4,) (3, 3)
    rate (3,) (3, 3)
    """

    time_ns: int
    """The instant, that of the latest input: int64 nanoseconds on the input's clock."""
    belief: Belief
    """State, and covariance (n, n) of its error vector."""
    outputs: dict[str, tuple[Any, Any]]
    """Value and covariance of each output of the model, by name."""


class _Sample(NamedTuple):
    value: Any
    mask: Any
    aux: Any


class Stream:
    """A live filter: it takes samples as they arrive, in any order, and estimates the present.

    Beliefs older than `horizon_s` before the latest input are final: a sample taken before them is too
    late, is not used, and is counted in `dropped`. Each call of `known` filters everything within the
    horizon again, so that its result is that of `jaxekf.run_filter` on all samples so far. The first call
    compiles. Input and sensors have stamps of their own clocks, which differ by the clock offset (or
    latency) and drift of the parameters.

    Parameters
    ----------
    model
        A model with an input, such as ``tight``.
    params
        Noise, calibration and setup.
    belief
        Mean and covariance at `start_ns`; samples taken at that time are used.
    start_ns
        Time of the initial belief, int64 nanoseconds on the clock of the sensors.
    horizon_s
        Longest latency of a measurement, s.
    capacity
        Largest number of instants within the horizon; more are made final earlier.

    Raises
    ------
    ModelError
        The model has no input.
    PrecisionError
        JAX is not set to float64; see `jaxekf.set_up`.

    Examples
    --------
    A sample that the tracker took at the start arrives 0.1 s later, and corrects the present:

    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model, run = jaxekf.get_model("loose"), jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> optical, imu = run.need_optical(), run.need_imu()
    >>> first = {"optical": optical.q_ref_body[0]}
    >>> belief = jaxekf.initial_belief(model, model.parameters, first)
    >>> start = int(optical.time_ns[0])
    >>> stream = jaxekf.Stream(model, model.parameters, belief, start)
    >>> for time, rate in zip(imu.time_ns[:13].tolist(), imu.gyroscope):
    ...     stream.put_input(time, rate)
    >>> before = stream.known()
    >>> stream.put("optical", start, optical.q_ref_body[0])
    True
    >>> after = stream.known()
    >>> for known in (before, after):
    ...     print(np.rad2deg(np.sqrt(np.diagonal(known.belief.cov)[:3])).round(1))  # deg
    [10. 10. 10.]
    [0.3 0.3 0.3]
    """

    def __init__(
        self,
        model: Model,
        params: Parameters,
        belief: Belief,
        start_ns: int,
        *,
        horizon_s: float = 0.2,
        capacity: int = 256,
    ) -> None:
        require_float64()
        if model.input is None:
            raise ModelError(
                f"model '{model.name}': got no input, expected one to extrapolate by; use a model with an"
                " input, such as tight"
            )
        self.model, self.params = model, for_model(model, params)
        self.dropped: dict[str, int] = {sensor.name: 0 for sensor in model.sensors}
        self._horizon_ns, self._capacity = round(horizon_s * NANOSECONDS), capacity
        self._belief = jax.tree.map(jnp.asarray, float_leaves("belief", belief))
        self._rejecting_s: Any = None
        self._start_ns = self._base_ns = arrays.whole_number(start_ns, arrays.argument("start_ns"))
        self._base_is_open = True
        self._clock = replace(clock_of(model, self.params, "imu"), start_ns=self._start_ns)
        self._times: list[int] = []
        self._placed: list[int] = []
        self._values: list[Floats] = []
        self._samples: dict[int, dict[str, _Sample]] = {}

    def put_input(self, time_ns: int, value: Any) -> None:
        """Add a sample of the input, such as the IMU, in order of time.

        Parameters
        ----------
        time_ns
            Time of the sample, int64 nanoseconds on its own clock.
        value
            (C,) the sample, in the units of the model's input.

        Raises
        ------
        ModelError
            The time does not increase, the gap before it is too long, or the shape differs from before.
        """
        time_ns = arrays.whole_number(time_ns, arrays.argument("time_ns"))
        if self._times and time_ns <= self._times[-1]:
            raise ModelError(
                f"got an input at {time_ns} ns after one at {self._times[-1]} ns, expected times that"
                " increase; leave out repeated samples"
            )
        placed = int(self._clock.tracker_from_imu(np.array([time_ns], np.int64))[0])
        before = self._placed[-1] if self._placed else self._start_ns
        usual = self._times[-1] - self._times[-2] if len(self._times) > 1 else 0
        if placed - before > max(LONGEST_INPUT_GAP_S * NANOSECONDS, 3 * usual):
            raise ModelError(
                f"got an input {(placed - before) / NANOSECONDS:.3f} s after the last, expected no"
                f" gap over {LONGEST_INPUT_GAP_S} s, because the input is not extrapolated; start a new"
                " stream from a belief after the gap"
            )
        sample = arrays.floats(value, arrays.argument("value"))
        if self._values and sample.shape != self._values[0].shape:
            raise ModelError(
                f"got an input of shape {sample.shape}, expected {self._values[0].shape} as before; pass"
                " all channels of every sample"
            )
        self._times.append(time_ns)
        self._placed.append(placed)
        self._values.append(sample)

    def put(
        self, sensor: str, taken_ns: int, value: Any, *, mask: Any = True, aux: Any = None
    ) -> bool:
        """Add a sample of a sensor.

        Parameters
        ----------
        sensor
            Name of a sensor of the model.
        taken_ns
            Time at which the sample was *taken*, not that of its arrival, int64 nanoseconds on the
            sensors' clock.
        value
            The sample, of the shapes of the sensor's space.
        mask
            (rows,) whether each row of the sample is visible; one flag for all rows.
        aux
            Auxiliary data of the sample, if the sensor has it.

        Returns
        -------
        bool
            Whether the sample is used; False for one that is older than the horizon.

        Raises
        ------
        ModelError
            The model has no such sensor, or the sample does not have the shapes of its space.
        """
        definition = self.model.sensor(sensor)
        taken_ns = arrays.whole_number(taken_ns, arrays.argument("taken_ns"))
        late = taken_ns < self._base_ns or (taken_ns == self._base_ns and not self._base_is_open)
        if late:
            self.dropped[sensor] += 1
            return False
        value = arrays.float_tree(value, arrays.argument("value"))
        _check_shapes(definition, value)
        rows = np.broadcast_to(arrays.flags(mask, arrays.argument("mask")), definition.rows)
        aux = definition.typical_aux if aux is None else aux
        self._samples.setdefault(taken_ns, {})[sensor] = _Sample(value, rows, aux)
        return True

    def known(self) -> Known:
        """Estimate the instant of the latest input sample, from all samples so far.

        Raises
        ------
        ModelError
            There are fewer than two samples of the input.
        FilterError
            A covariance is no longer finite and positive definite.
        """
        if len(self._times) < 2 or self._placed[-1] < self._base_ns:
            raise ModelError(
                f"got {len(self._times)} samples of the input from {self._base_ns} ns on, expected two;"
                " call known after more input"
            )
        now = self._placed[-1]
        while True:
            instants = self._open_instants(now)
            if len(instants) <= self._capacity:
                break
            final = min(len(instants) - self._capacity, self._capacity)
            self._filter(instants[: self._capacity], final)
        final = sum(1 for t in instants if t < now - self._horizon_ns)
        belief, outputs = self._filter(instants, final)
        return Known(self._times[-1], belief, outputs)

    def _open_instants(self, now: int) -> list[int]:
        """Instants up to `now` that are not final: those of the input and of the samples."""
        first = self._base_ns if self._base_is_open else self._base_ns + 1
        times = {t for t in self._placed if first <= t <= now}
        return sorted(times | {t for t in self._samples if t <= now})

    def _filter(self, instants: list[int], final: int) -> tuple[Belief, dict[str, Any]]:
        """Filter over these instants, make the first `final` of them final, and return the last belief."""
        steps = self._steps(instants)
        if self._rejecting_s is None:
            groups = ekf.count_reset_groups(self.model, self.params, self._belief, steps)
            self._rejecting_s = jnp.zeros(groups)
        output, outputs = _advance(self.model, self.params, self._belief, self._rejecting_s, steps)
        count = len(instants)
        if not np.asarray(output.instants.healthy)[:count].all():
            raise FilterError(
                f"got a covariance that is not finite and definite between {instants[0]} and"
                f" {instants[-1]} ns, expected a definite one; check the units of the samples"
            )
        if final:
            self._belief = jax.tree.map(lambda a: a[final - 1, 0], output.instants.updated)
            if output.instants.rejecting_s is not None:
                self._rejecting_s = output.instants.rejecting_s[final - 1, 0]
            self._discard_before(instants[final - 1])
        last = jax.tree.map(lambda a: a[count - 1, 0], output.instants.updated)
        return last, jax.tree.map(lambda a: a[count - 1, 0], outputs)

    def _discard_before(self, time_ns: int) -> None:
        """Discard the samples before an instant that has become final."""
        self._base_ns, self._base_is_open = time_ns, False
        self._samples = {t: s for t, s in self._samples.items() if t > time_ns}
        kept = sum(1 for t in self._placed if t < time_ns - _INPUT_KEPT_NS)
        del self._times[:kept], self._placed[:kept], self._values[:kept]

    def _steps(self, instants: list[int]) -> Steps:
        """Epochs of one substep each, padded to the capacity."""
        times = np.array(instants, np.int64)
        dt = np.diff(times, prepend=self._base_ns) / NANOSECONDS
        time = (times - self._start_ns) / NANOSECONDS
        every = np.ones((len(times), 1), bool)
        fast = {sensor.name: self._rows(sensor, instants) for sensor in self.model.sensors}
        inputs = knots_from(np.array(self._times, np.int64), self._values, self._start_ns)
        steps = Steps(time[:, None], dt[:, None], every, inputs, fast, {})
        knots = padding.bucket(max(len(self._times), self._capacity))
        return padding.pad(steps, self._capacity, 1, knots)

    def _rows(self, sensor: Sensor, instants: list[int]) -> Rows:
        """A sensor's samples at these instants, masked at instants without one."""
        blank = _Sample(
            _zeros(sensor.space), np.zeros(sensor.rows, bool), _as_floats(sensor.typical_aux)
        )
        samples = [self._samples.get(t, {}).get(sensor.name, blank) for t in instants]
        value, mask, aux = (
            jax.tree.map(lambda *a: np.stack([np.asarray(x) for x in a])[:, None], *parts)
            for parts in zip(*samples, strict=True)
        )
        return Rows(value, aux, mask, np.full((len(instants), 1), self._period(sensor.name)))

    def _period(self, sensor: str) -> float:
        """Median period of the sensor's samples within the horizon, s; used only by
        `Model.gate_reset_after_s`."""
        times = sorted(t for t, s in self._samples.items() if sensor in s)
        return float(np.median(np.diff(times))) / NANOSECONDS if len(times) > 1 else 0.0


def _check_shapes(sensor: Sensor, value: Any) -> None:
    """Raise `ModelError` for a sample that does not have the shapes of the sensor's space."""
    expected = [np.shape(leaf) for leaf in jax.tree.leaves(_zeros(sensor.space))]
    got = [np.shape(leaf) for leaf in jax.tree.leaves(value)]
    if got != expected:
        raise ModelError(
            f"sensor '{sensor.name}': got a sample of shapes {got}, expected {expected}; pass it in the"
            " sensor's space"
        )


def _zeros(space: Any) -> Any:
    return jax.tree.map(
        lambda part: np.zeros(part.shape),
        space,
        is_leaf=lambda node: isinstance(node, manifold.Manifold),
    )


def _as_floats(tree: Any) -> Any:
    return jax.tree.map(lambda a: np.asarray(a, float), tree)


@partial(jit, static_argnums=0)
def _advance(
    model: Model, params: Parameters, belief: Belief, rejecting_s: Any, steps: Steps
) -> tuple[ekf.FilterOutput, Mapping[str, Any]]:
    """Filter one window, and evaluate the model's outputs at its instants."""
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], (params, belief, steps, rejecting_s))
    output = ekf.run_filter_batch(model, *one[:3], rejecting_s=one[3])
    outputs = evaluate_outputs(model, one[0], output)
    return jax.tree.map(lambda a: a[0], (output, outputs))
