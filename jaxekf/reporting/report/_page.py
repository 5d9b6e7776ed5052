"""The report's page: its content for the templates, which need no network."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from jaxekf.reporting.report._comparison import ComparedResult
from jaxekf.reporting.report._figures import Figure
from jaxekf.reporting.report._grid import PALETTE
from jaxekf.reporting.report._summary import NUMBERS, Summary, shown
from jaxekf.reporting.report._tables import (
    Cell,
    Table,
    counted,
    in_degrees,
    number_text,
    origin_table,
    unit_text,
)
from jaxekf.reporting.report._tunings import TuningSection, tuning_content, tunings_overview

MARKER = 'content="jaxekf report"'
"""Identifies a report among other HTML files."""
_DIGITS = 12
"""Shown digits of a hash; all digits are in the result."""


class Section(NamedTuple):
    """One run of the report."""

    name: str
    """Its heading, unlike that of any other run."""
    compared: ComparedResult
    summary: Summary
    figures: Sequence[Figure]


def compose(sections: Sequence[Section], tunings: Sequence[TuningSection], bins: int) -> str:
    """The whole page: tunings before the runs."""
    environment = Environment(
        loader=PackageLoader("jaxekf.reporting.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.policies["json.dumps_kwargs"] = {
        "ensure_ascii": False,
        "separators": (",", ":"),
        "allow_nan": False,
    }
    names = ", ".join(section.name for section in [*tunings, *sections])
    overviews = [tunings_overview(tunings)] if tunings else []
    overviews += [_overview(sections)] if sections else []
    return environment.get_template("page.html").render(
        title=f"jaxekf report: {names}",
        introduction=_introduction(len(sections), len(tunings), bins),
        overviews=overviews,
        tunings=[tuning_content(section, i) for i, section in enumerate(tunings, 1)],
        runs=[_content(section, i) for i, section in enumerate(sections, 1)],
        # Plotly writes the colours into every element, as texts of this form.
        palette={_rgb(light): dark for light, dark in PALETTE.items()},
        plotly=get_plotlyjs(),
    )


def _introduction(runs: int, tunings: int, bins: int) -> str:
    """The first paragraph: number of sections, and how to read the figures."""
    counts = ", ".join(counted(n, kind) for n, kind in ((tunings, "tuning"), (runs, "run")) if n)
    text = f"{counts}. Drag to zoom, double-click to go back"
    if not runs:
        return f"{text}."
    return (
        f"{text}; the time axes of a run move together. Bands are two standard deviations."
        f" Long series are thinned for display: of each of {bins} equal spans of a run's time the smallest"
        f" and the largest sample are drawn, and of samples shown as dots, of each of {bins // 2} spans two"
        " others besides."
    )


def _rgb(colour: str) -> str:
    """``#rrggbb`` as browsers write it."""
    return f"rgb({', '.join(str(int(colour[i : i + 2], 16)) for i in (1, 3, 5))})"


def _overview(sections: Sequence[Section]) -> Table:
    """Numbers and verdicts of each run; only columns in which any run has a number."""
    known = [
        number
        for number in NUMBERS
        if any(np.isfinite(getattr(s.summary, number.name)) for s in sections)
    ]
    heads = ["run", "model", *(number.head for number in known)]
    rows = [
        [
            Cell(section.name, link=f"run-{i}"),
            section.summary.model,
            *(shown(getattr(section.summary, n.name), n.decimals) for n in known),
        ]
        for i, section in enumerate(sections, 1)
    ]
    verdicts = [section.summary.verdicts for section in sections]
    return Table(heads, rows, range(2, len(heads)), verdicts)


def _content(section: Section, number: int) -> dict[str, Any]:
    """Content of `run.html`."""
    compared, result = section.compared, section.compared.result
    diagnosis = result.diagnosis
    return {
        "anchor": f"run-{number}",
        "group": str(number),
        "name": section.name,
        "facts": (
            f"Model {result.model}; {result.document.duration_s:.3f} s, {len(result.time_ns)} instants;"
            f" times{result.clock.label or ' as in the recording'}; result in {result.folder}."
        ),
        "verdicts": section.summary.verdicts,
        "missing": compared.missing,
        "without_truth": compared.recording is not None and compared.recording.encoder is None,
        "notes": [*result.document.notes, *(() if diagnosis is None else diagnosis.notes)],
        "figures": section.figures,
        "account": _account(compared),
        "origin": _origin(compared),
        "settings": _settings(compared),
    }


def _account(compared: ComparedResult) -> Table:
    account = compared.result.document.account
    order = ("read", "used", "masked", "gated")
    kinds = dict.fromkeys(key for counts in account.values() for key in counts)
    columns = [k for k in order if k in kinds] + [k for k in kinds if k not in order]
    heads = ["stream", *(column.replace("_", " ") for column in columns)]
    rows = [
        [name, *(str(counts.get(column, "–")) for column in columns)]
        for name, counts in account.items()
    ]
    return Table(heads, rows, range(1, len(heads)))


def _settings(compared: ComparedResult) -> Table:
    rows = []
    for setting in compared.result.settings:
        value, unit = in_degrees(setting.value, setting.unit)
        cells = [number_text(value), unit_text(unit), "", ""]
        if unit != setting.unit:
            cells[2:] = [number_text(setting.value), unit_text(setting.unit)]
        rows.append([f"{setting.section}.{setting.name}", *cells])
    return Table(["parameter", "value", "unit", "in SI", ""], rows)


def _origin(compared: ComparedResult) -> Table:
    document = compared.result.document
    provenance = document.provenance
    entries = [
        (key, value) for key, value in provenance.items() if key not in ("versions", "inputs")
    ]
    if isinstance(files := provenance.get("inputs"), dict):
        hashes = (f"{name} {str(digest)[:_DIGITS]}" for name, digest in files.items())
        entries.append(("inputs, SHA-256", ", ".join(hashes) or "–"))
    entries.append(("log-likelihood", shown(document.log_likelihood, 1)))
    return origin_table(entries, provenance.get("versions"))
