"""The report's page: what stands in it and how it is put together, from a template without any network."""

from collections.abc import Mapping, Sequence
from importlib.resources import files
from string import Template
from typing import Any, NamedTuple

import numpy as np
from plotly.offline import get_plotlyjs

from jaxekf.reporting.report._evidence import Evidence
from jaxekf.reporting.report._figures import Figure
from jaxekf.reporting.report._grid import PALETTE
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
from jaxekf.reporting.report._summary import NUMBERS, Summary, shown
from jaxekf.reporting.report._tunings import TuningSection, tuning_markup, tunings_overview

MARKER = 'content="jaxekf report"'
"""By which a report is known from other HTML files."""
_DIGITS = 12
"""Of a hash: the whole of it is in the result."""


class Section(NamedTuple):
    """One run of the report."""

    name: str
    """Its heading, unlike that of any other run."""
    seen: Evidence
    summary: Summary
    figures: Sequence[Figure]


def compose(sections: Sequence[Section], tunings: Sequence[TuningSection], bins: int) -> str:
    """The whole page: tunings before the runs."""
    names = ", ".join(section.name for section in [*tunings, *sections])
    body = [
        "<header>",
        "<h1>jaxekf report</h1>",
        f'<p class="faint">{_introduction(sections, tunings, bins)}</p>',
        "<noscript><p>The plots are drawn by JavaScript, which is switched off here.</p></noscript>",
        _navigation(sections, tunings),
        *([tunings_overview(tunings)] if tunings else []),
        *([_overview(sections)] if sections else []),
        "</header>",
        *(tuning_markup(section, i) for i, section in enumerate(tunings, 1)),
        *(_section(section, i) for i, section in enumerate(sections, 1)),
    ]
    template = Template(files("jaxekf.reporting.report").joinpath("page.html").read_text("utf-8"))
    return template.substitute(
        title=text(f"jaxekf report: {names}"),
        dark=_dark_colours(),
        body="\n".join(body),
        plotly=get_plotlyjs(),
    )


def _introduction(sections: Sequence[Section], tunings: Sequence[TuningSection], bins: int) -> str:
    """What is on the page, and how to read it."""
    kinds = ((len(tunings), "tuning"), (len(sections), "run"))
    counts = ", ".join(f"{n} {kind}{'' if n == 1 else 's'}" for n, kind in kinds if n)
    told = f"{counts}. Drag to zoom, double-click to go back"
    if not sections:
        return f"{told}."
    return (
        f"{told}; the time axes of a run move together. Bands are two standard deviations."
        f" Long series are thinned for display: of each of {bins} equal spans of a run's time the smallest"
        f" and the largest sample are drawn, and of samples shown as dots, of each of {bins // 2} spans two"
        " others besides."
    )


def _dark_colours() -> str:
    """Rules that exchange the figures' colours, which Plotly writes into every element, on dark screens."""
    rules = []
    for light, dark in PALETTE.items():
        rgb = ", ".join(str(int(light[i : i + 2], 16)) for i in (1, 3, 5))
        for kind in ("stroke", "fill"):
            rules.append(
                f'  .js-plotly-plot [style*=" {kind}: rgb({rgb})"],'
                f' .js-plotly-plot [style^="{kind}: rgb({rgb})"]'
                f" {{ {kind}: {dark} !important; }}"
            )
    return "\n".join(rules)


def _navigation(sections: Sequence[Section], tunings: Sequence[TuningSection]) -> str:
    links = [
        f'<a href="#tuning-{i}">Tuning: {text(section.name)}</a>'
        for i, section in enumerate(tunings, 1)
    ]
    links += [
        f'<a href="#run-{i}">{text(section.name)}</a>' for i, section in enumerate(sections, 1)
    ]
    return f'<nav aria-label="Contents">{" ".join(links)}</nav>'


def _overview(sections: Sequence[Section]) -> str:
    """A row of numbers and a row of words for each run; only columns of which any run has a number."""
    known = [
        number
        for number in NUMBERS
        if any(np.isfinite(getattr(s.summary, number.name)) for s in sections)
    ]
    heads = ["run", "model", *(text(number.head) for number in known)]
    rows = []
    for i, section in enumerate(sections, 1):
        cells = [
            f'<a href="#run-{i}">{text(section.name)}</a>',
            text(section.summary.model),
            *(shown(getattr(section.summary, n.name), n.decimals) for n in known),
        ]
        rows.append((cells, section.summary.verdicts))
    return worded_table(heads, rows, range(2, len(heads)))


def _section(section: Section, number: int) -> str:
    seen, anchor = section.seen, f"run-{number}"
    document = seen.result.document
    facts = (
        f"Model {seen.result.model}; {document['duration_s']:.3f} s, {len(seen.result.time_ns)} instants;"
        f" result in {seen.result.folder}."
    )
    links = [f'<a href="#{anchor}-{f.name}">{text(f.title)}</a>' for f in section.figures]
    links.append(f'<a href="#{anchor}-data">Data and settings</a>')
    parts = [
        f'<section id="{anchor}">',
        f"<h2>{text(section.name)}</h2>",
        f'<p class="faint">{text(facts)}</p>',
        f'<nav aria-label="Figures">{" ".join(links)}</nav>',
        listed(section.summary.verdicts),
    ]
    if seen.missing:
        parts.append(
            '<p class="warning">Measurements and truth are not shown, because the recording could not be'
            f" read: {text(seen.missing)}.</p>"
        )
    elif seen.recording is not None and seen.recording.encoder is None:
        parts.append('<p class="warning">The recording has no encoder: no truth is shown.</p>')
    notes = [*document["notes"], *(seen.result.diagnosis or {}).get("notes", [])]
    if notes:
        parts.append(f"<h3>Notes</h3>{listed(notes)}")
    parts += [figure_markup(figure, anchor, str(number)) for figure in section.figures]
    parts += [
        f'<div class="tables" id="{anchor}-data">',
        "<div>",
        _account(seen),
        _provenance(seen),
    ]
    return "\n".join([*parts, "</div><div>", _settings(seen), "</div></div>", "</section>"])


def _account(seen: Evidence) -> str:
    account: Mapping[str, Mapping[str, int]] = seen.result.document["account"]
    order = ("read", "used", "masked", "gated")
    kinds = dict.fromkeys(key for counts in account.values() for key in counts)
    columns = [k for k in order if k in kinds] + [k for k in kinds if k not in order]
    heads = ["stream", *(text(column.replace("_", " ")) for column in columns)]
    rows = [
        [text(name), *(str(counts.get(column, "–")) for column in columns)]
        for name, counts in account.items()
    ]
    counted = table(heads, rows, numeric=range(1, len(heads)))
    return f"<h3>What became of every sample</h3>{counted}"


def _settings(seen: Evidence) -> str:
    rows = []
    for setting in seen.result.settings:
        value, unit = in_degrees(setting.value, setting.unit)
        told = [number_markup(value), unit_markup(unit), "", ""]
        if unit != setting.unit:
            told[2:] = [number_markup(setting.value), unit_markup(setting.unit)]
        rows.append([text(f"{setting.section}.{setting.name}"), *told])
    found = table(["parameter", "value", "unit", "in SI", ""], rows)
    return f"<h3>Noise and calibration used</h3>{found}"


def _provenance(seen: Evidence) -> str:
    document = seen.result.document
    provenance: Mapping[str, Any] = document["provenance"]
    entries = [
        (key, value) for key, value in provenance.items() if key not in ("versions", "inputs")
    ]
    if isinstance(files := provenance.get("inputs"), Mapping):
        told = (f"{name} {str(digest)[:_DIGITS]}" for name, digest in files.items())
        entries.append(("inputs, SHA-256", ", ".join(told) or "–"))
    entries.append(("log-likelihood", shown(document.get("log_likelihood"), 1)))
    return origin_markup(entries, provenance.get("versions"))
