"""A tuning as one plain document, `tuning.json`: what a report needs, without runs, model or filter."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import jax
import numpy as np

from jaxekf._support.errors import TuningError
from jaxekf.estimation.parameters import leaf_names
from jaxekf.io.documents import codec
from jaxekf.io.documents.tuning import TuningDocument
from jaxekf.io.run_folder import SCHEMA_VERSION
from tuning.comparison.compare import Row, as_dicts
from tuning.objective.fisher_information import interval
from tuning.parametrisation.free_vector import SCALED, Leaf
from tuning.parametrisation.truth_frame import TRUTH_UNITS
from tuning.persistence._tuning_warnings import cautions

if TYPE_CHECKING:  # Both come after this module, which `Tuned.save` needs.
    from tuning._tune import Tuned
    from tuning.comparison.cross_validation import CrossValidation

FILE = "tuning.json"
JudgedOn = Literal["validation runs", "training runs", "other runs"]
"""Which runs are compared; those of neither kind are ``other runs``."""
_SAID = (
    "runs",
    "validation_runs",
    "objective",
    "iterations",
    "best_iteration",
    "training_value",
    "validation_value",
    "covariance_scale",
    "date",
    "left_open",
)
"""What of the origin stands elsewhere in the document."""


def record(
    tuned: "Tuned",
    *,
    rows: Sequence[Row] = (),
    judged_on: JudgedOn | None = None,
    folds: "CrossValidation | None" = None,
) -> dict[str, Any]:
    """A tuning for JSON: SI units, None for what is not known, ``warnings`` in sentences.

    `rows` are those of `compare` with the variants ``start`` and ``tuned``; `judged_on` says of which runs
    they are, and is told by their names unless given. `folds` come from `cross_validate`. ``numbers`` holds
    each free number: ``tuned`` and ``interval`` (95 %) before the common scale of all covariances,
    ``written`` as it stands in the parameter files; ``change`` is a factor for logarithms, else in
    deviations of the prior. ``history`` has the values of the objective, step by step, of
    the best of several ``starts``.

    Raises `TuningError` where `judged_on` contradicts the names of the runs.
    """
    origin = tuned.origin
    found: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "kind": "jaxekf tuning",
        "model": tuned.model.name,
        "objective": tuned.objective.describe(),
        "errors": [name for name, _ in tuned.objective.errors],
        "runs": list(origin.get("runs", [])),
        "validation_runs": list(origin.get("validation_runs", [])),
        "date": origin.get("date"),
        "provenance": {key: value for key, value in origin.items() if key not in _SAID},
        "tuning": tuned.digest,
        "inputs": tuned.inputs,
        "stopped": tuned.stopped,
        "evaluations": int(tuned.evaluations),
        "rejected_steps": int(tuned.rejections),
        "covariance_scale": float(tuned.scale),
        "also_scaled": _also_scaled(tuned),
        "history": [
            {
                "number": int(step.number),
                "training": float(step.training),
                "validation": float(step.validation),
                "rejected": bool(step.rejected),
            }
            for step in tuned.history
        ],
        "best_iteration": int(tuned.best.number),
        "starts": [outcome._asdict() for outcome in tuned.starts],
        "numbers": _numbers(tuned),
        "units": _units(tuned),
        "truth": _truth(tuned),
        "judged_on": _judged_on(tuned, rows, judged_on),
        "rows": as_dicts(rows),
        "folds": None if folds is None else folds.as_dict(),
    }
    found = codec.plain(found)
    return found | {"warnings": cautions(found)}


def save_record(
    folder: Path | str,
    tuned: "Tuned",
    *,
    rows: Sequence[Row] = (),
    judged_on: JudgedOn | None = None,
    folds: "CrossValidation | None" = None,
) -> Path:
    """Write `record` as `tuning.json` into a folder, whole or not at all; an earlier one is replaced.

    Raises `RecordingError` where a folder is of that name, and what `record` raises.
    """
    return write_record(folder, record(tuned, rows=rows, judged_on=judged_on, folds=folds))


def write_record(folder: Path | str, document: Mapping[str, Any]) -> Path:
    """Write the document of `record` as `save_record` does."""
    file = Path(folder) / FILE
    codec.write(file, codec.convert(document, TuningDocument))
    return file


def _judged_on(tuned: "Tuned", rows: Sequence[Row], said: JudgedOn | None) -> JudgedOn | None:
    names = {row.run for row in rows}
    if not names:
        return None
    kind: JudgedOn = "other runs"
    if names & set(tuned.origin.get("runs", [])):
        kind = "training runs"
    elif names & set(tuned.origin.get("validation_runs", [])):
        kind = "validation runs"
    if said is not None and said != kind:
        raise TuningError(
            f"got rows judged on '{said}' of {sorted(names)}, expected '{kind}' as the runs of the tuning"
            " say; compare other runs, or leave judged_on out"
        )
    return kind


def _units(tuned: "Tuned") -> dict[str, str]:
    """The unit of each free parameter, by its name."""
    every = tuned.model.units._replace(truth=TRUTH_UNITS)
    units = dict(zip(leaf_names(every), jax.tree.leaves(every), strict=True))
    return {leaf.name: units[leaf.name] for leaf in tuned.layout.leaves}


def _also_scaled(tuned: "Tuned") -> list[str]:
    """Noise and initial belief that were not free, where the common scale changed them."""
    if tuned.scale == 1.0:
        return []
    free = {leaf.name for leaf in tuned.layout.leaves}
    return [
        name for name in leaf_names(tuned.params) if name.startswith(SCALED[0]) and name not in free
    ]


def _truth(tuned: "Tuned") -> dict[str, Any] | None:
    """How the encoder lies to the tracker, where that was free."""
    if tuned.truth is None:
        return None
    units = TRUTH_UNITS._asdict()
    return {
        name: {"value": np.asarray(value, float).tolist(), "unit": units[name]}
        for name, value in tuned.truth._asdict().items()
    }


def _numbers(tuned: "Tuned") -> list[dict[str, Any]]:
    """Each free number: where it began, where it ended, and how well it is known."""
    where, units = tuned.layout, _units(tuned)
    labels, moved = where.labels(), tuned.moved
    start, end = np.asarray(where.to_free(tuned.start)), np.asarray(tuned.free)
    first = interval(where, start, np.zeros(len(start)))
    last = interval(where, end, np.zeros(len(end)))
    known, told, runs = tuned.intervals, tuned.open, tuned.origin.get("runs", [])
    found, at = [], 0
    for leaf in where.leaves:
        for i in range(leaf.size):
            label, logarithm = labels[at], leaf.is_logarithm(i)
            run = i // leaf.each
            change = leaf.straight(end[at], i) - leaf.straight(start[at], i)
            scales = logarithm and leaf.name.startswith(SCALED)
            ends = known.get(label)
            found.append(
                {
                    "label": label,
                    "name": label.split(" of run ")[0],
                    "run": (runs[run] if run < len(runs) else str(run)) if leaf.runs else None,
                    "truth": leaf.name.startswith("truth."),
                    "unit": units[leaf.name] if logarithm or leaf.kind == "linear" else "1",
                    "logarithm": logarithm,
                    "start": first[at][0],
                    "tuned": last[at][0],
                    "interval": None if ends is None else list(ends[1:]),
                    "written": last[at][0] * (np.sqrt(tuned.scale) if scales else 1.0),
                    "moved": moved[at],
                    "change": float(np.exp(change)) if logarithm else change / leaf.prior,
                    "left_open": label in told,
                    "would_tell": told.get(label),
                    "bounds": _bounds(leaf),
                }
            )
            at += 1
    return found


def _bounds(leaf: Leaf) -> list[float] | None:
    """Bounds in the parameter's unit."""
    if leaf.bounds is None:
        return None
    if leaf.kind == "log":
        return [float(np.exp(bound)) for bound in leaf.bounds]
    return [bound * leaf.step for bound in leaf.bounds]
