"""From recorded runs to estimates: the host's side of the filter."""

from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support import memory
from jaxekf._support.compilation import jit
from jaxekf._support.errors import FilterError, PrecisionError
from jaxekf.estimation import padding, parameters, timeline
from jaxekf.estimation.output_times import Every, Requested
from jaxekf.estimation.result import Estimate, OutputEstimate, SensorRecord
from jaxekf.estimation.timeline import Timeline
from jaxekf.filtering import ekf, smoother
from jaxekf.filtering.ekf import FilterOutput
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Steps
from jaxekf.geometry import manifold
from jaxekf.io import run_folder
from jaxekf.io.hashes import inputs
from jaxekf.models import adapted, get_model
from jaxekf.recordings.types import NANOSECONDS, Recording

Run = Recording | Path | str
_BATCH_BYTES = 1 << 30
_MANY_REFUSED = 0.2
"""A gate that refuses a larger share of a sensor's samples is worth a word."""


def require_float64() -> None:
    """Raise `PrecisionError` where JAX is not set to float64."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise PrecisionError(
            "got JAX in float32, expected float64; call jaxekf.set_up() before the first array, or set"
            " JAX_ENABLE_X64=1"
        )


def estimate(
    run: Run,
    model: str | Model = "loose",
    params: Parameters | None = None,
    *,
    smooth: bool = False,
    at: Requested | None = None,
) -> Estimate:
    """Estimate one run: a `Recording` or the path of a recorded folder.

    `model` is a name, ``module:attribute`` or a `Model`; `params` are the model's defaults unless
    given (see `jaxekf.load_parameters`). Each instant is estimated from what was measured until then
    or, with `smooth`, from the whole run; innovations are those of the filter in both cases.

    The instants are those at which something was measured. `at` asks for others: times (N,) in int64
    nanoseconds on the recording's clock, or `jaxekf.every`; the estimate at these is `Estimate.requested`.

    Raises `RecordingError` for what is wrong with the data or where nothing of `at` lies within the run,
    `FilterError` where the recursion broke, `ResourceError` where memory is too small for it,
    `PrecisionError` in float32.
    """
    return estimate_many([run], model, params, smooth=smooth, at=at if at is None else [at])[0]


def estimate_many(
    runs: Sequence[Run],
    model: str | Model = "loose",
    params: Parameters | Sequence[Parameters] | None = None,
    *,
    smooth: bool = False,
    at: Sequence[Requested | None] | Every | None = None,
) -> list[Estimate]:
    """Estimate several runs side by side, with the same parameters or a list of each run's own; equal to
    one call for each.

    `at` has an entry for each run, or is one grid for all. Raises `ValueError` where it is neither, and
    what `estimate` raises.
    """
    require_float64()
    if isinstance(at, Every):
        at = [at] * len(runs)
    if at is not None and len(at) != len(runs):
        raise ValueError(
            f"got requested times for {len(at)} runs, expected as many as the {len(runs)} runs; pass an"
            " entry for each, None where nothing is asked for"
        )
    recordings = read(runs)
    chosen = adapted(get_model(model), recordings)
    timelines = timeline.build_many(chosen, recordings, at)
    used = _of_each(chosen.parameters if params is None else params, len(runs))
    results = filter_timelines(chosen, used, timelines, smooth=smooth)
    return [
        _collect(chosen, own, recording, line, *result, smooth=smooth)
        for own, recording, line, result in zip(used, recordings, timelines, results, strict=True)
    ]


def _of_each(params: Parameters | Sequence[Parameters], runs: int) -> list[Parameters]:
    """The parameters of each run, checked."""
    if isinstance(params, Parameters):
        shared = parameters.as_arrays(params._replace(truth=()))
        parameters.check(shared)
        return [shared] * runs
    if len(params) != runs:
        raise ValueError(
            f"got parameters for {len(params)} runs, expected as many as the {runs} runs; pass a set for"
            " each, or one for all"
        )
    return [_of_each(own, 1)[0] for own in params]


def read(runs: Sequence[Run]) -> list[Recording]:
    """The recordings of runs, those given as paths read from disk."""
    return [run if isinstance(run, Recording) else run_folder.load(run) for run in runs]


def filter_timelines(
    model: Model, params: Sequence[Parameters], lines: Sequence[Timeline], *, smooth: bool = False
) -> list[tuple[FilterOutput, dict[str, tuple[Array, Array]]]]:
    """Filter runs side by side, each with its parameters, and check each; with `smooth` the updated
    beliefs are the smoothed ones.

    Runs of like length are padded to a common one out of a few, so that few programs are compiled; more
    of them than fit into memory are taken one batch after the other.
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
            # The last batch is filled with the last run: another size would be another program.
            index = np.minimum(np.arange(start, start + size), len(members) - 1)
            given = jax.tree.map(lambda a, index=index: np.asarray(a)[index], (stacked, steps))
            devices = sharing_devices()
            names = [lines[i].name for i in members[start : start + size]]
            with memory.for_runs(names):
                found = jax.tree.map(np.asarray, _run(model, devices, smooth, *given))
            for place in range(min(size, len(members) - start)):
                one = jax.tree.map(lambda a, place=place: a[place], found)
                _check(model, lines[members[start + place]], one[0])
                results[members[start + place]] = one
    return [results[i] for i in range(len(lines))]


def _batch(model: Model, steps: Steps) -> int:
    """Number of runs to take at once."""
    _, epochs, substeps = steps.dt.shape
    size = 8 * epochs * substeps * 4 * model.error_dim * (model.error_dim + 4)
    return max(1, _BATCH_BYTES // size)


def sharing_devices() -> tuple[Any, ...]:
    """The CPU devices to share runs among; none where there is one only."""
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
        found = smoother.run_smoother_batch(*given, devices=devices)
        instants = found.filtered.instants._replace(updated=found.smoothed)
        output = found.filtered._replace(instants=instants)
    else:
        output = ekf.run_filter_batch(*given, devices=devices)
    return output, evaluate_outputs(model, every, output)


def evaluate_outputs(
    model: Model, params: Parameters, output: FilterOutput
) -> dict[str, tuple[Any, Array]]:
    """Value and covariance of each of the model's outputs, leading axes (runs, K, S)."""

    def one(params: Parameters, belief: Belief, u: Any) -> dict[str, tuple[Any, Array]]:
        found = {}
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
            found[out.name] = (value, 0.5 * (cov + cov.T))
        return found

    over_steps = jax.vmap(jax.vmap(one, in_axes=(None, 0, 0)), in_axes=(None, 0, 0))
    return jax.vmap(over_steps)(params, output.instants.updated, output.inputs)


def _check(model: Model, line: Timeline, output: FilterOutput) -> None:
    """Raise for the first substep at which the recursion broke."""
    epochs, substeps = line.time_ns.shape
    healthy = np.asarray(output.instants.healthy)[:epochs, -substeps:]
    broken = np.argwhere(~healthy & line.valid)
    if broken.size == 0:
        return
    k, s = (int(i) for i in broken[0])
    seconds = (line.time_ns[k, s] - line.time_ns[0, -1]) / NANOSECONDS
    blamed = _blame(line, output, k, s)
    raise FilterError(
        f"run '{line.name}': got a covariance that is not finite and definite at step {k * substeps + s},"
        f" {seconds:.6f} s, {blamed} of model"
        f" '{model.name}', expected a definite one; look for noise that is zero, negative or not finite, or"
        " for units, gravity_ref or frames that are not as stated (jaxekf check names what it can tell)"
    )


def _blame(line: Timeline, output: FilterOutput, k: int, s: int) -> str:
    """The sensors used at a broken substep, or the prediction where that was broken already."""
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


def _rejected(record: SensorRecord, copies: int) -> int:
    """Samples, or where they are made of like groups these, of which the gate let nothing in."""
    gated, used = (
        # The width is stated, as an array without samples has none that NumPy could work out.
        flags.reshape(len(flags) * copies, flags.shape[1] // copies).any(axis=1)
        for flags in (np.asarray(record.gated), np.asarray(record.used))
    )
    return int((gated & ~used).sum())


def model_sensors(line: Timeline) -> list[str]:
    """Names of all sensors of a timeline."""
    return [*line.steps.fast, *line.steps.slow]


def _collect(
    model: Model,
    params: Parameters,
    recording: Recording,
    line: Timeline,
    output: FilterOutput,
    outputs: dict[str, Any],
    *,
    smooth: bool,
) -> Estimate:
    """The filter's arrays without padding, in order of time."""
    epochs, substeps = line.time_ns.shape
    valid = line.valid

    def flat(array: Any) -> Any:
        return np.asarray(array)[:epochs, -substeps:][valid]

    belief: Belief = jax.tree.map(flat, output.instants.updated)
    sensors, account = {}, {name: dict(count) for name, count in line.account.items()}
    refused: tuple[str, ...] = ()
    for name in model_sensors(line):
        fast = name in line.steps.fast
        rows = (line.steps.fast if fast else line.steps.slow)[name]
        record = _sensor_record(output.innovations[name], rows, line, fast)
        sensors[name] = record
        if record.weight is not None and (little := _counts_little(record)):
            refused += (
                f"{little} of {len(record.time_ns)} samples of {name} count less than half, so far are they"
                " off",
            )
        if name in account:
            rejected = _rejected(record, model.sensor(name).copies)
            account[name]["gated"] = rejected
            fed = account[name].pop("fed")
            account[name]["used"] = fed - rejected
            if rejected > _MANY_REFUSED * fed:
                refused += (
                    f"the gate refused {rejected} of {fed} samples of {name}, far more than chance does:"
                    " look for wrong noise, geometry, names, units or latency",
                )
    for count in account.values():
        if "fed" in count:
            count["used"] = count.pop("fed")
    notes = line.notes + refused
    if output.instants.recovered is not None and (opened := flat(output.instants.recovered)).any():
        at = (line.time_ns[valid][opened] - line.time_ns[valid][0]) / NANOSECONDS
        notes += (
            f"at {', '.join(f'{t:.3f}' for t in at[:5])} s{' and later' if len(at) > 5 else ''} the gates"
            f" had refused everything for {model.gate_reset_after_s} s: the belief was widened, {len(at)}"
            " times; if these samples are good, the noise is too small for so strict a gate: tune it, or"
            " take weights instead (robust: huber)",
        )
    if smooth:
        notes += ("smoothed: every instant is estimated from the whole run",)
    total = float(flat(output.instants.log_likelihood).sum())
    made = Estimate(
        run=recording.name,
        model=model,
        time_ns=line.time_ns[valid],
        state=belief.mean,
        cov=np.asarray(belief.cov),
        outputs=named_outputs(model, jax.tree.map(flat, outputs)),
        sensors=sensors,
        log_likelihood=total,
        account=account,
        params=params._replace(setup=line.setup),
        notes=notes,
        smoothed=smooth,
        # Absolute, so that it is found again from another working folder.
        provenance=provenance()
        | {
            "recording": str(recording.path.resolve() if recording.path else recording.name),
            "inputs": inputs(recording),
            "intake": {label: read.as_dict() for label, read in recording.intake.items()},
        },
    )
    if line.requested_ns is None or line.measured_ns is None:
        return made
    return made.split(np.isin(made.time_ns, line.measured_ns), line.requested_ns)


def named_outputs(model: Model, outputs: Mapping[str, Any]) -> dict[str, OutputEstimate]:
    """Values and covariances of the model's outputs with their frames and units."""
    named = {}
    for name, (value, cov) in outputs.items():
        out = model.output(name)
        named[name] = OutputEstimate(value, cov, out.frame, manifold.error_units(out.space)[0])
    return named


def _sensor_record(innovation: Any, rows: Any, line: Timeline, fast: bool) -> SensorRecord:
    """One sensor's innovations at the instants at which it was sampled and seen."""
    epochs, substeps = line.time_ns.shape
    parts = jax.tree.map(
        lambda a: np.asarray(a)[:epochs, -substeps:] if fast else np.asarray(a)[:epochs], innovation
    )
    times = line.time_ns if fast else line.time_ns[:, -1]
    seen = np.asarray(rows.mask).any(axis=-1)
    kept: Any = [None if part is None else part[seen] for part in parts]
    return SensorRecord(times[seen], *kept)


def _counts_little(record: SensorRecord) -> int:
    """Used samples of which some row counts less than half."""
    assert record.weight is not None
    return int(((record.weight < 0.5) & record.used).any(axis=1).sum())


def provenance() -> dict[str, Any]:
    """Versions and settings that an estimate was made with."""
    names = ("jaxekf", "jax", "jaxlib", "numpy", "optax")
    return {
        "versions": {name: version(name) for name in names},
        "dtype": "float64",
        "backend": jax.default_backend(),
    }
