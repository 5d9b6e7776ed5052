"""Arrays of the filter made into an `Estimate`: samples, account, notes and outputs of one run."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from jaxekf.estimation.result import Estimate, OutputEstimate, SensorRecord
from jaxekf.estimation.timeline import Timeline
from jaxekf.estimation.versions import provenance
from jaxekf.filtering.ekf import FilterOutput
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.geometry import manifold
from jaxekf.io.hashes import inputs
from jaxekf.recordings.types import NANOSECONDS, Recording

_HIGH_REJECTION = 0.2
"""Fraction of a sensor's samples; a note warns if the gate rejects more."""


def _count_rejected(record: SensorRecord, copies: int) -> int:
    """Number of samples that the gate rejected; of a sensor with `copies` groups, number of groups."""
    gated, used = (
        # The width is explicit, because NumPy cannot infer it for an array without samples.
        flags.reshape(len(flags) * copies, flags.shape[1] // copies).any(axis=1)
        for flags in (np.asarray(record.gated), np.asarray(record.used))
    )
    return int((gated & ~used).sum())


def model_sensors(line: Timeline) -> list[str]:
    """Names of all sensors of a timeline."""
    return [*line.steps.fast, *line.steps.slow]


def as_estimate(
    model: Model,
    params: Parameters,
    recording: Recording,
    line: Timeline,
    output: FilterOutput,
    outputs: dict[str, Any],
    *,
    smooth: bool,
) -> Estimate:
    """The estimate of one run from the filter's arrays, without padding."""
    epochs, substeps = line.time_ns.shape
    valid = line.valid

    def flat(array: Any) -> Any:
        return np.asarray(array)[:epochs, -substeps:][valid]

    belief: Belief = jax.tree.map(flat, output.instants.updated)
    sensors, account = {}, {name: dict(count) for name, count in line.account.items()}
    warnings: tuple[str, ...] = ()
    for name in model_sensors(line):
        fast = name in line.steps.fast
        rows = (line.steps.fast if fast else line.steps.slow)[name]
        record = _sensor_record(output.innovations[name], rows, line, fast)
        sensors[name] = record
        if record.weight is not None and (low_weight := _count_downweighted(record)):
            warnings += (
                f"{low_weight} of {len(record.time_ns)} samples of {name} have a robust weight below 0.5"
                " because of large innovations",
            )
        if name in account:
            rejected = _count_rejected(record, model.sensor(name).copies)
            account[name]["gated"] = rejected
            fed = account[name].pop("fed")
            account[name]["used"] = fed - rejected
            if rejected > _HIGH_REJECTION * fed:
                warnings += (
                    f"the gate rejected {rejected} of {fed} samples of {name}, far more than by chance:"
                    " look for wrong noise, geometry, names, units or latency",
                )
    for count in account.values():
        if "fed" in count:
            count["used"] = count.pop("fed")
    notes = line.notes + warnings
    if output.instants.recovered is not None and (opened := flat(output.instants.recovered)).any():
        at = (line.time_ns[valid][opened] - line.time_ns[valid][0]) / NANOSECONDS
        notes += (
            f"at {', '.join(f'{t:.3f}' for t in at[:5])} s{' and later' if len(at) > 5 else ''} all samples"
            f" had contradicted the estimate for {model.gate_reset_after_s} s and the covariance was"
            f" increased, {len(at)} times: look for wrong poses before, or for noise that is too small",
        )
    if smooth:
        notes += ("smoothed: each instant is estimated from the whole run",)
    total = float(flat(output.instants.log_likelihood).sum())
    estimated = Estimate(
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
        # Absolute, so that the report finds it from any working folder.
        provenance=provenance()
        | {
            "recording": str(recording.path.resolve() if recording.path else recording.name),
            "inputs": inputs(recording),
            "intake": {label: read.as_dict() for label, read in recording.intake.items()},
        },
    )
    if line.requested_ns is not None and line.measured_ns is not None:
        measured = np.isin(estimated.time_ns, line.measured_ns)
        estimated = estimated.split(measured, line.requested_ns)
    return on_clock(estimated, line)


def on_clock(made: Estimate, line: Timeline) -> Estimate:
    """An estimate at instants of a timeline, with its times on the timeline's `Timeline.clock`."""
    sensors = {
        name: replace(record, time_ns=line.on_clock(record.time_ns))
        for name, record in made.sensors.items()
    }
    start = None if made.start_ns is None else int(line.on_clock(np.array([made.start_ns]))[0])
    return replace(
        made,
        time_ns=line.on_clock(made.time_ns),
        sensors=sensors,
        start_ns=start,
        clock=line.clock,
        requested=None if made.requested is None else on_clock(made.requested, line),
    )


def named_outputs(model: Model, outputs: Mapping[str, Any]) -> dict[str, OutputEstimate]:
    """The model's outputs with frames and units."""
    named = {}
    for name, (value, cov) in outputs.items():
        out = model.output(name)
        named[name] = OutputEstimate(value, cov, out.frame, manifold.error_units(out.space)[0])
    return named


def _sensor_record(innovation: Any, rows: Any, line: Timeline, fast: bool) -> SensorRecord:
    """One sensor's innovations at the instants of its visible samples."""
    epochs, substeps = line.time_ns.shape
    parts = jax.tree.map(
        lambda a: np.asarray(a)[:epochs, -substeps:] if fast else np.asarray(a)[:epochs], innovation
    )
    times = line.time_ns if fast else line.time_ns[:, -1]
    seen = np.asarray(rows.mask).any(axis=-1)
    kept: Any = [None if part is None else part[seen] for part in parts]
    return SensorRecord(times[seen], *kept)


def _count_downweighted(record: SensorRecord) -> int:
    """Number of used samples with a robust weight below 0.5 in at least one row."""
    assert record.weight is not None
    return int(((record.weight < 0.5) & record.used).any(axis=1).sum())
