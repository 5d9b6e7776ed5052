"""Models and sensors as data: the description of a system that the filter estimates.

A model is a state space, a transition with its process noise, sensors, outputs and default
parameters. It is written for one run, one step and one sample; the filter differentiates it, scans
it over time and maps it over runs. The built-in models are in `jaxekf.models`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.deprecations import renamed_fields
from jaxekf._support.errors import ModelError
from jaxekf.filtering.model_origin import reduced
from jaxekf.geometry import manifold
from jaxekf.recordings.types import Recording, Samples

Transition = Callable[[Any, Any, Array, Array, "Parameters"], Any]
ProcessNoise = Callable[["Parameters", Array], Array]
Predict = Callable[[Any, Any, "Parameters", Any], Any]
SensorNoise = Callable[["Parameters", Any, Array], Array]
Source = Callable[[Recording], Samples]


class Start(NamedTuple):
    """The start of a run, as `Model.find_start` returns it.

    Examples
    --------
    A model that starts at the tracker's sample number 100:

    >>> from dataclasses import replace
    >>> import jaxekf
    >>> def find_start(recording, samples):
    ...     optical = samples["optical"]
    ...     first = {"optical": optical.value[100]}
    ...     return jaxekf.Start(int(optical.time_ns[100]), first, "began at sample 100")
    >>> model = replace(jaxekf.get_model("loose"), find_start=find_start)
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> line = jaxekf.timeline.build(model, run)
    >>> print((line.time_ns[0, -1] - run.need_optical().time_ns[0]) / 1e9, "s:", *line.notes)
    1.6 s: began at sample 100
    """

    time_ns: int
    """First instant of the estimate, int64 nanoseconds on the recording's clock."""
    first: dict[str, Any]
    """The argument of `Model.initial_mean`."""
    note: str = ""
    """A note on the start for the user; empty for none."""


FindStart = Callable[[Recording, Mapping[str, Samples]], Start | None]


class Parameters(NamedTuple):
    """The parameters of a model: pytrees of arrays, all differentiable.

    Examples
    --------
    Estimate with twice the model's noise of the tracker, which makes innovations smaller than predicted:

    >>> import jaxekf
    >>> model = jaxekf.get_model("loose")
    >>> params, unit = model.parameters, model.units.noise.optical
    >>> print(f"{params.noise.optical:.5f} {unit}")
    0.00524 rad
    >>> noise = params.noise._replace(optical=2.0 * params.noise.optical)
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(
    ...     jaxekf.demo.FOLDER / "free-5", params=params._replace(noise=noise)
    ... )
    >>> print(f"NIS {estimate.mean_nis('optical'):.2f}")
    NIS 0.25
    """

    noise: Any
    """Standard deviations or spectral densities; shape () for all axes, (d,) for each axis, or a
    lower-triangular factor (d, d)."""
    calibration: Any
    """Clock offset, alignment, scale, lever arm, latency."""
    initial: Any
    """Standard deviations of the initial belief."""
    setup: Any = ()
    """Constants of the recording that are not tuned: marker geometry, gravity, frames."""
    truth: Any = ()
    """Clock offset and rotations between encoder and tracker, for a tuner that estimates them. They change
    the reference that an estimate is compared with, not the estimate."""


class Belief(NamedTuple):
    """A state and the covariance of its error vector (in the tangent space at the mean).

    Examples
    --------
    The bias is known from a calibration, in rad/s:

    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> mean = belief.mean._replace(bias=np.array([0.0123, 0.0079, -0.0004]))
    >>> deviations = np.deg2rad([10.0, 10.0, 10.0, 0.02, 0.02, 0.02])
    >>> belief = jaxekf.Belief(mean, np.diag(deviations**2))
    >>> filtered = jaxekf.jit(jaxekf.run_filter, static_argnums=0)
    >>> output = filtered(model, model.parameters, belief, line.steps)
    >>> print(np.rad2deg(output.instants.updated.mean.bias[-1, -1]).round(2))  # deg/s
    [ 0.7   0.45 -0.02]
    """

    mean: Any
    """The state: a NamedTuple of arrays, such as `q_ref_body` (4,) and `bias` (3,) of `loose`."""
    cov: Array
    """(n, n) covariance of the error vector, whose rows are named by `Estimate.error_labels`."""


@renamed_fields(aux_like="typical_aux", alike="single_group")
@dataclass(frozen=True, eq=False)
class Sensor:
    """One kind of measurement.

    ``measured = retract(predict(x, u, params, aux), noise)`` in the space of the measurement.

    Examples
    --------
    The tracker of `loose`, and a model in which it has a chi-square gate at 99.9 %:

    >>> from dataclasses import replace
    >>> import jaxekf
    >>> model = jaxekf.get_model("loose")
    >>> optical = model.sensor("optical")
    >>> optical.rows, optical.space.unit, optical.gate
    (3, 'rad', None)
    >>> gated = replace(model, sensors=(replace(optical, gate=0.999),))
    >>> gated.sensor("optical").gate
    0.999
    """

    name: str
    """Name in `Estimate.sensors` and in the account, such as ``optical``."""
    space: Any
    """Manifold (or NamedTuple of manifolds) of one sample; its error vector has one entry a row."""
    predict: Predict
    """``predict(x, u, params, aux)``: the sample without noise; ``u`` is an `InputSample`."""
    noise: SensorNoise
    """``noise(params, aux, dt)``: covariance (rows, rows) of a sample; ``dt`` is the sensor's own
    sampling period in seconds."""
    source: Source | None = None
    """``source(recording)``: the samples; None for a sensor that gets its samples as arrays only."""
    groups: tuple[int, ...] | None = None
    """Group of each row; a gate accepts or rejects all rows of a group. None puts all rows in one group."""
    gate: float | None = None
    """Probability with which a Gaussian group passes the chi-square gate; None for no gate."""
    weighting: Literal["huber", "student"] | None = None
    """Robust weighting (Huber or Student-t): the noise of a group grows with its innovation, and the
    likelihood is that of the inflated noise. None for none."""
    typical_aux: Any = None
    """Typical auxiliary data, used for samples that come without; None if `predict` needs none."""
    single_group: "Sensor | None" = None
    """One group as a sensor, if the sample consists of many equal groups; see `repeated`."""

    @property
    def copies(self) -> int:
        """Number of equal groups that a sample consists of; 1 for a sensor that is not `repeated`."""
        return 1 if self.single_group is None else self.rows // self.single_group.rows

    @property
    def rows(self) -> int:
        """Number of rows of one sample."""
        return manifold.error_dim(self.space)

    @property
    def group_rows(self) -> tuple[tuple[int, ...], ...]:
        """Rows of each group."""
        groups = self.groups or (0,) * self.rows
        return tuple(
            tuple(row for row, group in enumerate(groups) if group == name)
            for name in sorted(set(groups))
        )


def repeated(one: Sensor, count: int, labels: Sequence[str] = ()) -> Sensor:
    """A sensor whose sample is `count` samples of `one`, such as all points of an image.

    Value, rows and covariance are those of all groups one after the other; every leaf of `aux` has the
    groups on its first axis. Each group has its own gate or weight. The compiled size does not grow with
    the number of groups.

    Parameters
    ----------
    one
        Sensor of one group, in a `Euclidean` space; gives gate, weighting and source.
    count
        Number of groups.
    labels
        Labels of all rows; none keeps the default ones.

    Raises
    ------
    ModelError
        For another space, for no group, or if the number of labels is not the number of rows.
    """
    if not isinstance(one.space, manifold.Euclidean) or one.single_group is not None or count < 1:
        raise ModelError(
            f"sensor '{one.name}': got {count} groups in {type(one.space).__name__}, expected one or more"
            " in Euclidean; give one group whose sample is a vector"
        )
    rows = one.rows
    if labels and len(labels) != count * rows:
        raise ModelError(
            f"sensor '{one.name}': got {len(labels)} labels, expected {count * rows}; name every row"
        )

    def predict(x: Any, u: Any, params: Parameters, aux: Any) -> Array:
        return jax.vmap(lambda a: one.predict(x, u, params, a), axis_size=count)(aux).reshape(-1)

    def noise(params: Parameters, aux: Any, dt: Array) -> Array:
        each = jax.vmap(lambda a: one.noise(params, a, dt), axis_size=count)(aux)
        here = jnp.eye(count, dtype=each.dtype)[:, None, :, None]
        return (here * each[:, :, None, :]).reshape(count * rows, count * rows)

    like = jax.tree.map(lambda a: np.repeat(np.asarray(a)[None], count, axis=0), one.typical_aux)
    space = replace(one.space, size=count * rows, labels=tuple(labels))
    groups = tuple(np.repeat(np.arange(count), rows).tolist())
    return replace(
        one,
        space=space,
        predict=predict,
        noise=noise,
        groups=groups,
        typical_aux=like,
        single_group=one,
    )


@dataclass(frozen=True, eq=False)
class Output:
    """A quantity computed from the state, with its uncertainty.

    Examples
    --------
    The rate of `loose` is the gyroscope's sample without the bias:

    >>> import jax.numpy as jnp
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> model = jaxekf.get_model("loose")
    >>> output = model.output("rate")
    >>> output.frame, output.space.unit
    ('body', 'rad/s')
    >>> x = model.initial_mean({})._replace(bias=jnp.array([0.1, 0.0, 0.0]))
    >>> sample = jnp.array([0.5, 0.0, 0.3])
    >>> u = jaxekf.InputSample(mean=sample, value=sample, bandwidth=125.0)
    >>> print(output.value(x, u, model.parameters))
    [0.4 0.  0.3]
    >>> output.noise(u, model.parameters).shape
    (3, 3)
    """

    name: str
    """Name in `Estimate.outputs`."""
    space: Any
    """Manifold of the value; gives its unit and the length of its error vector."""
    frame: str
    """Frame of the error vector and its covariance."""
    value: Callable[[Any, Any, Parameters], Any]
    """``value(x, u, params)``; ``u`` is the input at that instant."""
    noise: Callable[[Any, Parameters], Array] | None = None
    """``noise(u, params)``: covariance of contributions outside the state, such as a gyroscope sample."""


@dataclass(frozen=True, eq=False)
class Input:
    """A measured quantity that drives the transition, such as an IMU's rate and specific force.

    Examples
    --------
    The gyroscope of `loose`, whose clock may be ahead of the tracker's:

    >>> import jaxekf
    >>> model = jaxekf.get_model("loose")
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> model.input.name, model.input.source(run).value.shape
    ('gyroscope', (3001, 3))
    >>> params = model.parameters
    >>> calibration = params.calibration._replace(clock_offset=0.004, clock_drift=1e-4)
    >>> shift = model.input.shift(params._replace(calibration=calibration), 10.0)
    >>> print(f"{shift:.3f} s ahead after 10 s")
    0.005 s ahead after 10 s
    """

    name: str
    """Name in the account, such as ``gyroscope``."""
    source: Source
    """``source(recording)``: the samples (N, c), none of them masked in the run."""
    clock_offset: Callable[[Parameters], Array] | None = None
    """Offset from the timeline to the input's own clock at the start of the run, seconds."""
    clock_drift: Callable[[Parameters], Array] | None = None
    """Growth of the offset, seconds per second."""

    def shift(self, params: Parameters, time: Array) -> Array:
        """Offset from the timeline to the input's clock at `time`, both in seconds; any shape."""
        total = jnp.zeros_like(time)
        if self.clock_offset is not None:
            total = total + self.clock_offset(params)
        if self.clock_drift is not None:
            total = total + self.clock_drift(params) * time
        return total


@renamed_fields(patience_s="gate_reset_after_s")
@dataclass(frozen=True, eq=False)
class Model:
    """A system to be estimated. Instances are compared by identity: build each once.

    Copies are the same object. A model is pickled by its name, by how it was adapted, or by the module and
    name that hold it, and is then the same object again; any other one by its functions.

    Examples
    --------
    The state of `loose`, and the noise parameters with their units:

    >>> import jaxekf
    >>> from jaxekf.geometry import manifold
    >>> model = jaxekf.get_model("loose")
    >>> model.space
    State(q_ref_body=SO3(unit='rad'), bias=Euclidean(size=3, unit='rad/s', labels=(), frame='body'))
    >>> model.units.noise
    Noise(gyroscope='rad/s/sqrt(Hz)', bias_walk='rad/s^2/sqrt(Hz)', optical='rad')
    >>> [sensor.name for sensor in model.sensors], [output.name for output in model.outputs]
    (['optical'], ['attitude', 'rate'])
    """

    name: str
    """Name for `jaxekf.get_model`, and in files of parameters."""
    summary: str
    """One line for lists of models."""
    space: Any
    """The state's NamedTuple type with a manifold for each field; see `jaxekf.Manifold`."""
    transition: Transition
    """``transition(x, u, dt, w, params)``: the state ``dt`` seconds later; ``u`` is the mean of the
    input over the step (None without input) and ``w`` the process noise integrated over it."""
    process_noise: ProcessNoise
    """``process_noise(params, dt)``: covariance (n_w, n_w) of ``w``; zero at ``dt = 0``."""
    sensors: tuple[Sensor, ...]
    """All sensors; the order has no effect."""
    parameters: Parameters
    """Defaults."""
    units: Parameters
    """Unit of each parameter, as strings in the same trees."""
    noise_dims: Any
    """Number of axes of each noise parameter, in the same tree as `parameters.noise`."""
    initial_mean: Callable[[Mapping[str, Any]], Any]
    """``initial_mean(first)``: the state at the start from the first visible sample of each sensor."""
    initial_covariance: Callable[[Parameters], Array]
    """``initial_covariance(params)``: (n, n), from ``params.initial``."""
    start_with: tuple[str, ...] = ()
    """Sensors that need a visible sample before the run can start."""
    find_start: FindStart | None = None
    """``find_start(recording, samples)``: the start of a run, or None if it cannot start; `samples` are
    those during the input. Without it a run starts at the first visible samples of `start_with`."""
    adapt: Callable[[Sequence[Recording]], "Model"] | None = None
    """``adapt(recordings)``: the model for these recordings, such as with one sensor per marker; the same
    object for the same result."""
    setup: Callable[[Recording], Any] | None = None
    """``setup(recording)``: `Parameters.setup`; None for a model without."""
    gate_reset_after_s: float = 0.35
    """Seconds of samples of a sensor outside their chi-square bound, none inside, after which the belief is
    reset (gates open, covariance grows); infinite for never."""
    input: Input | None = None
    """The measured input; None for a model whose transition needs none."""
    outputs: tuple[Output, ...] = ()
    """Quantities that are estimated besides the state."""
    project: Callable[[Any], Any] | None = None
    """Projects an updated mean onto a constraint that its space does not keep; None for no constraint."""
    hold_to: str | None = None
    """Name of the sensor at whose sampling instants every other stream is held (zero-order hold), as in the
    published discrete-time filter; None takes every sample at its own time."""

    def __copy__(self) -> "Model":
        return self

    def __deepcopy__(self, memo: Any) -> "Model":
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced(self)

    @property
    def error_dim(self) -> int:
        """Length of the error vector, the size of every covariance."""
        return manifold.error_dim(self.space)

    def sensor(self, name: str) -> Sensor:
        """The sensor called `name`."""
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        raise ModelError(
            f"model '{self.name}' got the sensor name '{name}', expected one of"
            f" {[s.name for s in self.sensors]}; check the spelling"
        )

    def output(self, name: str) -> Output:
        """The output called `name`."""
        for output in self.outputs:
            if output.name == name:
                return output
        raise ModelError(
            f"model '{self.name}' got the output name '{name}', expected one of"
            f" {[o.name for o in self.outputs]}; check the spelling"
        )
