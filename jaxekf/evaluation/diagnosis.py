"""Can an estimate be believed? Innovations and errors against what they are said to be, and why not.

`diagnose` judges one run, `diagnose_many` several with the same model and noise together. Innovations
tell without any truth: they are white, and as large as their covariance, where the filter is right.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from jaxekf._support import chi_square
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
    in_order,
    judge_fault,
    judge_part,
    judge_sensor,
    named_faults,
    too_few,
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
    """What the innovations of one sensor tell."""

    nis: Consistency
    """Gated samples count."""
    whiteness: Whiteness
    faults: tuple[Fault, ...]
    """Latency, gyroscope bias and matrix with their uncertainties, certain or not; of sensors of an
    attitude only."""


@dataclass(frozen=True)
class Diagnosis:
    """What was found on one run, or on several together."""

    runs: tuple[str, ...]
    sensors: dict[str, SensorDiagnosis]
    parts: dict[str, Consistency]
    """NEES of those outputs (attitude, rate, position, velocity) of which an encoder tells the truth."""
    verdicts: tuple[Verdict, ...]
    """What is wrong; empty where nothing speaks against the estimate."""
    notes: tuple[str, ...]
    """What could not be judged, and why."""

    def sentences(self) -> tuple[str, ...]:
        """Verdicts for a person; where there are none, the numbers that speak for the estimate."""
        if self.verdicts:
            return tuple(str(verdict) for verdict in self.verdicts)
        told = [in_order(f"NIS of {n}", s.nis) for n, s in self.sensors.items() if s.nis.samples]
        told += [
            in_order(f"NEES of {name}", part) for name, part in self.parts.items() if part.samples
        ]
        return (f"nothing speaks against it: {'; '.join(told)}",) if told else ()

    def as_dict(self, *, curves: bool = False) -> dict[str, Any]:
        """For JSON. With `curves` also the autocorrelation (rows, L) at each lag and its bound, rounded."""
        return {
            "runs": list(self.runs),
            "verdicts": [_plain(verdict, curves) for verdict in self.verdicts],
            "notes": list(self.notes),
            "sensors": {name: _plain(sensor, curves) for name, sensor in self.sensors.items()},
            "parts": {name: _plain(part, curves) for name, part in self.parts.items()},
        }


def diagnose(estimate: Estimate, recording: Recording | None = None) -> Diagnosis:
    """Judge one estimate by its innovations and, with a recording that has an encoder, by its errors.

    Errors count at those instants whose nearest encoder sample is scored, as in `jaxekf.score`. Works for
    every model; latency, gyroscope bias and matrix are looked for where a sensor measures an attitude and
    the model puts out `attitude` and `rate`.

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
    """As `diagnose`, of several runs together: smaller faults are found, each run keeping its own bias.

    Raises `ValueError` for no estimates, for excerpts (`Estimate.requested`), or other recordings than the
    estimates' own.
    """
    _check(estimates, recordings)
    names = list(dict.fromkeys(name for made in estimates for name in made.sensors))
    sensors, verdicts, notes = {}, [], []
    for name in names:
        sensors[name], said = _judge_sensor(name, [e for e in estimates if name in e.sensors])
        if note := too_few(name, sensors[name].nis):
            notes.append(note)
        else:
            verdicts += said
    parts = {}
    for name, squares in _errors(estimates, recordings or []).items():
        parts[name] = judge_squares(squares, [np.full(len(s), 3) for s in squares])
        if note := too_few(f"NEES of {name}", parts[name], truth=True):
            notes.append(note)
        else:
            verdicts += judge_part(name, parts[name])
    runs = tuple(made.run for made in estimates)
    return Diagnosis(runs, sensors, parts, tuple(verdicts), tuple(notes))


def _check(estimates: Sequence[Estimate], recordings: Sequence[Recording] | None) -> None:
    if not estimates:
        raise ValueError(
            "got no estimates, expected at least one; pass those of jaxekf.estimate_many"
        )
    if excerpts := [made.run for made in estimates if made.excerpt]:
        raise ValueError(
            f"got requested times of {excerpts} only, expected whole estimates, whose states the"
            " innovations are compared with; pass the estimates that they are a part of"
        )
    if recordings is not None:
        runs, given = [made.run for made in estimates], [r.name for r in recordings]
        if runs != given:
            raise ValueError(
                f"got recordings {given} for estimates of {runs}, expected the same runs in the same"
                " order; pass each estimate's own recording"
            )


def _judge_sensor(
    name: str, estimates: Sequence[Estimate]
) -> tuple[SensorDiagnosis, list[Verdict]]:
    """Statistics of one sensor over several runs, and verdicts on them."""
    records = [made.sensors[name] for made in estimates]
    freedom = [(r.used | r.gated).sum(axis=1) for r in records]
    nis = judge_squares([r.nis for r in records], freedom)
    white = [whiten(r.residual, r.cov, r.used) for r in records]
    times = [r.time_ns for r in records]
    whiteness = judge_whiteness(times, white)
    each = [find_faults(made, name) for made in estimates]
    known = [found for found in each if found is not None and found.rows]
    faults = _pooled(known)
    diagnosis = SensorDiagnosis(nis, whiteness, faults)
    named = named_faults(faults)
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
    """Faults of several runs as one: latency and matrix shared, the bias each run's own."""
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
    """Normalised squares of the errors of each output of which there is truth, run by run."""
    found: dict[str, list[Floats]] = {}
    for made, recording in zip(estimates, recordings, strict=False):
        if recording.encoder is None:
            continue
        for name, error in scored_errors(made, recording).items():
            kept: Flags = np.asarray(np.isfinite(error).all(axis=1))
            squares = normalised_square(error[kept], made.outputs[name].cov[kept])
            found.setdefault(name, []).append(squares)
    return found


def _plain(node: Any, curves: bool) -> Any:
    """A dataclass as what JSON knows; curves rounded, or left out."""
    if isinstance(node, Consistency | Whiteness | Fault | Verdict | SensorDiagnosis):
        named = {f.name: getattr(node, f.name) for f in fields(node)}
        for name in (name for name in _CURVES if name in named):
            curve = named.pop(name)
            if curves:
                named[name] = np.round(curve, _CURVE_DECIMALS)
        return {key: _plain(value, curves) for key, value in named.items()}
    if isinstance(node, np.ndarray):
        return node.tolist()
    return [_plain(item, curves) for item in node] if isinstance(node, tuple) else node
