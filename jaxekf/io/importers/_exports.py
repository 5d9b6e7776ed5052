"""CSV exports of other programs: header lines, the table below them, and what its importers share.

Errors name file, line and column. A last line that is truncated is left out and accounted for.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io._csv_content import Content, empty_file, read_content
from jaxekf.io._csv_text import DELIMITERS, read_rows, split_line
from jaxekf.io.csv_table import Table, numbers
from jaxekf.io.units import UNITS
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Intake, Reason
from jaxekf.recordings.types import Flags, Floats, Optical, Recording, Times

METRES = UNITS["m"] | {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
"""Metres in a unit of length."""
LARGEST = 1e20
"""A larger number marks a missing value (NDI writes -3.697314e28)."""
_HEADER_LINES = 30
"""Lines at the top of a file among which its header must be."""


class HeaderLine(NamedTuple):
    """A line above the samples."""

    number: int
    cells: list[str]
    """Without spaces around them, and without blank ones at the end."""
    end: int
    """Offset of the next line."""

    def cell(self, column: int) -> str:
        """One cell; blank beyond the last one."""
        return self.cells[column] if column < len(self.cells) else ""


class Export(NamedTuple):
    """The text of an export, and its first lines."""

    content: Content
    delimiter: str
    head: list[HeaderLine]
    """The first lines that are not blank."""

    @property
    def path(self) -> Path:
        """The file."""
        return self.content.path

    def lines(self, begin: int, count: int) -> list[HeaderLine]:
        """The next lines from an offset that are not blank, at most `count`."""
        found: list[HeaderLine] = []
        while len(found) < count and begin < len(self.content.data):
            cells, end = split_line(self.content, begin, self.delimiter)
            row = stripped(cells)
            if row:
                found.append(HeaderLine(self.content.line(begin), row, end))
            begin = end
        return found

    def find(self, names: Sequence[str], expected: str) -> HeaderLine:
        """The first of the head's lines with all these column names, in any case."""
        for line in self.head:
            if {name.lower() for name in names} <= {bare(cell) for cell in line.cells}:
                return line
        got = f"no line with {', '.join(names)} among the first {len(self.head)}"
        hint = "another file, or exporting again with quaternions and positions"
        raise RecordingError(self.path, got, expected, hint)

    def table(self, header: HeaderLine, width: int, end: int | None = None) -> Table:
        """The rows below a header, up to an offset; the columns are called by their number."""
        names = tuple(map(str, range(1, width + 1)))
        text = read_rows(
            self.content, header.end, names, self.delimiter, end=end, header_line=header.number
        )
        return Table(self.path, names, text)

    def error(
        self, line: HeaderLine, got: str, expected: str, hint: str, column: str | None = None
    ) -> RecordingError:
        """The error of a header line."""
        return RecordingError(self.path, got, expected, hint, line=line.number, column=column)


def read_export(path: Path | str, expected: str) -> Export:
    """Read an export; `expected` describes it in messages.

    Raises
    ------
    RecordingError
        If the file is missing, a folder, empty or not text in UTF-8.
    """
    content = read_content(Path(path), expected)
    top = b"\n".join(content.data.split(b"\n", _HEADER_LINES)[:_HEADER_LINES])
    delimiter = max(DELIMITERS, key=lambda mark: (top.count(mark.encode()), mark == ","))
    export = Export(content, delimiter, [])
    head = export.lines(0, _HEADER_LINES)
    if not head:
        raise empty_file(content.path, expected)
    return export._replace(head=head)


def bare(cell: str) -> str:
    """A column's name in lower case without its unit and marks: ``Tx [mm]`` is ``tx``."""
    return re.sub(r"\s*[\[(].*[\])]\s*$", "", cell).strip().rstrip("#:").strip().lower()


def unit_of(cell: str) -> str | None:
    """The unit after a column's name, in lower case; None without one."""
    found = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", cell)
    return found[1].lower() if found and found[1] else None


def length_unit(export: Export, line: HeaderLine, unit: str, column: str) -> float:
    """Metres in a unit that a header line states; raises for an unknown unit."""
    if unit.lower() not in METRES:
        raise export.error(
            line, f"the unit of length '{unit}'", "m, cm or mm", "exporting in millimetres", column
        )
    return METRES[unit.lower()]


def stripped(row: Sequence[str]) -> list[str]:
    """Cells of a line, without spaces around them and without blank ones at the end."""
    cells = [cell.strip() for cell in row]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def chosen_tool(export: Export, line: HeaderLine, names: Sequence[str], tool: str | None) -> int:
    """Index of the tool with the name `tool`, or of the only one; raises an error that lists them.

    `line` is the header line that names the tools.
    """
    if tool is None and len(names) == 1:
        return 0
    matches = [i for i, name in enumerate(names) if tool and name.lower() == tool.strip().lower()]
    if len(matches) == 1:
        return matches[0]
    listed = ", ".join(names)
    got = (
        f"{len(names)} tools ({listed})" if tool is None else f"no one tool '{tool}' among {listed}"
    )
    if not names:
        got = "no tool with a rotation and a position"
    raise export.error(line, got, "one tool", "naming it: --tool NAME, tool=NAME")


class StampedRows(NamedTuple):
    """Rows with a time stamp, and the account of the others."""

    table: Table
    time_ns: Times
    dropped: dict[str, Reason]

    def floats(self, columns: Sequence[int], labels: Sequence[str]) -> Floats:
        """Columns (N, len(columns)), NaN for blank cells; messages call them by their `labels`."""
        table = self.table.named(dict(zip(columns, labels, strict=True)))
        return numbers(table, labels, blank=True)


def stamped_rows(table: Table, time_ns: Times, known: Flags) -> StampedRows:
    """Leave out rows without a time stamp.

    In the account they, and a truncated last line, have the stamp of the row before. Raises
    `RecordingError` if no row has a stamp.
    """
    if not known.any():
        raise RecordingError(table.path, "no row with a time", "one in each", "exporting again")
    before = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
    dropped = {}
    if not known.all():
        missing = np.flatnonzero(~known)
        dropped["no time"] = Reason(table.lines[missing], time_ns[before[missing]])
    if table.text.cut:
        stamp = np.full(len(table.text.cut), time_ns[before[-1]])
        dropped["cut short"] = Reason(np.array(table.text.cut, np.intp), stamp)
    return StampedRows(table.take(known), time_ns[known], dropped)


def accounted(account: Intake, table: Table, dropped: Mapping[str, Reason]) -> Intake:
    """The account of a stream, with the rows that were left out before it was made."""
    return replace(
        account,
        rows=account.rows + sum(reason.count for reason in dropped.values()),
        dropped={**account.dropped, **dropped},
        notes=(*table.text.notes, *account.notes),
    )


def pose_stream(
    source: StampedRows, quaternion: Floats, position: Floats, **options: Any
) -> tuple[Optical, Intake]:
    """A tracker's poses and their account.

    Numbers beyond `LARGEST` mark a lost tool. So does the identity at the origin.

    Parameters
    ----------
    source : StampedRows
        Rows of the poses.
    quaternion : array (N, 4)
        w, x, y, z; tool to reference.
    position : array (N, 3)
        Metres, in the reference frame.
    **options
        Options of `screening.optical`, such as ``status``, ``error`` and ``sort``.
    """
    with np.errstate(invalid="ignore"):
        marked = (np.abs(np.c_[quaternion, position]) > LARGEST).any(axis=1)
        zero = (np.abs(np.c_[quaternion[:, 1:], position]) < 1e-9).all(axis=1)
    zero &= np.abs(np.abs(quaternion[:, 0]) - 1.0) < 1e-9
    also = {"no value (-3.7e28)": marked, "identity at the origin": zero}
    optical, account = screening.optical(
        source.table.place, source.time_ns, quaternion, position, also=also, **options
    )
    return optical, accounted(account, source.table, source.dropped)


def tracker_alone(
    path: Path | str, default_name: str, optical: Optical, account: Intake, info: dict[str, Any]
) -> Recording:
    """A run of a tracker without an IMU, with the name of its file."""
    name = Path(path).name.split(".")[0] or default_name
    return Recording(name, optical=optical, info=info, path=Path(path), intake={"optical": account})
