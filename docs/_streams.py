"""Tables of the streams, made from their schemas for the page of file formats."""

from pathlib import Path

from jaxekf.io._section_entries import COMMON
from jaxekf.io.schema import StreamSchema
from jaxekf.io.streams import SCHEMAS
from jaxekf.io.units import UNITS
from jaxekf.recordings.types import STREAMS


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    return [_row(*head), "|" + "---|" * len(head), *(_row(*row) for row in rows), ""]


def _code(text: str) -> str:
    return f"`{text}`" if text else ""


def _units(unit: str) -> str:
    """A unit, and in brackets those that a CSV file may have instead."""
    others = [other for other in UNITS.get(unit, {}) if other != unit]
    return f"{unit} ({', '.join(others)})" if others else unit


def _section(schema: StreamSchema) -> list[str]:
    """One stream: files, arrays and entries of its section."""
    headers = " or ".join(_code(layout) for layout in schema.layouts)
    where = "" if schema.name in STREAMS else f' In Python: `Recording.others["{schema.name}"]`.'
    lines = [f"### {schema.name}", "", schema.about + where, ""]
    lines += [f"Header of `{schema.name}.csv`: {headers}", ""]
    rows = [
        (
            _code(name),
            _code(",".join(one.columns)),
            "(" + ", ".join(map(str, one.shape)) + ")" if one.shape else "",
            _units(one.unit),
            one.frame,
            ("yes" if one.needed else "") if one.stored else "CSV only",
            one.about,
        )
        for name, one in schema.fields.items()
    ]
    lines += _table(("array", "columns", "shape", "unit", "frame", "needed", "content"), rows)
    entries = [(_code(key), one.form, one.about) for key, one in schema.options.items()]
    entries += [
        (
            _code(one.option),
            "s" if one.option == "latency" else ("[x, y, z], " if one.shape else "") + one.unit,
            one.about,
        )
        for one in schema.fields.values()
        if one.option
    ]
    if entries:
        lines += [f"Entries of the section `[{schema.name}]`:", ""]
        lines += _table(("entry", "form", "meaning"), entries)
    return lines


def write(path: Path) -> None:
    """Write all tables as one file of MyST."""
    lines = ["### Every stream", ""]
    lines += ["Entries that the section of every stream may have:", ""]
    lines += _table(("entry", "meaning"), [(_code(key), about) for key, about in COMMON.items()])
    for schema in SCHEMAS.values():
        lines += _section(schema)
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(lines), "utf-8")
