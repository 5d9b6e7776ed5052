"""The report's page: what stands in it and how it is put together, from a template without any network."""

import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from string import Template
from typing import Any, NamedTuple

import numpy as np
from plotly.offline import get_plotlyjs

from jaxekf.report.evidence import Evidence
from jaxekf.report.figures import Figure
from jaxekf.report.grid import PALETTE
from jaxekf.report.saved import Setting
from jaxekf.report.summary import NUMBERS, Summary, shown

MARKER = 'content="jaxekf report"'
"""By which a report is known from other HTML files."""


class Section(NamedTuple):
    """One run of the report."""

    name: str
    """Its heading, unlike that of any other run."""
    seen: Evidence
    summary: Summary
    figures: Sequence[Figure]


def compose(sections: Sequence[Section], bins: int) -> str:
    """The whole page."""
    names = ", ".join(section.name for section in sections)
    body = [
        "<header>",
        "<h1>jaxekf report</h1>",
        f'<p class="faint">{len(sections)} {"run" if len(sections) == 1 else "runs"}. Drag to zoom,'
        " double-click to go back; the time axes of a run move together. Bands are two standard deviations."
        f" Long series are thinned for display: of each of {bins} equal spans of a run's time the smallest"
        f" and the largest sample are drawn, and of samples shown as dots, of each of {bins // 2} spans two"
        " others besides.</p>",
        "<noscript><p>The plots are drawn by JavaScript, which is switched off here.</p></noscript>",
        _navigation(sections),
        _overview(sections),
        "</header>",
        *(_section(section, i) for i, section in enumerate(sections, 1)),
    ]
    template = Template(files("jaxekf.report").joinpath("page.html").read_text("utf-8"))
    return template.substitute(
        title=_text(f"jaxekf report: {names}"),
        dark=_dark_colours(),
        body="\n".join(body),
        plotly=get_plotlyjs(),
    )


def _text(value: object) -> str:
    return html.escape(str(value), quote=True)


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


def _navigation(sections: Sequence[Section]) -> str:
    links = [
        f'<a href="#run-{i}">{_text(section.name)}</a>' for i, section in enumerate(sections, 1)
    ]
    return f'<nav aria-label="Runs">{" ".join(links)}</nav>'


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[int] = ()) -> str:
    """A table of HTML cells; those of the columns `numeric` to the right."""

    def cell(tag: str, i: int, content: str) -> str:
        kind = ' class="number"' if i in numeric else ""
        return f"<{tag}{kind}>{content}</{tag}>"

    head = "".join(cell("th", i, content) for i, content in enumerate(heads))
    lines = ["".join(cell("td", i, content) for i, content in enumerate(row)) for row in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _overview(sections: Sequence[Section]) -> str:
    """A row of numbers and a row of words for each run; only columns of which any run has a number."""
    known = [
        number
        for number in NUMBERS
        if any(np.isfinite(getattr(s.summary, number.name)) for s in sections)
    ]
    heads = ["run", "model", *(_text(number.head) for number in known)]
    marks = ["", "", *(' class="number"' for _ in known)]
    rows = []
    for i, section in enumerate(sections, 1):
        cells = [
            f'<a href="#run-{i}">{_text(section.name)}</a>',
            _text(section.summary.model),
            *(shown(getattr(section.summary, n.name), n.decimals) for n in known),
        ]
        line = "".join(f"<td{m}>{c}</td>" for m, c in zip(marks, cells, strict=True))
        words = "<br>".join(_text(sentence) for sentence in section.summary.verdicts)
        rows.append(f'<tr class="run">{line}</tr>')
        rows.append(f'<tr class="verdict"><td colspan="{len(heads)}">{words}</td></tr>')
    head = "".join(f"<th{m}>{h}</th>" for m, h in zip(marks, heads, strict=True))
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _section(section: Section, number: int) -> str:
    seen, anchor = section.seen, f"run-{number}"
    document = seen.result.document
    facts = (
        f"Model {seen.result.model}; {document['duration_s']:.3f} s, {len(seen.result.time_ns)} instants;"
        f" result in {seen.result.folder}."
    )
    links = [f'<a href="#{anchor}-{f.name}">{_text(f.title)}</a>' for f in section.figures]
    links.append(f'<a href="#{anchor}-data">Data and settings</a>')
    parts = [
        f'<section id="{anchor}">',
        f"<h2>{_text(section.name)}</h2>",
        f'<p class="faint">{_text(facts)}</p>',
        f'<nav aria-label="Figures">{" ".join(links)}</nav>',
        _list(section.summary.verdicts),
    ]
    if seen.missing:
        parts.append(
            '<p class="warning">Measurements and truth are not shown, because the recording could not be'
            f" read: {_text(seen.missing)}.</p>"
        )
    elif seen.recording is not None and seen.recording.encoder is None:
        parts.append('<p class="warning">The recording has no encoder: no truth is shown.</p>')
    notes = [*document["notes"], *(seen.result.diagnosis or {}).get("notes", [])]
    if notes:
        parts.append(f"<h3>Notes</h3>{_list(notes)}")
    parts += [_figure(figure, anchor, number) for figure in section.figures]
    parts += [
        f'<div class="tables" id="{anchor}-data">',
        "<div>",
        _account(seen),
        _provenance(seen),
    ]
    return "\n".join([*parts, "</div><div>", _settings(seen), "</div></div>", "</section>"])


def _list(sentences: Sequence[str]) -> str:
    items = "".join(f"<li>{_text(sentence)}</li>" for sentence in sentences)
    return f'<ul class="verdicts">{items}</ul>'


def _figure(figure: Figure, anchor: str, number: int) -> str:
    """A figure, and its data in a script that no browser runs; ``<`` would end that script."""
    text = json.dumps(
        figure.document, ensure_ascii=False, separators=(",", ":"), allow_nan=False
    ).replace("<", "\\u003c")
    name = f"{anchor}-{figure.name}"
    return (
        f"<figure><h3>{_text(figure.title)}</h3><figcaption>{_text(figure.caption)}</figcaption>"
        f'<div class="plot" id="{name}" data-run="{number}" role="img" aria-label="{_text(figure.title)}"'
        f' style="height: {figure.document["layout"]["height"]}px"></div>'
        f'<script type="application/json" id="{name}-data">{text}</script></figure>'
    )


def _account(seen: Evidence) -> str:
    account: Mapping[str, Mapping[str, int]] = seen.result.document["account"]
    order = ("read", "used", "masked", "gated")
    kinds = dict.fromkeys(key for counts in account.values() for key in counts)
    columns = [k for k in order if k in kinds] + [k for k in kinds if k not in order]
    heads = ["stream", *(_text(column.replace("_", " ")) for column in columns)]
    rows = [
        [_text(name), *(str(counts.get(column, "–")) for column in columns)]
        for name, counts in account.items()
    ]
    table = _table(heads, rows, numeric=range(1, len(heads)))
    return f"<h3>What became of every sample</h3>{table}"


def _settings(seen: Evidence) -> str:
    rows = []
    for setting in seen.result.settings:
        value, unit = _in_degrees(setting)
        plain = _value(setting.value) if unit != setting.unit else ""
        name = f"{setting.section}.{setting.name}"
        rows.append([_text(name), value, _unit(unit), plain, _unit(setting.unit) if plain else ""])
    table = _table(["parameter", "value", "unit", "in SI", ""], rows)
    return f"<h3>Noise and calibration used</h3>{table}"


def _in_degrees(setting: Setting) -> tuple[str, str]:
    """Angles as a person reads them."""
    if not setting.unit.startswith("rad"):
        return _value(setting.value), setting.unit
    degrees = np.rad2deg(np.asarray(setting.value, float)).tolist()
    return _value(degrees), setting.unit.replace("rad", "deg", 1)


def _unit(unit: str) -> str:
    """A unit in print."""
    return _text(re.sub(r"\bsqrt\((\w+)\)", r"√\1", unit).replace("^2", "²"))


def _value(value: Any) -> str:
    """A number, vector or matrix, four digits."""
    array = np.asarray(value, float)
    if array.ndim == 0:
        return f"{float(array):.4g}"
    lines = ["  ".join(f"{x:.4g}" for x in row) for row in np.atleast_2d(array)]
    return f'<span class="matrix">{_text(chr(10).join(lines))}</span>'


def _provenance(seen: Evidence) -> str:
    document = seen.result.document
    provenance: Mapping[str, Any] = document["provenance"]
    rows = [[_text(key), _text(value)] for key, value in provenance.items() if key != "versions"]
    versions = provenance.get("versions", {})
    rows += [[_text(name), _text(version)] for name, version in versions.items()]
    rows.append(["log-likelihood", shown(document.get("log_likelihood"), 1)])
    return f"<h3>Where it comes from</h3>{_table(['', ''], rows)}"
