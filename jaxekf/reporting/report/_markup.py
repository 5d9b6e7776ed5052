"""Pieces of the page: text, tables, lists and figures as HTML."""

import html
import json
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxekf.reporting.report._figures import Figure


def text(value: object) -> str:
    """Anything as text that is no markup."""
    return html.escape(str(value), quote=True)


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[int] = ()) -> str:
    """A table of HTML cells; those of the columns `numeric` to the right."""

    def cell(tag: str, i: int, content: str) -> str:
        kind = ' class="number"' if i in numeric else ""
        return f"<{tag}{kind}>{content}</{tag}>"

    head = "".join(cell("th", i, content) for i, content in enumerate(heads))
    lines = ["".join(cell("td", i, content) for i, content in enumerate(row)) for row in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def worded_table(
    heads: Sequence[str],
    rows: Sequence[tuple[Sequence[str], Sequence[str]]],
    numeric: Sequence[int],
) -> str:
    """A table of HTML cells in which a row of sentences stands below each row of cells."""
    marks = [' class="number"' if i in numeric else "" for i in range(len(heads))]
    lines = []
    for cells, sentences in rows:
        line = "".join(f"<td{m}>{c}</td>" for m, c in zip(marks, cells, strict=True))
        words = "<br>".join(text(sentence) for sentence in sentences)
        lines.append(f'<tr class="run">{line}</tr>')
        lines.append(
            f'<tr class="verdict"><td colspan="{len(heads)}"><div class="words">{words}</div></td></tr>'
        )
    head = "".join(f"<th{m}>{h}</th>" for m, h in zip(marks, heads, strict=True))
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def listed(sentences: Sequence[str]) -> str:
    """Sentences as a list."""
    items = "".join(f"<li>{text(sentence)}</li>" for sentence in sentences)
    return f'<ul class="verdicts">{items}</ul>'


def figure_markup(figure: Figure, anchor: str, group: str) -> str:
    """A figure, and its data in a script that no browser runs; ``<`` would end that script.

    Horizontal axes of one group move together.
    """
    data = json.dumps(
        figure.document, ensure_ascii=False, separators=(",", ":"), allow_nan=False
    ).replace("<", "\\u003c")
    name = f"{anchor}-{figure.name}"
    return (
        f"<figure><h3>{text(figure.title)}</h3><figcaption>{text(figure.caption)}</figcaption>"
        f'<div class="plot" id="{name}" data-run="{group}" role="img" aria-label="{text(figure.title)}"'
        f' style="height: {figure.document["layout"]["height"]}px"></div>'
        f'<script type="application/json" id="{name}-data">{data}</script></figure>'
    )


def in_degrees(value: Any, unit: str) -> tuple[Any, str]:
    """Angles as a person reads them: value (or None) and unit."""
    if not unit.startswith("rad"):
        return value, unit
    return np.rad2deg(np.array(value, float)).tolist(), unit.replace("rad", "deg", 1)


def unit_markup(unit: str) -> str:
    """A unit in print."""
    return text(re.sub(r"\bsqrt\((\w+)\)", r"√\1", unit).replace("^2", "²"))


def number_markup(value: Any, digits: int = 4) -> str:
    """A number, vector or matrix with so many digits; a dash for none."""
    array = np.array(value, float)
    if array.ndim == 0:
        return "–" if np.isnan(array) else f"{float(array):.{digits}g}"
    lines = ["  ".join(f"{x:.{digits}g}" for x in row) for row in np.atleast_2d(array)]
    return f'<span class="matrix">{text(chr(10).join(lines))}</span>'


def origin_markup(entries: Sequence[tuple[str, Any]], versions: Any) -> str:
    """What is known of where something comes from."""
    told = [*entries, *(versions.items() if isinstance(versions, dict) else ())]
    return f"<h3>Where it comes from</h3>{table(['', ''], [[text(k), text(v)] for k, v in told])}"
