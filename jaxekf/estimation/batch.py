"""Estimates of whole recorded runs, filtered or smoothed."""

import os
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support import memory
from jaxekf._support.compilation import jit, require_float64
from jaxekf._support.errors import ArgumentError, FilterError
from jaxekf.estimation import padding, parameters, timeline
from jaxekf.estimation._assembly import as_estimate, model_sensors
from jaxekf.estimation.clock import ClockName, clock_of
from jaxekf.estimation.output_times import Every, OutputTimes
from jaxekf.estimation.result import Estimate
from jaxekf.estimation.timeline import Timeline
from jaxekf.filtering import ekf, smoother
from jaxekf.filtering.ekf import FilterOutput
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Steps
from jaxekf.geometry import manifold
from jaxekf.io import run_folder
from jaxekf.models import adapted, get_model
from jaxekf.recordings.types import NANOSECONDS, Recording

Run = Recording | Path | str
_BATCH_BYTES = 1 << 30


def estimate(
    run: Run,
    model: str | Model = "loose",
    params: Parameters | None = None,
    *,
    smooth: bool = False,
    at: OutputTimes | None = None,
    clock: ClockName = "imu",
) -> Estimate:
    """Estimate one run with the extended Kalman filter or, with `smooth`, the smoother.

    Parameters
    ----------
    run
        A `Recording`, or the path of a run folder.
    model
        Name of a model, ``module:attribute``, or a `Model`.
    params
        Noise, calibration and initial belief; the model's defaults unless given. See
        `jaxekf.load_parameters`.
    smooth
        Estimate each instant from the whole run (fixed-interval smoothing) instead of from the measurements
        up to that instant. Innovations are those of the filter in both cases.
    at
        Additional output times: (N,) int64 nanoseconds on the clock of the estimate, or `jaxekf.every`.
        Without it the instants are those of the measurements.
    clock
        Clock of all times of the estimate, of `at` too: ``imu`` moves them by the parameters' clock offset
        (or latency) and drift, ``tracker`` leaves them on the clock of the tracker's samples. Both are the
        same for a model without an offset between two clocks, and for an offset and drift of zero.

    Returns
    -------
    Estimate
        State, covariance, outputs and innovations at the instants of the measurements; with `at` also
        `Estimate.requested`, the estimate at those times.

    Raises
    ------
    ArgumentError
        An argument has another type or shape than is stated.
    RecordingError
        The recording does not fit the model, or no time in `at` is within the run.
    ModelError
        The model is unknown, or `at` is given for a model whose steps are the samples of one stream.
    FilterError
        A covariance is no longer finite and positive definite.
    ResourceError
        There is too little memory.
    PrecisionError
        JAX is not set to float64; see `jaxekf.set_up`.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5")
    >>> estimate.attitude.value.shape, estimate.attitude.frame, estimate.attitude.unit
    ((3001, 4), 'body', 'rad')
    >>> print(f"NIS {estimate.mean_nis('optical'):.2f}")
    NIS 0.98
    """
    asked = at if at is None else [at]
    return estimate_many([run], model, params, smooth=smooth, at=asked, clock=clock)[0]


def estimate_many(
    runs: Sequence[Run],
    model: str | Model = "loose",
    params: Parameters | Sequence[Parameters] | None = None,
    *,
    smooth: bool = False,
    at: Sequence[OutputTimes | None] | Every | None = None,
    clock: ClockName = "imu",
) -> list[Estimate]:
    """Estimate several runs in parallel; the results are those of one `estimate` for each.

    Parameters
    ----------
    runs
        Recordings, or paths of run folders.
    model
        As in `estimate`.
    params
        One set of parameters for all runs, or one set for each run.
    smooth
        As in `estimate`.
    at
        Additional output times of each run, None for a run without, or one grid for all runs.
    clock
        As in `estimate`.

    Returns
    -------
    list of Estimate
        In the order of `runs`.

    Raises
    ------
    ArgumentError
        The number of entries in `params` or `at` is not the number of runs, or as in `estimate`.
    RecordingError, ModelError, FilterError, ResourceError, PrecisionError
        As in `estimate`.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimates = jaxekf.estimate_many(jaxekf.demo.paths(("free-4", "free-5")))
    >>> [made.run for made in estimates]
    ['free-4', 'free-5']
    """
    require_float64()
    recordings = read(runs)
    if isinstance(at, Every):
        at = [at] * len(recordings)
    if at is not None and (not hasattr(at, "__len__") or len(at) != len(recordings)):
        got = f"for {len(at)} runs" if hasattr(at, "__len__") else f"of type {type(at).__name__}"
        raise ArgumentError(
            f"got requested times {got}, expected as many as the {len(recordings)} runs; pass an entry for"
            " each, None for a run without requested times"
        )
    chosen = adapted(get_model(model), recordings)
    used = _parameters_per_run(chosen, params, len(recordings))
    clocks = [clock_of(chosen, own, clock) for own in used]
    timelines = timeline.build_many(chosen, recordings, at, clocks)
    results = filter_timelines(chosen, used, timelines, smooth=smooth)
    return [
        as_estimate(chosen, own, recording, line, *result, smooth=smooth)
        for own, recording, line, result in zip(used, recordings, timelines, results, strict=True)
    ]


def _parameters_per_run(
    model: Model, params: Parameters | Sequence[Parameters] | None, runs: int
) -> list[Parameters]:
    """The parameters of each run, after a check of types, shapes and values."""
    params = model.parameters if params is None else params
    if isinstance(params, Parameters) or not isinstance(params, Sequence):
        shared = parameters.for_model(model, params)._replace(truth=())
        parameters.check(shared)
        return [shared] * runs
    if len(params) != runs:
        raise ArgumentError(
            f"params: got {len(params)} sets of parameters, expected one for each of {runs} runs; pass a"
            " set for each, or one for all"
        )
    return [_parameters_per_run(model, own, 1)[0] for own in params]


def read(runs: Sequence[Run]) -> list[Recording]:
    """The recordings of runs; paths are read from disk.

    Raises `ArgumentError` for a single run, and for a value that is neither a path nor a recording.
    """
    if isinstance(runs, Recording | str | os.PathLike) or not isinstance(runs, Iterable):
        raise ArgumentError(
            f"runs: got one {type(runs).__name__}, expected a sequence of runs; try [run]"
        )
    return [run if isinstance(run, Recording) else _load(run) for run in runs]


def _load(run: Any) -> Recording:
    if not isinstance(run, str | os.PathLike):
        got, expected = f"a value of type {type(run).__name__}", "a jaxekf.Recording or a path"
        raise ArgumentError(f"run: got {got}, expected {expected}; try jaxekf.load(path)")
    return run_folder.load(Path(run))


def filter_timelines(
    model: Model, params: Sequence[Parameters], lines: Sequence[Timeline], *, smooth: bool = False
) -> list[tuple[FilterOutput, dict[str, tuple[Array, Array]]]]:
    """Filter runs in parallel and check the result of each.

    Parameters
    ----------
    model
        The model of all runs.
    params
        The parameters of each run.
    lines
        The timeline of each run. Runs of similar length are padded to one of a few lengths, so that few
        programs are compiled, and are filtered in batches that fit into memory.
    smooth
        Put the smoothed beliefs in place of the filter's updated ones.

    Returns
    -------
    list of (FilterOutput, dict)
        For each run the filter's output and, by name, value and covariance of the model's outputs; leading
        axes are (epochs, substeps), with padding.

    Raises
    ------
    FilterError
        A covariance is no longer finite and positive definite.
    ResourceError
        There is too little memory.
    """
    results: dict[int, Any] = {}
    for members in padding.groups(lines):
        group = [lines[i] for i in members]
        steps = padding.bucketed(group)
        starts = [
            (model.initial_mean(lines[i].first), params[i]._replace(setup=lines[i].setup))
            for i in members
        ]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *starts)
        size = min(len(members), _batch(model, steps))
        for start in range(0, len(members), size):
            # The last run fills up the last batch, since another batch size would need another program.
            index = np.minimum(np.arange(start, start + size), len(members) - 1)
            given = jax.tree.map(lambda a, index=index: np.asarray(a)[index], (stacked, steps))
            devices = sharing_devices()
            names = [lines[i].name for i in members[start : start + size]]
            with memory.for_runs(names):
                filtered = jax.tree.map(np.asarray, _run(model, devices, smooth, *given))
            for place in range(min(size, len(members) - start)):
                one = jax.tree.map(lambda a, place=place: a[place], filtered)
                _check(model, lines[members[start + place]], one[0])
                results[members[start + place]] = one
    return [results[i] for i in range(len(lines))]


def _batch(model: Model, steps: Steps) -> int:
    """Number of runs in one batch."""
    _, epochs, substeps = steps.dt.shape
    size = 8 * epochs * substeps * 4 * model.error_dim * (model.error_dim + 4)
    return max(1, _BATCH_BYTES // size)


def sharing_devices() -> tuple[Any, ...]:
    """The CPU devices to distribute runs over; empty if there is only one."""
    devices = jax.local_devices()
    shared = len(devices) > 1 and devices[0].platform == "cpu"
    return tuple(devices) if shared else ()


@partial(jit, static_argnums=(0, 1, 2))
def _run(
    model: Model,
    devices: tuple[Any, ...],
    smooth: bool,
    starts: tuple[Any, Parameters],
    steps: Steps,
) -> Any:
    means, every = starts
    cov = jax.vmap(model.initial_covariance)(every)
    given = (model, every, Belief(means, cov), steps)
    if smooth:
        both = smoother.run_smoother_batch(*given, devices=devices)
        instants = both.filtered.instants._replace(updated=both.smoothed)
        output = both.filtered._replace(instants=instants)
    else:
        output = ekf.run_filter_batch(*given, devices=devices)
    return output, evaluate_outputs(model, every, output)


def evaluate_outputs(
    model: Model, params: Parameters, output: FilterOutput
) -> dict[str, tuple[Any, Array]]:
    """Value and covariance of each output of the model by name, with leading axes (runs, K, S)."""

    def one(params: Parameters, belief: Belief, u: Any) -> dict[str, tuple[Any, Array]]:
        values = {}
        for out in model.outputs:
            value = out.value(belief.mean, u, params)

            def error(delta: Array, out: Any = out, value: Any = value) -> Array:
                change = manifold.lift(model.space, belief.mean, delta)
                moved = jax.jvp(lambda x: out.value(x, u, params), (belief.mean,), (change,))[1]
                return manifold.lower(out.space, value, moved)

            jacobian = jax.vmap(error, out_axes=1)(jnp.eye(model.error_dim))
            cov = jacobian @ belief.cov @ jacobian.T
            if out.noise is not None:
                cov = cov + out.noise(u, params)
            values[out.name] = (value, 0.5 * (cov + cov.T))
        return values

    over_steps = jax.vmap(jax.vmap(one, in_axes=(None, 0, 0)), in_axes=(None, 0, 0))
    return jax.vmap(over_steps)(params, output.instants.updated, output.inputs)


def _check(model: Model, line: Timeline, output: FilterOutput) -> None:
    """Raise `FilterError` for the first substep whose covariance is not finite and positive definite."""
    epochs, substeps = line.time_ns.shape
    healthy = np.asarray(output.instants.healthy)[:epochs, -substeps:]
    broken = np.argwhere(~healthy & line.valid)
    if broken.size == 0:
        return
    k, s = (int(i) for i in broken[0])
    seconds = (line.time_ns[k, s] - line.time_ns[0, -1]) / NANOSECONDS
    place = _failed_update(line, output, k, s)
    raise FilterError(
        f"run '{line.name}': got a covariance that is not finite and definite at step {k * substeps + s},"
        f" {seconds:.6f} s, {place} of model"
        f" '{model.name}', expected a definite one; look for noise that is zero, negative or not finite, or"
        " for wrong units, gravity_ref or frames in recording.toml (jaxekf check finds some of these)"
    )


def _failed_update(line: Timeline, output: FilterOutput, k: int, s: int) -> str:
    """The part of a failed substep that failed: the prediction, or the update by its sensors."""
    epochs, substeps = line.time_ns.shape
    beliefs: Any = output.instants.predicted
    predicted = np.asarray(beliefs.cov)[:epochs, -substeps:][k, s].diagonal()
    if not np.all(np.isfinite(predicted) & (predicted >= 0.0)):
        return "in the prediction"
    used = []
    for name in model_sensors(line):
        rows = np.asarray(output.innovations[name].used)
        fast = name in line.steps.fast
        here = rows[:epochs, -substeps:][k, s] if fast else rows[k] & (s == substeps - 1)
        if here.any():
            used.append(name)
    return f"in the update by sensor {' and '.join(used)}"
