"""Sections of the page that show tunings: their content for the templates."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxekf.evaluation.spread import Spread
from jaxekf.io.documents.tuning import FoldsDocument, RunScore, TuningDocument
from jaxekf.reporting.report._figures import Figure
from jaxekf.reporting.report._summary import shown
from jaxekf.reporting.report._tables import (
    Cell,
    Table,
    counted,
    in_degrees,
    number_text,
    origin_table,
    unit_text,
)
from jaxekf.reporting.report._tuned import (
    SavedTuning,
    before_and_after,
    spread,
    variants,
)
from jaxekf.reporting.report._tuning_figures import known_columns

_NO_WARNING = "no warnings"
_MOST_NAMED = 12
_JUDGED_ON = {
    "validation runs": "validation runs (held out)",
    "training runs": "the training runs themselves (not held out)",
    "other runs": "other runs (held out)",
}


class TuningSection(NamedTuple):
    """One tuning of the report."""

    name: str
    """Its heading, unlike that of any other tuning."""
    tuning: SavedTuning
    figures: Sequence[Figure]

    @property
    def warnings(self) -> list[str]:
        """Warnings in sentences."""
        return self.tuning.document.warnings


def tunings_overview(sections: Sequence[TuningSection]) -> Table:
    """Numbers and warnings of each tuning."""
    judged = [section.tuning.judged for section in sections]
    columns = known_columns([row for rows, _ in judged for row in rows])
    heads = ["tuning", "model", "tuned on"]
    for _, head, unit in columns:
        heads += [f"{head} ({unit}), before" if unit else f"{head}, before", "after"]
    rows = []
    for i, (section, (compared, kind)) in enumerate(zip(sections, judged, strict=True), 1):
        document = section.tuning.document
        rows.append(
            [
                Cell(section.name, link=f"tuning-{i}"),
                document.model,
                counted(len(document.runs), "run"),
                *(
                    shown(spread(compared, variant, column).mean, 3)
                    for column, _, _ in columns
                    for variant in before_and_after(compared)
                ),
                _mean_over(compared, kind) if compared else "–",
            ]
        )
    warnings = [section.warnings or [_NO_WARNING] for section in sections]
    return Table([*heads, "mean over"], rows, range(3, len(heads)), warnings)


def _mean_over(rows: Sequence[RunScore], kind: str) -> str:
    count = len({row.run for row in rows})
    return f"{count} {kind.replace('runs', 'run', 1) if count == 1 else kind}"


def tuning_content(section: TuningSection, number: int) -> dict[str, Any]:
    """Content of `tuning.html`."""
    document = section.tuning.document
    return {
        "anchor": f"tuning-{number}",
        "name": section.name,
        "facts": _facts(section.tuning),
        "figures": section.figures,
        "warnings": section.warnings,
        "no_warning": _NO_WARNING,
        "starts": _starts(document) if document.starts else None,
        "left_open": any(one.left_open for one in document.numbers),
        "judged_on": _JUDGED_ON.get(document.judged_on or "", document.judged_on),
        "compared": _compared(document.rows) if document.rows else None,
        "folds": None if document.folds is None else _folds(document, document.folds),
        "numbers": _numbers(document),
        "truth": None if document.truth is None else _truth(document),
        "origin": _origin(document),
    }


def _starts(document: TuningDocument) -> Table:
    rows = [
        [
            f"drawn {i}" if i else "as given",
            number_text(start.value, 6),
            str(start.iterations),
            start.ending,
        ]
        for i, start in enumerate(document.starts)
    ]
    return Table(["start", "best value", "iterations", "ended by"], rows, (1, 2))


def _facts(tuning: SavedTuning) -> str:
    """Objective, runs and end of the search, in sentences."""
    document = tuning.document
    held = document.validation_runs
    judged = f"; judged at each step by {_named(held)}" if held else "; no validation runs"
    scale = document.covariance_scale
    scaled = f" All covariances were scaled by {scale:.4g} afterwards." if scale != 1.0 else ""
    date = f", {document.date}" if document.date else ""
    return (
        f"Model {document.model}{date}; minimised: {document.objective}. Tuned on"
        f" {_named(document.runs)}{judged}. Stopped: {document.stopped}; best at iteration"
        f" {document.best_iteration} of {len(document.history)}, {document.evaluations}"
        f" evaluations, {document.rejected_steps} steps rejected.{scaled} Parameters in"
        f" {tuning.folder}."
    )


def _named(runs: Sequence[str]) -> str:
    names = ", ".join(runs[:_MOST_NAMED])
    more = f" and {len(runs) - _MOST_NAMED} more" if len(runs) > _MOST_NAMED else ""
    return f"{counted(len(runs), 'run')} ({names}{more})"


def _compared(rows: Sequence[RunScore]) -> Table:
    """Runs and variants, and below them the spread over the runs."""
    columns = known_columns(rows)
    heads = ["run", "noise", *(f"{h} ({u})" if u else h for _, h, u in columns)]
    body: list[list[str | Cell]] = [
        [row.run, row.variant, *(shown(getattr(row, c), 3) for c, _, _ in columns)] for row in rows
    ]
    several = len({row.run for row in rows}) > 1
    for kind in Spread._fields if several else ():
        for variant in variants(rows):
            values = [getattr(spread(rows, variant, c), kind) for c, _, _ in columns]
            if not all(map(math.isnan, values)):
                numbers = [shown(value, 3) for value in values]
                body.append([Cell(kind, strong=True), variant, *numbers])
    return Table(heads, body, range(2, len(heads)))


def _folds(document: TuningDocument, folds: FoldsDocument) -> dict[str, Any]:
    return {
        "count": len(folds.held_out),
        "compared": _compared(folds.rows),
        "parameters": _over_folds(document, folds),
    }


def _over_folds(document: TuningDocument, folds: FoldsDocument) -> Table:
    """Mean and standard deviation of each parameter over the folds, an entry a line."""
    rows = []
    for name, found in folds.parameters.items():
        unit, values = "", []
        for value in (found.start, found.mean, found.deviation):
            turned, unit = in_degrees(value, document.units.get(name, ""))
            values.append(np.array(turned, float))
        _, mean, deviation = values
        # Rounding errors of folds that found the same.
        deviation[deviation < 1e-12 * np.abs(mean)] = 0.0
        values = np.broadcast_arrays(*values)
        for at in np.ndindex(values[0].shape):
            if name.startswith("noise.") and len(at) == 2 and at[1] > at[0]:
                continue  # above the diagonal of a factor there is nothing
            cells = [number_text(value[at]) for value in values]
            rows.append([name + (str(list(at)) if at else ""), *cells, unit_text(unit)])
    return Table(["parameter", "start", "mean", "deviation", "unit"], rows, (1, 2, 3))


def _numbers(document: TuningDocument) -> Table:
    """Each free number with its interval."""
    heads = ["parameter", "start", "tuned", "95 %: from", "to", "unit", "moved by", "remark"]
    rows = []
    for number in document.numbers:
        ends = number.interval or (None, None)
        turned, unit = in_degrees([number.start, number.tuned, *ends], number.unit)
        cells = [number_text(value, 5) for value in turned]
        remarks = ["unobservable"] if number.left_open else []
        remarks += ["of the encoder"] if number.truth else []
        remarks += [f"of {number.run} alone"] if number.run else []
        moved = number.moved.replace("x ", "× ").replace("prior sigma", "σ of the prior")
        cells = [number.name, *cells, unit_text("" if unit == "1" else unit), moved]
        rows.append([*cells, "; ".join(remarks)])
    return Table(heads, rows, (1, 2, 3, 4))


def _truth(document: TuningDocument) -> Table:
    """Clock and frames of the encoder that were found."""
    rows = []
    for name, entry in (document.truth or {}).items():
        value, unit = in_degrees(entry.value, entry.unit)
        rows.append([name.replace("_", " "), number_text(value), unit_text(unit)])
    return Table(["", "found", "unit"], rows)


def _origin(document: TuningDocument) -> Table:
    entries: list[tuple[str, Any]] = [("date", document.date or "–")]
    entries.append(("runs", ", ".join(document.runs)))
    entries.append(("validation runs", ", ".join(document.validation_runs) or "–"))
    for key, value in document.provenance.items():
        if key != "versions":
            text = ", ".join(map(str, value)) if isinstance(value, list) else value
            entries.append((key.replace("_", " "), text))
    return origin_table(entries, document.provenance.get("versions"))
