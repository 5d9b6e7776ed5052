"""Tables of the page and the text of numbers and units in them; the templates make HTML of these."""

import re
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np


class Cell(NamedTuple):
    """A cell that is more than text: a link, strong, or else a matrix."""

    text: str
    link: str = ""
    """Identity of the element that is linked to."""
    strong: bool = False


class Table(NamedTuple):
    """A table; texts are not escaped yet."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    numeric: Collection[int] = ()
    """Columns that are aligned right."""
    sentences: Sequence[Sequence[str]] = ()
    """Shown below each row."""


def in_degrees(value: Any, unit: str) -> tuple[Any, str]:
    """Angles in degrees: value (None is NaN) and unit; other quantities as they are."""
    if not unit.startswith("rad"):
        return value, unit
    return np.rad2deg(np.array(value, float)).tolist(), unit.replace("rad", "deg", 1)


def unit_text(unit: str) -> str:
    """A unit in print."""
    return re.sub(r"\bsqrt\((\w+)\)", r"√\1", unit).replace("^2", "²")


def number_text(value: Any, digits: int = 4) -> str | Cell:
    """A number, vector or matrix with significant `digits`; a dash for none."""
    array = np.array(value, float)
    if array.ndim == 0:
        return "–" if np.isnan(array) else f"{float(array):.{digits}g}"
    lines = ["  ".join(f"{x:.{digits}g}" for x in row) for row in np.atleast_2d(array)]
    return Cell("\n".join(lines))


def counted(count: int, noun: str) -> str:
    """A number with its noun."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def origin_table(entries: Iterable[tuple[str, Any]], versions: Any) -> Table:
    """Provenance, and the versions of packages."""
    found = [*entries, *(versions.items() if isinstance(versions, dict) else ())]
    return Table(["", ""], [[str(key), str(value)] for key, value in found])
