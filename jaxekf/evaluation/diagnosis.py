"""Diagnosis of an estimate: consistency of innovations and errors, and the cause of an inconsistency.

`diagnose` judges one run, `diagnose_many` several with the same model and noise together. Innovations need
no ground truth: for a consistent filter they are white and match their covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from jaxekf._support import arrays, chi_square
from jaxekf._support.errors import ArgumentError
from jaxekf.estimation.result import Estimate
from jaxekf.evaluation._fault_signatures import (
    BIAS,
    LATENCY,
    MATRIX,
    Faults,
    attitude_rows,
    find_faults,
)
from jaxekf.evaluation.consistency import (
    Consistency,
    Whiteness,
    judge_squares,
    judge_whiteness,
    whiten,
)
from jaxekf.evaluation.metrics import normalised_square, scored_errors
from jaxekf.evaluation.verdicts import (
    Fault,
    Verdict,
    insufficient_samples,
    judge_fault,
    judge_part,
    judge_sensor,
    significant_faults,
    summary_line,
)
from jaxekf.geometry import manifold
from jaxekf.recordings.types import Flags, Floats, Recording

_KINDS = {
    "latency": (LATENCY, "s"),
    "gyroscope_bias": (BIAS, "rad/s"),
    "gyroscope_matrix": (MATRIX, "1"),
}
_CURVES = ("lag_s", "autocorrelation", "bound")
_CURVE_DECIMALS = 5


@dataclass(frozen=True)
class SensorDiagnosis:
    """Statistics of the innovations of one sensor.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5")
    >>> optical = jaxekf.diagnose(estimate).sensors["optical"]
    >>> print(f"NIS {optical.nis.mean:.2f}, scale {optical.whiteness.scale.mean():.2f}")
    NIS 0.98, scale 0.99
    >>> for fault in optical.faults:
    ...     print(fault.kind, "significant" if fault.p < 1e-3 else "not significant")
    latency not significant
    gyroscope_bias not significant
    gyroscope_matrix not significant
    """

    nis: Consistency
    """Normalised innovation squared; gated samples are included."""
    whiteness: Whiteness
    """Whitened innovations: autocorrelation, mean and scale of each row."""
    faults: tuple[Fault, ...]
    """Latency, gyroscope bias and matrix with their uncertainties, significant or not; attitude sensors
    only."""


@dataclass(frozen=True)
class Diagnosis:
    """Findings on one run, or on several together.

    Examples
    --------
    A run without faults, judged by its innovations and by the encoder:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> diagnosis = jaxekf.diagnose(jaxekf.estimate(run), run)
    >>> len(diagnosis.verdicts), list(diagnosis.sensors), list(diagnosis.parts)
    (0, ['optical'], ['attitude', 'rate'])
    >>> print(diagnosis.sentences()[0].partition(" (")[0])
    no inconsistency found: NIS of optical 0.98
    """

    runs: tuple[str, ...]
    """Names of the runs."""
    sensors: dict[str, SensorDiagnosis]
    """Statistics of the innovations, by sensor."""
    parts: dict[str, Consistency]
    """NEES of the outputs (attitude, rate, position, velocity) for which an encoder provides ground
    truth."""
    verdicts: tuple[Verdict, ...]
    """Inconsistencies; empty if none was found."""
    notes: tuple[str, ...]
    """Statistics that could not be judged, with the reason."""

    def sentences(self) -> tuple[str, ...]:
        """Verdicts as sentences; without any, one sentence with the statistics."""
        if self.verdicts:
            return tuple(str(verdict) for verdict in self.verdicts)
        lines = [
            summary_line(f"NIS of {n}", s.nis) for n, s in self.sensors.items() if s.nis.samples
        ]
        lines += [
            summary_line(f"NEES of {name}", part)
            for name, part in self.parts.items()
            if part.samples
        ]
        return (f"no inconsistency found: {'; '.join(lines)}",) if lines else ()

    def as_dict(self, *, curves: bool = False) -> dict[str, Any]:
        """For JSON; with `curves` also the autocorrelation (rows, L) at each lag and its bound, rounded."""
        return {
            "runs": list(self.runs),
            "verdicts": [_json_value(verdict, curves) for verdict in self.verdicts],
            "notes": list(self.notes),
            "sensors": {name: _json_value(sensor, curves) for name, sensor in self.sensors.items()},
            "parts": {name: _json_value(part, curves) for name, part in self.parts.items()},
        }


def diagnose(estimate: Estimate, recording: Recording | None = None) -> Diagnosis:
    """Judge one estimate by its innovations and, with an encoder, by its errors.

    Errors count at instants whose nearest encoder sample is scored, as in `jaxekf.score`. The
    function works for every model; latency, gyroscope bias and matrix are estimated if a sensor
    measures an attitude and the model has the outputs `attitude` and `rate`.

    Parameters
    ----------
    estimate
        Estimate of a whole run.
    recording
        The run, if it has an encoder.

    Returns
    -------
    Diagnosis
        Verdicts, each with size, unit and standard deviation, and the statistics behind them.

    Raises
    ------
    ArgumentError
        As `diagnose_many`.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> optical = run.need_optical()
    >>> late = run.replace(optical=replace(optical, time_ns=optical.time_ns + 20_000_000))
    >>> [verdict.kind for verdict in jaxekf.diagnose(jaxekf.estimate(late)).verdicts]
    ['latency']
    """
    return diagnose_many([estimate], None if recording is None else [recording])


def diagnose_many(
    estimates: Sequence[Estimate], recordings: Sequence[Recording] | None = None
) -> Diagnosis:
    """Judge several runs together, which finds smaller faults; each run keeps its own bias.

    Parameters
    ----------
    estimates
        Estimates of whole runs by one model.
    recordings
        Their recordings in the same order, if they have encoders.

    Returns
    -------
    Diagnosis
        Verdicts on all runs together, each with size, unit and standard deviation.

    Raises
    ------
    ArgumentError
        For no estimates, for excerpts (`Estimate.requested`), and for recordings that are not those of the
        estimates.

    Examples
    --------
    Two runs together find a latency with a smaller standard deviation than one:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimates = jaxekf.estimate_many(jaxekf.demo.paths(("free-4", "free-5")))
    >>> one, both = jaxekf.diagnose_many(estimates[:1]), jaxekf.diagnose_many(estimates)
    >>> one.runs, both.runs
    (('free-4',), ('free-4', 'free-5'))
    >>> first, second = (found.sensors["optical"].faults[0] for found in (one, both))
    >>> first.kind, second.sigma[0] < first.sigma[0]
    ('latency', True)
    """
    _check(estimates, recordings)
    names = list(dict.fromkeys(name for estimate in estimates for name in estimate.sensors))
    sensors, verdicts, notes = {}, [], []
    for name in names:
        sensors[name], found = _judge_sensor(name, [e for e in estimates if name in e.sensors])
        if note := insufficient_samples(name, sensors[name].nis):
            notes.append(note)
        else:
            verdicts += found
    parts = {}
    for name, squares in _errors(estimates, recordings or []).items():
        parts[name] = judge_squares(squares, [np.full(len(s), 3) for s in squares])
        if note := insufficient_samples(f"NEES of {name}", parts[name], truth=True):
            notes.append(note)
        else:
            verdicts += judge_part(name, parts[name])
    runs = tuple(estimate.run for estimate in estimates)
    return Diagnosis(runs, sensors, parts, tuple(verdicts), tuple(notes))


def _check(estimates: Sequence[Estimate], recordings: Sequence[Recording] | None) -> None:
    if not isinstance(estimates, Sequence) or not estimates:
        raise ArgumentError(
            "got no estimates, expected at least one; pass the result of jaxekf.estimate_many"
        )
    for estimate in estimates:
        arrays.need(estimate, Estimate, "estimate", "the result of jaxekf.estimate")
    for recording in recordings or ():
        arrays.need(recording, Recording, "recording", "jaxekf.load(path)")
    if excerpts := [estimate.run for estimate in estimates if estimate.excerpt]:
        raise ArgumentError(
            f"got requested times of {excerpts} only, expected whole estimates, whose states belong"
            " to the innovations; pass the estimates before the selection of times"
        )
    if recordings is not None:
        runs, given = [estimate.run for estimate in estimates], [r.name for r in recordings]
        if runs != given:
            raise ArgumentError(
                f"got recordings {given} for estimates of {runs}, expected the same runs in the same"
                " order; pass each estimate's own recording"
            )


def _judge_sensor(
    name: str, estimates: Sequence[Estimate]
) -> tuple[SensorDiagnosis, list[Verdict]]:
    """Statistics of one sensor over several runs, and verdicts on them."""
    records = [estimate.sensors[name] for estimate in estimates]
    freedom = [(r.used | r.gated).sum(axis=1) for r in records]
    nis = judge_squares([r.nis for r in records], freedom)
    white = [whiten(r.residual, r.cov, r.used) for r in records]
    times = [r.time_ns for r in records]
    whiteness = judge_whiteness(times, white)
    each = [find_faults(estimate, name) for estimate in estimates]
    known = [found for found in each if found is not None and found.rows]
    faults = _pooled(known)
    diagnosis = SensorDiagnosis(nis, whiteness, faults)
    named = significant_faults(faults)
    verdicts = [judge_fault(name, nis, fault) for fault in named]
    if named:
        rows = attitude_rows(estimates[0], name)
        for i, found in enumerate(each):
            if found is not None and rows is not None:
                white[i] = white[i].copy()
                white[i][:, rows] = found.left
        left = [np.nansum(w**2, axis=1) for w in white]
        nis = judge_squares(left, [np.isfinite(w).sum(axis=1) for w in white])
        whiteness = judge_whiteness(times, white)
    labels = manifold.error_labels(estimates[0].model.sensor(name).space)
    memory = float(np.median([found.memory_s for found in known])) if known else None
    rest = judge_sensor(name, nis, whiteness, labels=labels, memory_s=memory, explained=named)
    return diagnosis, verdicts + rest


def _pooled(found: Sequence[Faults]) -> tuple[Fault, ...]:
    """Faults of several runs combined: latency and matrix are shared, the bias is per run."""
    if not found:
        return ()
    total = sum(each.rows for each in found)
    faults = []
    for kind, (part, unit) in _KINDS.items():
        if not all(part in each.judged for each in found):
            continue
        weights = [np.linalg.inv(each.cov[part, part]) for each in found]
        cov = np.linalg.inv(np.sum(weights, axis=0))
        sizes = [each.size[part] for each in found]
        size = cov @ np.sum([w @ s for w, s in zip(weights, sizes, strict=True)], axis=0)
        square, freedom = float(size @ np.linalg.solve(cov, size)), len(size)
        if part == BIAS:
            square, freedom = sum(each.wald(part) for each in found), freedom * len(found)
        effect = np.sqrt(sum(each.rows * each.effect(part) ** 2 for each in found) / total)
        sigma = np.sqrt(np.diagonal(cov))
        p = float(chi_square.sf(square, freedom))
        faults.append(
            Fault(kind, tuple(size.tolist()), tuple(sigma.tolist()), unit, p, float(effect))
        )
    return tuple(faults)


def _errors(
    estimates: Sequence[Estimate], recordings: Sequence[Recording]
) -> dict[str, list[Floats]]:
    """Normalised squares of the errors of each output with ground truth, run by run."""
    found: dict[str, list[Floats]] = {}
    for estimate, recording in zip(estimates, recordings, strict=False):
        if recording.encoder is None:
            continue
        for name, error in scored_errors(estimate, recording).items():
            kept: Flags = np.asarray(np.isfinite(error).all(axis=1))
            squares = normalised_square(error[kept], estimate.outputs[name].cov[kept])
            found.setdefault(name, []).append(squares)
    return found


def _json_value(node: Any, curves: bool) -> Any:
    """A dataclass as JSON values; curves rounded or left out."""
    if isinstance(node, Consistency | Whiteness | Fault | Verdict | SensorDiagnosis):
        named = {f.name: getattr(node, f.name) for f in fields(node)}
        for name in (name for name in _CURVES if name in named):
            curve = named.pop(name)
            if curves:
                named[name] = np.round(curve, _CURVE_DECIMALS)
        return {key: _json_value(value, curves) for key, value in named.items()}
    if isinstance(node, np.ndarray):
        return node.tolist()
    return [_json_value(item, curves) for item in node] if isinstance(node, tuple) else node
