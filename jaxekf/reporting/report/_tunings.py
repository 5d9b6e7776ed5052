"""Sections of the page that show tunings: warnings, tables and figures."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxekf.reporting.report._figures import Figure
from jaxekf.reporting.report._markup import (
    figure_markup,
    in_degrees,
    listed,
    number_markup,
    origin_markup,
    table,
    text,
    unit_markup,
    worded_table,
)
from jaxekf.reporting.report._summary import shown
from jaxekf.reporting.report._tuned import (
    HELD,
    SavedTuning,
    Spread,
    before_and_after,
    spread,
    variants,
)
from jaxekf.reporting.report._tuning_figures import known_columns

_NO_WARNING = "nothing speaks against it"
_MOST_NAMED = 12


class TuningSection(NamedTuple):
    """One tuning of the report."""

    name: str
    """Its heading, unlike that of any other tuning."""
    tuning: SavedTuning
    figures: Sequence[Figure]

    @property
    def warnings(self) -> list[str]:
        """In sentences."""
        return self.tuning.document["warnings"]


def tunings_overview(sections: Sequence[TuningSection]) -> str:
    """A row of numbers and a row of warnings for each tuning."""
    judged = [section.tuning.judged for section in sections]
    columns = [
        (column, f"{head} ({unit})" if unit else head)
        for column, head, unit in known_columns([row for rows, _ in judged for row in rows])
    ]
    heads = ["tuning", "model", "tuned on"]
    for _, head in columns:
        heads += [f"{head}, before", "after"]
    rows = []
    for i, (section, (compared, what)) in enumerate(zip(sections, judged, strict=True), 1):
        document = section.tuning.document
        means = [
            shown(spread(compared, variant, column).mean, 3)
            for column, _ in columns
            for variant in before_and_after(compared)
        ]
        cells = [
            f'<a href="#tuning-{i}">{text(section.name)}</a>',
            text(document["model"]),
            _counted(document["runs"]),
            *means,
            text(_mean_over(compared, what)) if compared else "–",
        ]
        rows.append((cells, section.warnings or [_NO_WARNING]))
    return worded_table([*heads, "mean over"], rows, range(3, len(heads)))


def _mean_over(rows: Sequence[dict[str, Any]], what: str) -> str:
    count = len({row["run"] for row in rows})
    return f"{count} {what.replace('runs', 'run', 1) if count == 1 else what}"


def tuning_markup(section: TuningSection, number: int) -> str:
    """The section of one tuning."""
    document, anchor = section.tuning.document, f"tuning-{number}"
    drawn = {
        figure.name: figure_markup(figure, anchor, f"{anchor}-{figure.name}")
        for figure in section.figures
    }
    links = [f'<a href="#{anchor}-{f.name}">{text(f.title)}</a>' for f in section.figures]
    links.append(f'<a href="#{anchor}-numbers">Parameters</a>')
    parts = [
        f'<section id="{anchor}">',
        f"<h2>Tuning: {text(section.name)}</h2>",
        f'<p class="faint">{text(_facts(section.tuning))}</p>',
        f'<nav aria-label="Figures">{" ".join(links)}</nav>',
        f'<div class="warning">{listed(section.warnings)}</div>'
        if section.warnings
        else listed([_NO_WARNING]),
        drawn.get("search", ""),
        _starts(document),
    ]
    if document["rows"]:
        parts += [
            f"<h3>Before and after, on {_judged_on(document)}</h3>",
            _compared(document["rows"]),
            drawn.get("compared", ""),
        ]
    if document["folds"] is not None:
        parts += [
            f"<h3>Held out: each run by a tuning without it ({_folds(document)})</h3>",
            _compared(document["folds"]["rows"]),
            drawn.get("folds", ""),
            f"<h3>Parameters over the folds</h3>{_over_folds(document)}",
        ]
    parts += [
        f'<div id="{anchor}-numbers">{_numbers(document)}</div>',
        drawn.get("intervals", ""),
        _truth(document),
        _origin(document),
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _starts(document: Mapping[str, Any]) -> str:
    """What became of each of several starts."""
    if not document["starts"]:
        return ""
    rows = []
    for i, one in enumerate(document["starts"]):
        name = "as given" if i == 0 else f"drawn {i}"
        value = number_markup(one["value"], 6)
        rows.append([name, value, str(one["iterations"]), text(one["ending"])])
    heads = ["start", "best value", "iterations", "ended by"]
    note = ""
    if any(number["left_open"] for number in document["numbers"]):
        note = (
            '<p class="faint">What the data leave open went back to its start in the search that won, and'
            " its value is the one after that.</p>"
        )
    return f"<h3>Starts</h3>{note}{table(heads, rows, (1, 2))}"


def _facts(tuning: SavedTuning) -> str:
    """What was searched, how, and how it ended."""
    document = tuning.document
    held = document["validation_runs"]
    judged = f"; judged at each step by {_named(held)}" if held else "; no validation runs"
    scale = document["covariance_scale"]
    scaled = f" All covariances were scaled by {scale:.4g} afterwards." if scale != 1.0 else ""
    date = f", {document['date']}" if document["date"] else ""
    return (
        f"Model {document['model']}{date}; minimised: {document['objective']}. Tuned on"
        f" {_named(document['runs'])}{judged}. Stopped: {document['stopped']}; best at iteration"
        f" {document['best_iteration']} of {len(document['history'])}, {document['evaluations']}"
        f" evaluations, {document['rejected_steps']} steps rejected.{scaled} Parameters in"
        f" {tuning.folder}."
    )


def _named(runs: Sequence[str]) -> str:
    listed_runs = ", ".join(runs[:_MOST_NAMED])
    more = f" and {len(runs) - _MOST_NAMED} more" if len(runs) > _MOST_NAMED else ""
    return f"{_counted(runs)} ({listed_runs}{more})"


def _counted(runs: Sequence[str]) -> str:
    return f"{len(runs)} run{'' if len(runs) == 1 else 's'}"


def _judged_on(document: Mapping[str, Any]) -> str:
    told = {
        "validation runs": "validation runs (held out)",
        "training runs": "the training runs themselves (not held out)",
        "other runs": "other runs (held out)",
    }
    return text(told.get(document["judged_on"], document["judged_on"]))


def _folds(document: Mapping[str, Any]) -> str:
    held = document["folds"]["held_out"]
    return f"{len(held)} folds"


def _compared(rows: Sequence[dict[str, Any]]) -> str:
    """Runs and variants, and below them how far the runs spread."""
    columns = known_columns(rows)
    heads = ["run", "noise", *(text(f"{h} ({u})" if u else h) for _, h, u in columns)]
    body = [
        [text(row["run"]), text(row["variant"]), *(shown(row[c], 3) for c, _, _ in columns)]
        for row in rows
    ]
    several = len({row["run"] for row in rows}) > 1
    for kind in Spread._fields if several else ():
        for variant in variants(rows):
            told = [getattr(spread(rows, variant, c), kind) for c, _, _ in columns]
            if not all(map(math.isnan, told)):
                cells = [f"<strong>{kind}</strong>", text(variant)]
                body.append(cells + [shown(value, 3) for value in told])
    note = ""
    if any(row["variant"] == HELD for row in rows):
        note = (
            "<p class=\"faint\">“hold last” is the tracker's last sample, and the gyroscope's rate as it"
            " is.</p>"
        )
    return table(heads, body, range(2, len(heads))) + note


def _over_folds(document: Mapping[str, Any]) -> str:
    """Mean and deviation of each parameter over the folds, an entry a line."""
    rows = []
    for name, told in document["folds"]["parameters"].items():
        unit = document["units"].get(name, "")
        values = {}
        for key in ("start", "mean", "deviation"):
            turned, units = in_degrees(told[key], str(unit))
            values[key] = np.array(turned, float)
        # What rounding leaves of folds that found the same.
        values["deviation"][values["deviation"] < 1e-12 * np.abs(values["mean"])] = 0.0
        shape = np.broadcast_shapes(*(value.shape for value in values.values()))
        for at in np.ndindex(shape):
            if name.startswith("noise.") and len(at) == 2 and at[1] > at[0]:
                continue  # above the diagonal of a factor there is nothing
            cells = [number_markup(np.broadcast_to(v, shape)[at]) for v in values.values()]
            label = name + (str(list(at)) if at else "")
            rows.append([text(label), *cells, unit_markup(units)])
    return table(["parameter", "start", "mean", "deviation", "unit"], rows, (1, 2, 3))


def _numbers(document: Mapping[str, Any]) -> str:
    """Each free number with its interval."""
    scaled = document["covariance_scale"] != 1.0
    heads = ["parameter", "start", "tuned", "95 %: from", "to", "unit", "moved by"]
    heads += (["as written"] if scaled else []) + ["remark"]
    rows = []
    for number in document["numbers"]:
        ends = number["interval"] or [None, None]
        turned, unit = in_degrees(
            [number["start"], number["tuned"], *ends, number["written"]], number["unit"]
        )
        told = [number_markup(value, 5) for value in turned]
        remarks = ["left open by the data"] if number["left_open"] else []
        remarks += ["of the encoder"] if number["truth"] else []
        remarks += [f"of {number['run']} alone"] if number["run"] else []
        moved = number["moved"].replace("x ", "× ").replace("prior sigma", "σ of the prior")
        cells = [text(number["name"]), *told[:4]]
        cells += [unit_markup("" if unit == "1" else unit), text(moved)]
        rows.append([*cells, *(told[4:] if scaled else ()), text("; ".join(remarks))])
    note = (
        "Values and intervals are those before the common scale of all covariances."
        if scaled
        else ""
    )
    return (
        f'<h3>Parameters</h3><p class="faint">Noise and initial belief as standard deviations; angles in'
        f" degrees. {note}</p>{table(heads, rows, (1, 2, 3, 4, *((7,) if scaled else ())))}"
    )


def _truth(document: Mapping[str, Any]) -> str:
    """How the encoder was found to lie to the tracker."""
    if document["truth"] is None:
        return ""
    rows = []
    for name, told in document["truth"].items():
        value, unit = in_degrees(told["value"], told["unit"])
        rows.append([text(name.replace("_", " ")), number_markup(value), unit_markup(unit)])
    return f"<h3>The encoder's clock and frames</h3>{table(['', 'found', 'unit'], rows)}"


def _origin(document: Mapping[str, Any]) -> str:
    provenance = document["provenance"]
    entries = [("date", document["date"] or "–"), ("runs", ", ".join(document["runs"]))]
    entries.append(("validation runs", ", ".join(document["validation_runs"]) or "–"))
    for key, value in provenance.items():
        if key != "versions":
            told = ", ".join(map(str, value)) if isinstance(value, list) else value
            entries.append((key.replace("_", " "), told))
    return origin_markup(entries, provenance.get("versions"))
