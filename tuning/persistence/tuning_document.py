"""The document `tuning.json`: all that a report of a tuning needs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxekf._support.errors import TuningError
from jaxekf.estimation.parameters import leaf_names, leaves_by_name
from jaxekf.io.documents import codec
from jaxekf.io.documents.tuning import TuningDocument
from jaxekf.io.run_folder import SCHEMA_VERSION
from tuning.objective.fisher_information import interval
from tuning.parametrisation.free_vector import SCALED
from tuning.parametrisation.leaf import Leaf
from tuning.parametrisation.truth_frame import TRUTH_UNITS
from tuning.persistence._tuning_warnings import cautions
from tuning.results.comparison import Row, as_dicts
from tuning.results.held_out import CrossValidation
from tuning.results.tuned import Tuned

FILE = "tuning.json"
JudgedOn = Literal["validation runs", "training runs", "other runs"]
"""Kind of the compared runs; ``other runs`` took no part in the tuning."""
_OWN_ENTRY = (
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
"""Parts of the origin that have an entry of their own in the document."""


def record(
    tuned: Tuned,
    *,
    rows: Sequence[Row] = (),
    judged_on: JudgedOn | None = None,
    folds: CrossValidation | None = None,
) -> dict[str, Any]:
    """A tuning for JSON, in SI units; unknown numbers are None, and ``warnings`` are sentences.

    `rows` come from `compare` with the variants ``start`` and ``tuned``, `folds` from `cross_validate`.
    `judged_on` is the kind of the rows' runs, found by their names unless given. ``numbers`` holds each
    free number: ``tuned`` and ``interval`` (95 %) before the common scale, ``written`` as in the parameter
    files; ``change`` is a factor for logarithms, else in prior deviations. ``history`` has
    the values of the objective, step by step, for the best of several ``starts``.

    Raises `TuningError` if `judged_on` contradicts the names of the runs.
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
        "provenance": {key: value for key, value in origin.items() if key not in _OWN_ENTRY},
        "tuning": tuned.digest,
        "inputs": tuned.inputs,
        "stopped": tuned.stopped,
        "evaluations": int(tuned.evaluations),
        "rejected_steps": int(tuned.rejections),
        "covariance_scale": float(tuned.scale),
        "also_scaled": _also_scaled(tuned),
        "history": [step._asdict() for step in tuned.history],
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
    tuned: Tuned,
    *,
    rows: Sequence[Row] = (),
    judged_on: JudgedOn | None = None,
    folds: CrossValidation | None = None,
) -> Path:
    """Write `tuning.json` into a folder, atomically; an earlier one is replaced.

    Parameters
    ----------
    folder
        Folder of the tuning.
    tuned
        The tuning.
    rows
        Rows of `compare` with the variants ``start`` and ``tuned``.
    judged_on
        Kind of the rows' runs; found by their names unless given.
    folds
        Result of `cross_validate`.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    TuningError
        If `judged_on` contradicts the names of the runs.
    RecordingError
        If a folder has the name of the file.

    Examples
    --------
    >>> import json, tempfile
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> tuned = tuning.tune(runs, objective="likelihood", free=["noise.optical"], iterations=2)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = tuning.save_record(folder, tuned)
    ...     document = json.loads(file.read_text("utf-8"))
    >>> file.name, document["runs"], document["numbers"][0]["label"]
    ('tuning.json', ['free-1'], 'noise.optical')
    """
    return write_record(folder, record(tuned, rows=rows, judged_on=judged_on, folds=folds))


def write_record(folder: Path | str, document: Mapping[str, Any]) -> Path:
    """Write the document of `record` as `save_record` does."""
    file = Path(folder) / FILE
    codec.write(file, codec.convert(document, TuningDocument))
    return file


def _judged_on(tuned: Tuned, rows: Sequence[Row], given: JudgedOn | None) -> JudgedOn | None:
    names = {row.run for row in rows}
    if not names:
        return None
    kind: JudgedOn = "other runs"
    if names & set(tuned.origin.get("runs", [])):
        kind = "training runs"
    elif names & set(tuned.origin.get("validation_runs", [])):
        kind = "validation runs"
    if given is not None and given != kind:
        raise TuningError(
            f"got rows judged on '{given}' of {sorted(names)}, expected '{kind}' by the runs of the"
            " tuning; compare other runs, or leave judged_on out"
        )
    return kind


def _units(tuned: Tuned) -> dict[str, str]:
    """The unit of each free parameter, by its name."""
    units = leaves_by_name(tuned.model.units._replace(truth=TRUTH_UNITS))
    return {leaf.name: units[leaf.name] for leaf in tuned.layout.leaves}


def _also_scaled(tuned: Tuned) -> list[str]:
    """Noise parameters that were not free and that the common scale changed."""
    if tuned.scale == 1.0:
        return []
    free = {leaf.name for leaf in tuned.layout.leaves}
    return [
        name for name in leaf_names(tuned.params) if name.startswith(SCALED[0]) and name not in free
    ]


def _truth(tuned: Tuned) -> dict[str, Any] | None:
    """Clock and frames of the encoder, if they were free."""
    if tuned.truth is None:
        return None
    units = TRUTH_UNITS._asdict()
    return {
        name: {"value": np.asarray(value, float).tolist(), "unit": units[name]}
        for name, value in tuned.truth._asdict().items()
    }


def _numbers(tuned: Tuned) -> list[dict[str, Any]]:
    """Each free number: start, tuned value, and confidence interval."""
    where, units = tuned.layout, _units(tuned)
    start = np.asarray(where.to_free(tuned.start))
    none = np.zeros(len(start))
    columns = where.labels(), interval(where, start, none), interval(where, tuned.free, none)
    known, unknown, runs = tuned.intervals, tuned.open, tuned.origin.get("runs", [])
    each = zip(where.numbers(), *columns, tuned.moved, tuned.changes, strict=True)
    found = []
    for (leaf, i), label, (first, *_), (last, *_), moved, change in each:
        logarithm, run, ends = leaf.is_logarithm(i), i // leaf.each, known.get(label)
        scales = logarithm and leaf.name.startswith(SCALED)
        found.append(
            {
                "label": label,
                "name": label.split(" of run ")[0],
                "run": (runs[run] if run < len(runs) else str(run)) if leaf.runs else None,
                "truth": leaf.name.startswith("truth."),
                "unit": units[leaf.name] if logarithm or leaf.kind == "linear" else "1",
                "logarithm": logarithm,
                "start": first,
                "tuned": last,
                "interval": None if ends is None else list(ends[1:]),
                "written": last * (np.sqrt(tuned.scale) if scales else 1.0),
                "moved": moved,
                "change": change,
                "left_open": label in unknown,
                "would_tell": unknown.get(label),
                "bounds": _bounds(leaf),
            }
        )
    return found


def _bounds(leaf: Leaf) -> list[float] | None:
    """Bounds in the parameter's unit."""
    if leaf.bounds is None:
        return None
    if leaf.kind == "log":
        return [float(np.exp(bound)) for bound in leaf.bounds]
    return [bound * leaf.step for bound in leaf.bounds]
