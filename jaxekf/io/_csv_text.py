"""The bytes of a CSV file as lines of cells: encodings, line ends, delimiters, quotes, and where cells end.

A clean file is taken as it is, without a Python object for any of its cells. Whatever is unusual is first
brought to the same form: commas, decimal points, line feeds, as many cells in every line.
"""

import csv
import hashlib
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import RecordingError
from jaxekf.recordings.accounts import Indices

_BLOCK = 1 << 22
_COMMA, _NEWLINE = ord(","), ord("\n")
_BLANKS = tuple(b"\n \t")
"""With which a line that holds nothing begins."""
_HIDDEN = str.maketrans({",": "\x1f", "\n": "\x1e", "\r": "\x1e"})
"""What stands for a delimiter or a line's end within a quoted cell."""
_SHOWN = str.maketrans({"\x1f": ",", "\x1e": "\n"})
_ENCODINGS = {
    b"\xff\xfe\x00\x00": "UTF-32",
    b"\x00\x00\xfe\xff": "UTF-32",
    b"\xff\xfe": "UTF-16",
    b"\xfe\xff": "UTF-16",
}
DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
_MOST_COLUMNS = 2000
_DECIMAL = re.compile(r"\s*[+-]?\d*[.,]?\d+([eE][+-]?\d+)?\s*")
_BROKEN_OFF = re.compile(rb"[+-]?(\d*\.?\d*[eE][+-]?|[.]?)|[+-]")
"""What a number may be when a file ends in the middle of it, and is none."""


class Text(NamedTuple):
    """A header and rows of as many cells each, as bytes."""

    path: Path
    data: bytes
    """The rows, cells separated by commas, each line ended by a line feed."""
    header: tuple[str, ...]
    ends: NDArray[np.int64]
    """(N, C) where in `data` each cell ends."""
    lines: Indices
    """(N,) number of the line of each row in the file."""
    cut: tuple[int, ...]
    """Lines that end too early, at the end of the file."""
    notes: tuple[str, ...]
    """What was taken otherwise than usual, in sentences."""
    sha256: str
    header_line: int

    def begins(self, column: int) -> NDArray[np.int64]:
        """(N,) where in `data` the cells of a column begin."""
        if column:
            return self.ends[:, column - 1] + 1
        first = np.zeros(len(self.ends), np.int64)
        first[1:] = self.ends[:-1, -1] + 1
        return first

    @property
    def has_blank(self) -> bool:
        """Whether some cell has nothing in it, not even a blank."""
        flat = self.ends.reshape(-1)
        return bool(flat[0] == 0 or (np.diff(flat) == 1).any())

    def cell(self, row: int, column: int) -> str:
        """One cell, without blanks around it."""
        begin = int(self.begins(column)[row]) if column else self._row_begin(row)
        raw = self.data[begin : int(self.ends[row, column])]
        return raw.decode("utf-8", "replace").translate(_SHOWN).strip()

    def _row_begin(self, row: int) -> int:
        return int(self.ends[row - 1, -1]) + 1 if row else 0


def read_text(
    path: Path,
    *,
    skip_lines: int = 0,
    header: tuple[str, ...] | None = None,
    delimiter: str | None = None,
) -> Text:
    """Read a file. With `header` the file has none, and these are the names of its columns.

    Raises `RecordingError` where it is not there, empty, of another encoding, or ragged.
    """
    raw = _read(path)
    digest = hashlib.sha256(raw).hexdigest()
    ended = raw.endswith((b"\n", b"\r"))
    raw = _lines(path, raw)
    if not ended:
        raw = _without_half_a_number(raw)
    number = 1
    for _ in range(skip_lines):
        end = raw.find(b"\n")
        if end < 0:
            break
        raw, number = raw[end + 1 :], number + 1
    while raw[:1] == b"\n":
        raw, number = raw[1:], number + 1
    if not raw or raw.isspace():
        raise RecordingError(
            path, "an empty file", "a header and samples", "exporting the run again"
        )
    raw, notes = _delimited(path, raw, delimiter, number)
    if b'"' in raw:
        return _quoted(path, raw, header, number, digest, notes)
    if header is None:
        end = raw.index(b"\n")
        names, raw, first = _names(raw[:end]), raw[end + 1 :], number + 1
    else:
        names, first = list(header), number
    raw, lines = _without_blank_lines(raw, first)
    if not lines.size:
        raise RecordingError(
            path, "0 samples", "at least one", "exporting the run again", line=number
        )
    return _rectangular(path, raw, names, lines, notes, digest, number)


def _read(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise RecordingError(path, "a folder", "a file", "naming the file in it")
        if not path.exists():
            raise RecordingError(
                path, "no such file", "the stream named in recording.toml", "adding it"
            )
        raw = path.read_bytes()
    except OSError as error:
        raise RecordingError(
            path, f"an unreadable file ({error.strerror})", "one to read", "its permissions"
        ) from error
    if not raw:
        raise RecordingError(
            path, "an empty file", "a header and samples", "exporting the run again"
        )
    return raw


def _lines(path: Path, raw: bytes) -> bytes:
    """UTF-8 without a mark, lines ended by a line feed."""
    for mark, name in _ENCODINGS.items():
        if raw.startswith(mark):
            raise _encoding(path, name)
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if b"\0" in raw[:4096] or b"\0" in raw:
        sparse = raw[:4096].count(b"\0") > 0.3 * len(raw[:4096])
        raise _encoding(path, "UTF-16" if sparse else "text with NUL bytes")
    if not raw.isascii():
        try:
            raw.decode("utf-8")
        except UnicodeDecodeError as error:
            line = raw.count(b"\n", 0, error.start) + 1
            raise RecordingError(
                path,
                f"byte 0x{raw[error.start]:02x}, which is not UTF-8",
                "UTF-8",
                "saving as UTF-8",
                line=line,
            ) from None
    if b"\r" in raw:
        raw = raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return raw if raw.endswith(b"\n") else raw + b"\n"


def _without_half_a_number(raw: bytes) -> bytes:
    """The same without a last cell that ends within a number, so that its line counts as cut short."""
    at = max(raw.rfind(b",", 0, -1), raw.rfind(b";", 0, -1), raw.rfind(b"\t", 0, -1))
    last = raw[at + 1 : -1].strip()
    if at > raw.rfind(b"\n", 0, -1) and last and _BROKEN_OFF.fullmatch(last):
        return raw[:at] + b"\n"
    return raw


def _encoding(path: Path, name: str) -> RecordingError:
    return RecordingError(path, name, "UTF-8", "saving as UTF-8")


def _delimited(
    path: Path, raw: bytes, delimiter: str | None, number: int
) -> tuple[bytes, tuple[str, ...]]:
    """The same with commas and decimal points, where that is unambiguous."""
    head = raw[: raw.index(b"\n")].decode("utf-8")
    if delimiter is None:
        found = [d for d in DELIMITERS if d in head]
        if len(found) > 1:
            names = " and ".join(DELIMITERS[d] for d in found)
            raise RecordingError(
                path,
                f"a header with {names}",
                "one delimiter",
                'stating which: delimiter = ";" in its section of recording.toml',
                line=number,
            )
        delimiter = found[0] if found else ","
    if delimiter == ",":
        return raw, ()
    notes = [f"cells are separated by {DELIMITERS[delimiter]}s"]
    if b'"' in raw:
        rows = list(csv.reader(io.StringIO(raw.decode("utf-8")), delimiter=delimiter))
        cells = [cell for row in rows[1:] for cell in row if _DECIMAL.fullmatch(cell)]
        if any("," in cell for cell in cells) and not any("." in cell for cell in cells):
            rows[1:] = [
                [c.replace(",", ".") if _DECIMAL.fullmatch(c) else c for c in row]
                for row in rows[1:]
            ]
            notes.append("numbers have decimal commas")
        out = io.StringIO()
        csv.writer(out, lineterminator="\n").writerows(rows)
        return out.getvalue().encode(), tuple(notes)
    table = bytearray(range(256))
    table[ord(delimiter)] = _COMMA
    end = raw.index(b"\n") + 1
    if b"," in raw[end:]:
        at = raw.index(b",", end)
        if b"." in raw[end:]:
            raise RecordingError(
                path,
                "decimal commas beside points",
                "one of them",
                "exporting with decimal points",
                line=number + raw.count(b"\n", 0, at),
            )
        table[_COMMA] = ord(".")
        notes.append("numbers have decimal commas")
    # A header may have commas of its own, such as in a remark.
    return raw[:end].translate(bytes(table)) + raw[end:].translate(bytes(table)), tuple(notes)


def _names(line: bytes) -> list[str]:
    return [cell.strip() for cell in line.decode("utf-8").split(",")]


def _without_blank_lines(raw: bytes, first: int) -> tuple[bytes, Indices]:
    """The rows without lines that hold nothing, and the number of the line of each."""
    newlines = _positions(raw, lambda block: block == _NEWLINE)
    lines = np.arange(first, first + len(newlines))
    flat = np.frombuffer(raw, np.uint8)
    begins = flat[np.concatenate([[0], newlines[:-1] + 1])] if len(newlines) else flat[:0]
    # Looked up where lines begin: to search the whole of a long file for each blank is slow.
    if not np.isin(begins, _BLANKS).any():
        return raw, lines
    rows = raw[:-1].split(b"\n")
    kept = np.array([bool(row.strip()) for row in rows], bool)
    left = [row for row, keep in zip(rows, kept, strict=True) if keep]
    return b"\n".join([*left, b""]) if left else b"", lines[kept]


def _positions(
    raw: bytes, found: Callable[[NDArray[np.uint8]], NDArray[np.bool_]]
) -> NDArray[np.int64]:
    """Where bytes are of a kind; in blocks, for a mask of the whole file would be as large as the file."""
    flat = np.frombuffer(raw, np.uint8)
    blocks = [
        np.flatnonzero(found(flat[start : start + _BLOCK])) + start
        for start in range(0, len(flat), _BLOCK)
    ]
    return np.concatenate(blocks) if blocks else np.zeros(0, np.int64)


def _cell_ends(raw: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where cells end, and how many cells each line has."""
    ends = _positions(raw, lambda block: (block == _COMMA) | (block == _NEWLINE))
    last = np.flatnonzero(np.frombuffer(raw, np.uint8)[ends] == _NEWLINE)
    return ends, np.diff(last, prepend=-1)


def _rectangular(
    path: Path,
    raw: bytes,
    names: list[str],
    lines: Indices,
    notes: tuple[str, ...],
    digest: str,
    number: int,
) -> Text:
    """Rows of as many cells as there are names; a last one that is cut short is left out."""
    ends, widths = _cell_ends(raw)
    cut: tuple[int, ...] = ()
    width = len(names)
    if len(widths) > 1 and widths[-1] < widths[0] and (widths[:-1] == widths[0]).all():
        cut = (int(lines[-1]),)
        ends, widths, lines = ends[: -widths[-1]], widths[:-1], lines[:-1]
        raw = raw[: int(ends[-1]) + 1]
    if width > 1 and not names[-1] and (widths == width).all():
        ends_of = ends.reshape(-1, width)
        if ((ends_of[:, -1] - ends_of[:, -2]) == 1).all():
            names = names[:-1]
    elif (widths == width + 1).all():
        ends_of = ends.reshape(-1, width + 1)
        # A delimiter at the end of every row.
        if ((ends_of[:, -1] - ends_of[:, -2]) != 1).any():
            raise _ragged(path, width + 1, width, int(lines[0]))
        names = [*names, ""]
    bad = np.flatnonzero(widths != len(names))
    if bad.size and not (widths == len(names) + 1).all():
        raise _ragged(path, int(widths[bad[0]]), len(names), int(lines[bad[0]]))
    if len(names) > _MOST_COLUMNS:
        raise RecordingError(
            path, f"{len(names)} columns", f"{_MOST_COLUMNS} at most", "leaving some out"
        )
    shape = (len(lines), int(widths[0]))
    return Text(path, raw, tuple(names), ends.reshape(shape), lines, cut, notes, digest, number)


def _ragged(path: Path, got: int, expected: int, line: int) -> RecordingError:
    return RecordingError(
        path,
        f"{got} cells",
        f"{expected} as in the header",
        "completing the row or removing it",
        line=line,
    )


def _quoted(
    path: Path,
    raw: bytes,
    header: tuple[str, ...] | None,
    number: int,
    digest: str,
    notes: tuple[str, ...],
) -> Text:
    """A file with quoted cells, by Python's reader."""
    rows, lines = [], []
    reader = csv.reader(io.StringIO(raw.decode("utf-8"), newline=""), strict=True)
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append([cell.translate(_HIDDEN).strip() for cell in row])
                lines.append(reader.line_num + number - 1)
    except csv.Error as error:
        raise RecordingError(
            path,
            f"quotes that do not close ({error})",
            "cells quoted whole",
            "correcting the line",
            line=reader.line_num + number - 1,
        ) from None
    names = list(header or (name.translate(_SHOWN) for name in rows[0]))
    skip = 0 if header else 1
    if len(rows) == skip:
        raise RecordingError(
            path, "0 samples", "at least one", "exporting the run again", line=number
        )
    data = "".join(",".join(row) + "\n" for row in rows[skip:]).encode()
    at = np.array(lines[skip:], np.intp)
    return _rectangular(path, data, names, at, notes, digest, number)
