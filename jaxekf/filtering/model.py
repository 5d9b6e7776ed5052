"""What an estimator is told: models and sensors as data.

A model is a state space, a transition with its process noise, sensors, outputs and default
parameters. It is written for one run, one step and one sample; the filter differentiates it, scans
it over time and maps it over runs. Nothing here knows a particular model.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.errors import ModelError
from jaxekf.geometry import manifold
from jaxekf.recordings.types import Recording, Samples

Transition = Callable[[Any, Any, Array, Array, "Parameters"], Any]
ProcessNoise = Callable[["Parameters", Array], Array]
Predict = Callable[[Any, Any, "Parameters", Any], Any]
SensorNoise = Callable[["Parameters", Any, Array], Array]
Source = Callable[[Recording], Samples]


class Start(NamedTuple):
    """Where a run starts, and what is known there."""

    time_ns: int
    first: dict[str, Any]
    """What `Model.initial_mean` is given."""
    note: str = ""
    """What a user should be told about the start; empty where there is nothing to say."""


FindStart = Callable[[Recording, Mapping[str, Samples]], Start | None]


class Parameters(NamedTuple):
    """Everything a run is estimated with that is not data: pytrees of arrays, so they have gradients."""

    noise: Any
    """Standard deviations or spectral densities; shape () for all axes, (d,) for each axis, or a
    lower-triangular factor (d, d)."""
    calibration: Any
    """Clock offset, alignment, scale, lever arm, latency: what is not noise."""
    initial: Any
    """Standard deviations of the initial belief."""
    setup: Any = ()
    """What a recording itself tells of its run and nobody tunes: marker geometry, gravity, frames."""
    truth: Any = ()
    """How the encoder's clock and frames lie to the tracker's, where a tuner is to find that: no estimate
    depends on it, only what it is compared with."""


class Belief(NamedTuple):
    """A state and the covariance of its error vector (in the tangent space at the mean)."""

    mean: Any
    cov: Array


@dataclass(frozen=True, eq=False)
class Sensor:
    """One kind of measurement.

    ``measured = retract(predict(x, u, params, aux), noise)`` in the space of the measurement.
    """

    name: str
    space: Any
    """Manifold (or NamedTuple of manifolds) of one sample; its error vector has one entry a row."""
    predict: Predict
    """``predict(x, u, params, aux)``: the sample without noise; ``u`` is an `InputSample`."""
    noise: SensorNoise
    """``noise(params, aux, dt)``: covariance (rows, rows) of a sample; ``dt`` is the sensor's own
    sampling period in seconds."""
    source: Source | None = None
    """Where a recording holds the samples; None for a sensor that is fed from arrays only."""
    groups: tuple[int, ...] | None = None
    """Group of each row; a gate accepts or rejects a group whole. None puts all rows in one group."""
    gate: float | None = None
    """Probability with which a good group passes the chi-square gate; None for no gate."""
    weighting: Literal["huber", "student"] | None = None
    """Law of heavy tails by which a group counts less the farther it is off; None for none. The
    likelihood is then that of the noise so enlarged."""
    aux_like: Any = None
    """Auxiliary data of an ordinary sample, where it needs any: for samples that come without."""
    alike: "Sensor | None" = None
    """One of the groups that a sample is made of, as a sensor of its own, where all are alike and many; see
    `repeated`. None for a sensor whose sample is one thing."""

    @property
    def copies(self) -> int:
        """Number of groups of a sample that is made of like ones; 1 for any other."""
        return 1 if self.alike is None else self.rows // self.alike.rows

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
    groups on its first axis. Each is gated, or counts less, by itself, and what the filter compiles
    does not grow with their number. Gate, weighting and source are those of `one`, whose space must be
    `Euclidean`; `labels` are those of all rows.

    Raises `ModelError` for another space, for no group, or for a number of labels that is not the rows'.
    """
    if not isinstance(one.space, manifold.Euclidean) or one.alike is not None or count < 1:
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

    like = jax.tree.map(lambda a: np.repeat(np.asarray(a)[None], count, axis=0), one.aux_like)
    space = replace(one.space, size=count * rows, labels=tuple(labels))
    groups = tuple(np.repeat(np.arange(count), rows).tolist())
    return replace(
        one, space=space, predict=predict, noise=noise, groups=groups, aux_like=like, alike=one
    )


@dataclass(frozen=True, eq=False)
class Output:
    """A quantity users ask for that follows from the state, with its uncertainty."""

    name: str
    space: Any
    frame: str
    """Frame in which the error vector, and so the covariance, is counted."""
    value: Callable[[Any, Any, Parameters], Any]
    """``value(x, u, params)``; ``u`` is the input at that instant."""
    noise: Callable[[Any, Parameters], Array] | None = None
    """``noise(u, params)``: covariance added by what is not in the state, such as a gyroscope sample's."""


@dataclass(frozen=True, eq=False)
class Input:
    """A measured quantity that drives the transition instead of being compared with it."""

    name: str
    source: Source
    clock_offset: Callable[[Parameters], Array] | None = None
    """Seconds to add to a time of the timeline to get the input's own clock, at the start of the run."""
    clock_drift: Callable[[Parameters], Array] | None = None
    """Seconds by which that grows in each second of the run."""

    def shift(self, params: Parameters, time: Array) -> Array:
        """Seconds to add at `time`, seconds since the start of the run."""
        total = jnp.zeros_like(time)
        if self.clock_offset is not None:
            total = total + self.clock_offset(params)
        if self.clock_drift is not None:
            total = total + self.clock_drift(params) * time
        return total


@dataclass(frozen=True, eq=False)
class Model:
    """A system to be estimated. Instances are compared by identity: build each once."""

    name: str
    summary: str
    space: Any
    transition: Transition
    """``transition(x, u, dt, w, params)``: the state ``dt`` seconds later; ``u`` is the mean of the
    input over the step (None without input) and ``w`` the process noise integrated over it."""
    process_noise: ProcessNoise
    """``process_noise(params, dt)``: covariance (n_w, n_w) of ``w``; zero at ``dt = 0``."""
    sensors: tuple[Sensor, ...]
    parameters: Parameters
    """Defaults."""
    units: Parameters
    """Unit of each parameter, as strings in the same trees."""
    noise_dims: Any
    """Number of axes of each noise parameter, in the same tree as `parameters.noise`."""
    initial_mean: Callable[[Mapping[str, Any]], Any]
    """``initial_mean(first)``: the state at the start from the first visible sample of each sensor."""
    initial_covariance: Callable[[Parameters], Array]
    start_with: tuple[str, ...] = ()
    """Sensors that must have been seen before the run can start."""
    find_start: FindStart | None = None
    """``find_start(recording, samples)``: where a run can start, from each sensor's samples while the
    input lasts; None where it cannot. Without it a run starts when each of `start_with` is seen."""
    adapt: Callable[[Sequence[Recording]], "Model"] | None = None
    """The model as these recordings need it, such as with a sensor for each of their markers; the same
    object for the same need."""
    setup: Callable[[Recording], Any] | None = None
    """``setup(recording)``: that part of the parameters which each recording tells itself; None for a
    model without."""
    patience_s: float = 0.5
    """Seconds of refused samples, none let in, after which gates open and the belief is widened."""
    input: Input | None = None
    outputs: tuple[Output, ...] = ()
    project: Callable[[Any], Any] | None = None
    """Puts an updated mean back on a constraint that its space does not keep; None where it does."""
    hold_to: str | None = None
    """Name of the sensor on whose sampling instants every other stream is held (zero-order), as the
    published discrete-time filter does; None takes every sample at its own time."""

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
