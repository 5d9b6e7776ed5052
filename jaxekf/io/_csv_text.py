"""The text of a CSV file as rows of cells: delimiters, quotes, decimal commas, blank lines, ragged rows.

A clean file is used as it is, without a Python object for each cell. Any other file is first brought to one
form: commas between cells, the same number of cells in every row.
"""

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import RecordingError
from jaxekf.io._csv_content import Content, empty_file, read_content
from jaxekf.recordings.accounts import Indices

_BLOCK = 1 << 22
_COMMA, _NEWLINE = ord(","), ord("\n")
_EMPTY_STARTS = tuple(b"\n \t,")
"""First bytes of lines that may hold no cell with content."""
_BLANKS = b" \t\v\f,"
_HIDDEN = str.maketrans({",": "\x1f", "\n": "\x1e", "\r": "\x1e"})
"""Bytes that replace a comma and a line end within a cell."""
_SHOWN = str.maketrans({"\x1f": ",", "\x1e": "\n"})
_HIDDEN_COMMA = b"\x1f"
DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
WHITE_SPACE = " "
"""Delimiter of files whose cells are separated by any number of blanks and tabs."""
_SEPARATED_BY = {";": "semicolons", "\t": "tabs", WHITE_SPACE: "white space"}
_MOST_COLUMNS = 2000
_CONTENT = re.compile(rb"\S")
_NUMBER = re.compile(rb"\s*[+-]?(\d+[.\x1f]\d*|[.\x1f]\d+)([eE][+-]?\d+)?\s*")


class Text(NamedTuple):
    """A header and N rows of C cells each, as bytes."""

    path: Path
    data: bytes
    """The rows: cells separated by commas, each row ended by a line feed."""
    header: tuple[str, ...]
    ends: NDArray[np.int64]
    """(N, C) offset in `data` at which each cell ends."""
    lines: Indices
    """(N,) number of each row's line in the file."""
    cut: tuple[int, ...]
    """The file's last line if it is truncated; it is not among the rows."""
    notes: tuple[str, ...]
    """Deviations from the usual format, in sentences."""
    sha256: str
    header_line: int
    decimal_commas: bool = False

    def begins(self, column: int) -> NDArray[np.int64]:
        """(N,) offset in `data` at which the cells of a column begin."""
        if column:
            return self.ends[:, column - 1] + 1
        first = np.zeros(len(self.ends), np.int64)
        first[1:] = self.ends[:-1, -1] + 1
        return first

    @property
    def has_blank(self) -> bool:
        """Whether some cell is empty, without even a space."""
        flat = self.ends.reshape(-1)
        return bool(flat[0] == 0 or (np.diff(flat) == 1).any())

    def cell(self, row: int, column: int) -> str:
        """One cell, without spaces around it."""
        before = row * len(self.header) + column - 1
        begin = int(self.ends.flat[before]) + 1 if before >= 0 else 0
        raw = self.data[begin : int(self.ends[row, column])]
        return raw.decode("utf-8", "replace").translate(_SHOWN).strip()

    def row(self, row: int) -> bytes:
        """All cells of one row."""
        return self.data[int(self.ends[row - 1, -1]) + 1 if row else 0 : int(self.ends[row, -1])]

    def take(self, chosen: NDArray[np.bool_]) -> "Text":
        """The rows that a mask (N,) chooses."""
        if chosen.all():
            return self
        sizes = np.diff(self.ends.reshape(-1), prepend=-1).reshape(self.ends.shape)
        kept = np.repeat(chosen, sizes.sum(axis=1))
        data = np.frombuffer(self.data, np.uint8)[kept].tobytes()
        ends = (np.cumsum(sizes[chosen]) - 1).reshape(-1, len(self.header))
        return self._replace(data=data, ends=ends, lines=self.lines[chosen])

    def with_decimal_points(self) -> bytes:
        """`data` with a point in every number."""
        return self.data.replace(_HIDDEN_COMMA, b".") if self.decimal_commas else self.data


def read_text(
    path: Path,
    *,
    skip_lines: int = 0,
    header: tuple[str, ...] | None = None,
    delimiter: str | None = None,
) -> Text:
    """Read a file with one header line.

    Parameters
    ----------
    path : Path
        The file; it may be compressed with gzip.
    skip_lines : int
        Number of lines above the header.
    header : tuple of str, optional
        Names of the columns, for a file without a header line.
    delimiter : str, optional
        A key of `DELIMITERS`; found from the first line by default.

    Raises
    ------
    RecordingError
        If the file is missing, empty or not UTF-8, or if its rows differ in their number of cells.
    """
    content = read_content(path, "a CSV file of samples, such as a stream named in recording.toml")
    data, begin = content.data, 0
    for _ in range(skip_lines):
        begin = data.find(b"\n", begin) + 1 or len(data)
    while data.startswith(b"\n", begin):
        begin += 1
    if not _CONTENT.search(data, begin):
        raise empty_file(path, "a header and samples")
    number = content.line(begin)
    delimiter = delimiter or _only_delimiter(content, begin, number)
    if header is not None:
        return read_rows(content, begin, header, delimiter, header_line=number)
    header, end = split_line(content, begin, delimiter)
    return read_rows(content, end, header, delimiter, header_line=number)


def split_line(content: Content, begin: int, delimiter: str) -> tuple[tuple[str, ...], int]:
    """Cells of the line at an offset, without spaces around them, and the offset of the next line."""
    end = content.data.index(b"\n", begin)
    if b'"' not in content.data[begin:end]:
        cells = content.data[begin:end].decode("utf-8").split(delimiter)
        return tuple(cell.strip() for cell in cells), end + 1
    cells, count = next(_quoted_lines(content, begin, None, delimiter))
    for _ in range(count):
        begin = content.data.index(b"\n", begin) + 1
    return tuple(cell.strip() for cell in cells), begin


def read_rows(
    content: Content,
    begin: int,
    names: Sequence[str],
    delimiter: str,
    *,
    end: int | None = None,
    header_line: int = 0,
) -> Text:
    """The rows between two offsets of a file's text.

    Rows without content are left out. So are blank cells beyond the last name, and the last line of the
    file if it has fewer cells than the others.

    Parameters
    ----------
    content : Content
        The file's text.
    begin, end : int
        Offsets at which the first row begins and the last one ends; the end of the file by default.
    names : sequence of str
        Names of the C columns.
    delimiter : str
        A key of `DELIMITERS`, or `WHITE_SPACE`.
    header_line : int
        Number of the line that holds the names; 0 if none does.

    Raises
    ------
    RecordingError
        If there are no rows, if they differ in their number of cells, or if some numbers have decimal
        commas and others have points.
    """
    first = content.line(begin)
    data = content.data[begin:end]
    if b'"' in data:
        data, lines = _unquoted(content, begin, end, delimiter, first)
    else:
        data, lines = _without_empty_rows(_with_commas(data, delimiter), first)
    if not lines.size:
        hint, line = "exporting the recording again", header_line or None
        raise RecordingError(content.path, "0 samples", "at least one", hint, line=line)
    commas = delimiter != "," and _decimal_commas(content.path, data, lines)
    notes = [f"cells are separated by {_SEPARATED_BY[delimiter]}"] if delimiter != "," else []
    notes += ["numbers have decimal commas"] if commas else []
    made = Text(
        content.path,
        data,
        tuple(names),
        np.zeros((0, 0), np.int64),
        lines,
        (),
        tuple(notes),
        content.sha256,
        header_line,
        commas,
    )
    return _rectangular(made, may_be_cut=end is None)


# ---------------------------------------------------------------------------------------------
# Delimiters, decimal commas, quotes


def _only_delimiter(content: Content, begin: int, number: int) -> str:
    """The delimiter in the first line; a comma if there is none."""
    head = content.data[begin : content.data.index(b"\n", begin)]
    found = [delimiter for delimiter in DELIMITERS if delimiter.encode() in head]
    if len(found) > 1:
        got = f"a header with {' and '.join(DELIMITERS[delimiter] for delimiter in found)}"
        hint = 'stating which: delimiter = ";" in its section of recording.toml'
        raise RecordingError(content.path, got, "one delimiter", hint, line=number)
    return found[0] if found else ","


def _with_commas(data: bytes, delimiter: str) -> bytes:
    """Rows with commas between cells, and each comma within a cell replaced."""
    if delimiter == ",":
        return data
    if delimiter != WHITE_SPACE:
        return data.translate(bytes.maketrans(delimiter.encode() + b",", b",\x1f"))
    hidden = data.replace(b",", _HIDDEN_COMMA)
    return b"\n".join(b",".join(line.split()) for line in hidden.split(b"\n"))


def _decimal_commas(path: Path, data: bytes, lines: Indices) -> bool:
    """Whether numbers have decimal commas; raises if some have points."""
    comma = _first_number(data, _HIDDEN_COMMA)
    if comma is None:
        return False
    if _first_number(data, b".") is not None:
        got = "decimal commas beside points"
        hint = "exporting with decimal points"
        raise RecordingError(
            path, got, "one of them", hint, line=int(lines[data.count(b"\n", 0, comma)])
        )
    return True


def _first_number(data: bytes, mark: bytes) -> int | None:
    """Offset of the first decimal mark of this kind in a number."""
    if mark not in data:
        return None
    for found in re.finditer(re.escape(mark) + rb"\d*([eE][+-]?\d+)?[ \t]*(?=[,\n])", data):
        before = data[max(found.start() - 30, 0) : found.start()]
        cell = re.split(rb"[,\n]", before)[-1]
        if _NUMBER.fullmatch(cell + found[0]):
            return found.start()
    return None


def _quoted_lines(
    content: Content, begin: int, end: int | None, delimiter: str
) -> Iterator[tuple[list[str], int]]:
    """Cells of every line, and the number of lines read so far: a quoted cell may contain line ends."""

    def lines(at: int, last: int) -> Iterator[str]:
        while at < last:
            after = content.data.index(b"\n", at) + 1
            yield content.data[at:after].decode("utf-8")
            at = after

    reader = csv.reader(
        lines(begin, len(content.data) if end is None else end), delimiter=delimiter, strict=True
    )
    try:
        for row in reader:
            yield row, reader.line_num
    except csv.Error as error:
        raise RecordingError(
            content.path,
            f"quotes that do not close ({error})",
            "cells quoted whole",
            "correcting the line",
            line=content.line(begin) + reader.line_num - 1,
        ) from None


def _unquoted(
    content: Content, begin: int, end: int | None, delimiter: str, first: int
) -> tuple[bytes, Indices]:
    """Rows with content without quotes, and the number of each one's line."""
    rows, lines = [], []
    for row, count in _quoted_lines(content, begin, end, delimiter):
        if any(cell.strip() for cell in row):
            rows.append(",".join(cell.translate(_HIDDEN).strip() for cell in row))
            lines.append(count + first - 1)
    return "\n".join([*rows, ""]).encode(), np.array(lines, np.intp)


# ---------------------------------------------------------------------------------------------
# Rows and cells


def _without_empty_rows(data: bytes, first: int) -> tuple[bytes, Indices]:
    """Rows with content, and the number of each one's line."""
    newlines = _positions(data, lambda block: block == _NEWLINE)
    lines = np.arange(first, first + len(newlines))
    flat = np.frombuffer(data, np.uint8)
    begins = flat[np.concatenate([[0], newlines[:-1] + 1])] if len(newlines) else flat[:0]
    # Only the first byte of each line is examined: a search of the whole text for blank lines is slow.
    if not np.isin(begins, _EMPTY_STARTS).any():
        return data, lines
    rows = data[:-1].split(b"\n")
    kept = np.array([bool(row.strip(_BLANKS)) for row in rows], bool)
    left = [row for row, keep in zip(rows, kept, strict=True) if keep]
    return b"\n".join([*left, b""]) if left else b"", lines[kept]


def _positions(
    data: bytes, matches: Callable[[NDArray[np.uint8]], NDArray[np.bool_]]
) -> NDArray[np.int64]:
    """Offsets of the bytes that match, found in blocks so that the mask stays small."""
    flat = np.frombuffer(data, np.uint8)
    blocks = [
        np.flatnonzero(matches(flat[start : start + _BLOCK])) + start
        for start in range(0, len(flat), _BLOCK)
    ]
    return np.concatenate(blocks) if blocks else np.zeros(0, np.int64)


def _cell_ends(data: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Offsets at which cells end, and the number of cells in each row."""
    ends = _positions(data, lambda block: (block == _COMMA) | (block == _NEWLINE))
    last = np.flatnonzero(np.frombuffer(data, np.uint8)[ends] == _NEWLINE)
    return ends, np.diff(last, prepend=-1)


def _rectangular(text: Text, *, may_be_cut: bool) -> Text:
    """The text with the ends of its cells, the same number in each row."""
    data, lines = text.data, text.lines
    cut: tuple[int, ...] = ()
    width = len(text.header)
    while width > 1 and not text.header[width - 1]:
        width -= 1
    ends, widths = _cell_ends(data)
    others = widths[:-1]
    shorter = may_be_cut and others.size > 0 and widths[-1] < others.min()
    if shorter and (widths[-1] < width or others.min() == others.max()):
        cut, lines = (int(lines[-1]),), lines[:-1]
        ends, widths = ends[: -widths[-1]], others
        data = data[: int(ends[-1]) + 1]
    if (widths > width).any():
        trimmed = _without_excess(data, ends, widths, width)
        if trimmed is not None:
            data = trimmed
            ends, widths = _cell_ends(data)
        elif (widths == len(text.header)).all():
            width = len(text.header)
    wrong = np.flatnonzero(widths != width)
    if wrong.size:
        got = f"{widths[wrong[0]]} cells"
        expected = f"{width} as in the {'header' if text.header_line else 'first row'}"
        hint = "completing the row or removing it"
        raise RecordingError(text.path, got, expected, hint, line=int(lines[wrong[0]]))
    if width > _MOST_COLUMNS:
        raise RecordingError(
            text.path, f"{width} columns", f"{_MOST_COLUMNS} at most", "leaving some out"
        )
    return text._replace(
        data=data,
        header=text.header[:width],
        ends=ends.reshape(len(lines), width),
        lines=lines,
        cut=cut,
    )


def _without_excess(
    data: bytes, ends: NDArray[np.int64], widths: NDArray[np.int64], width: int
) -> bytes | None:
    """The text without cells beyond `width`; None if one of them is not blank."""
    wide = np.flatnonzero(widths > width)
    last = np.cumsum(widths)[wide] - 1
    begin, end = ends[last - widths[wide] + width], ends[last]
    # As many bytes as cells are delimiters alone; otherwise there may be spaces between them.
    filled = np.flatnonzero(end - begin != widths[wide] - width)
    if any(data[begin[i] : end[i]].strip(_BLANKS) for i in filled):
        return None
    change = np.zeros(len(data) + 1, np.int8)
    change[begin], change[end] = -1, 1
    return np.frombuffer(data, np.uint8)[np.cumsum(change[:-1], dtype=np.int8) == 0].tobytes()
