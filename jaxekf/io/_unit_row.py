"""A row of units below the header of a CSV file: ``time,gx,gy,gz`` and then ``s,deg/s,deg/s,deg/s``."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io._csv_times import NUMBER
from jaxekf.io.csv_table import TIME_UNITS, Table
from jaxekf.io.schema import NUMBER as NUMBERS
from jaxekf.io.schema import StreamSchema
from jaxekf.io.units import UNITS, factors

_OTHER_WAYS = {
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "°/s": "deg/s",
    "dps": "deg/s",
    "deg/sec": "deg/s",
    "degrees/s": "deg/s",
    "rad/sec": "rad/s",
    "m/s²": "m/s^2",
    "m/s2": "m/s^2",
    "m/s/s": "m/s^2",
    "mm/s²": "mm/s^2",
    "nm": "N m",
    "n·m": "N m",
    "sec": "s",
    "second": "s",
    "seconds": "s",
    "msec": "ms",
    "millisecond": "ms",
    "milliseconds": "ms",
    "nanoseconds": "ns",
}
"""Other ways to write a unit, in lower case."""
_WITHOUT_UNIT = ("1", "")


def read_unit_row(
    table: Table, schema: StreamSchema, section: Mapping[str, Any], place: Path | str
) -> tuple[Table, Mapping[str, Any]]:
    """The table without its row of units, if the first row is one, and the section with these units.

    The first row is one if no cell is a number other than 1 and the time's is a unit of time; a note of the
    table's text then states it.

    Raises
    ------
    RecordingError
        For a unit that is not known, two units of one quantity, and one that contradicts the section.
    """
    if not len(table) or "time" not in table.columns:
        return table, section
    at_time = _unit(table.cell(0, "time"))
    if NUMBER.fullmatch(table.number(0, "time")) or at_time not in TIME_UNITS:
        return table, section
    cells = {name: _unit(table.cell(0, name)) for name in table.columns if name}
    if any(NUMBER.fullmatch(cell) and cell != "1" for cell in cells.values()):
        return table, section
    stated = section.get("time_unit")
    if stated is not None and TIME_UNITS.get(stated) != TIME_UNITS[at_time]:
        raise _contradiction(table, "time", at_time, schema.name, f'time_unit = "{stated}"')
    found = _of_quantities(table, cells, schema)
    parts = ("rad",) if "angle" in cells else schema.units or ()
    _check_stated(table, found, parts, schema.name, section, place)
    named = ", ".join(f"{unit} for {columns[0]}" for unit, columns in found.values())
    note = f"line {table.lines[0]} holds units, which are used: {at_time} for time"
    text = table.text.take(np.arange(len(table)) > 0)
    text = text._replace(notes=(*text.notes, f"{note}, {named}" if named else note))
    if parts and "unit" not in section:
        units = [found[part][0] if part in found else part for part in parts]
        section = {**section, "unit": ", ".join(units)}
    return replace(table, text=text, time_unit=at_time), section


def _unit(cell: str) -> str:
    """A unit as this package writes it."""
    inner = cell.strip("[](){} ")
    return _OTHER_WAYS.get(inner.lower(), inner)


def _of_quantities(
    table: Table, cells: Mapping[str, str], schema: StreamSchema
) -> dict[str, tuple[str, list[str]]]:
    """For each SI unit the file's unit, and the columns that have it."""
    si = {c: one.unit for one in schema.fields.values() if one.kind == NUMBERS for c in one.columns}
    si |= {"angle": "rad"}
    found: dict[str, tuple[str, list[str]]] = {}
    for name, cell in cells.items():
        unit = si.get(name, "")
        if unit in _WITHOUT_UNIT:
            continue
        choices = UNITS.get(unit, {unit: 1.0})
        if cell not in choices:
            hint = "correcting the row of units, or removing it"
            raise table.error(0, name, f"the unit '{cell}'", " or ".join(choices), hint)
        before, columns = found.setdefault(unit, (cell, []))
        if cell != before:
            got, hint = f"'{cell}' and '{before}' for {columns[0]}", "converting one of them"
            raise table.error(0, name, got, "the same unit", hint)
        columns.append(name)
    return found


def _check_stated(
    table: Table,
    found: Mapping[str, tuple[str, list[str]]],
    parts: tuple[str, ...],
    label: str,
    section: Mapping[str, Any],
    place: Path | str,
) -> None:
    """Raise if the section states another unit."""
    if "unit" not in section:
        return
    for part, stated in zip(parts, factors(label, parts, section, place), strict=True):
        unit, columns = found.get(part, ("", [""]))
        if unit and UNITS.get(part, {unit: 1.0})[unit] != stated:
            raise _contradiction(table, columns[0], unit, label, f'unit = "{section["unit"]}"')


def _contradiction(table: Table, column: str, unit: str, label: str, stated: str) -> RecordingError:
    hint = f"removing the entry from [{label}], or correcting one of them"
    expected = f"that of {stated} in recording.toml"
    return table.error(0, column, f"the unit '{unit}'", expected, hint)
