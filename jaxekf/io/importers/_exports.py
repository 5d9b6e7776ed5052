"""Text exports of other programs: lines of cells with headers of their own, plain or gzipped.

Every fault is named by file, line and column. A last line that is cut short is left out; a ragged one
before it is an error.
"""

import csv
import gzip
import re
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Indices, Intake, Place, Reason
from jaxekf.recordings.types import Flags, Floats, Optical, Recording, Times

METRES = {"m": 1.0, "meters": 1.0, "cm": 0.01, "centimeters": 0.01, "mm": 1e-3, "millimeters": 1e-3}
"""Metres in a unit of length."""
LARGEST = 1e20
"""What is larger is no number but a mark that there is none (NDI writes -3.697314e28)."""
_NUMBER = re.compile(
    r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE
)
_ENCODINGS = {b"\xff\xfe": "UTF-16", b"\xfe\xff": "UTF-16"}
_HEAD = 30
"""Lines within which a header must stand."""
_DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
_SHOWN = 12


class Cells(Sequence[list[str]]):
    """Lines as lists of cells, taken apart when they are asked for: a long export has millions."""

    def __init__(self, texts: list[str], delimiter: str) -> None:
        self.texts, self.delimiter = texts, delimiter

    def __len__(self) -> int:
        return len(self.texts)

    @overload
    def __getitem__(self, at: int) -> list[str]: ...
    @overload
    def __getitem__(self, at: slice) -> list[list[str]]: ...
    def __getitem__(self, at: int | slice) -> list[str] | list[list[str]]:
        if isinstance(at, slice):
            return [self._row(text) for text in self.texts[at]]
        return self._row(self.texts[at])

    def _row(self, text: str) -> list[str]:
        row = text.split(self.delimiter)
        if '"' in text:
            # What is quoted beyond measure is left as it stands, to be refused as no number.
            with suppress(csv.Error):
                row = next(csv.reader([text], delimiter=self.delimiter))
        return [cell.strip() for cell in row]


class Lines(NamedTuple):
    """A file as lines of cells, without blank ones."""

    path: Path
    cells: Cells
    """Cells of each line, without blanks around them."""
    numbers: list[int]
    """Number of each line in the file."""
    delimiter: str

    def find(self, words: Sequence[str], what: str) -> int:
        """The first line near the top that has all of these words among its columns' names, in any case."""
        wanted = {word.lower() for word in words}
        for i, row in enumerate(self.cells[:_HEAD]):
            if wanted <= {bare(cell) for cell in row}:
                return i
        raise RecordingError(
            self.path,
            f"no line with {', '.join(words)} among the first {min(_HEAD, len(self.cells))}",
            what,
            "another file, or exporting again with quaternions and positions",
        )

    def body(self, header: int, width: int) -> "Rows":
        """The rows of samples below a header line, each `width` cells wide at most."""
        return _rows(self, header + 1, len(self.cells), width)

    def until_blank(self, header: int, width: int) -> "Rows":
        """The same, up to the first blank line."""
        end = header + 1
        while end < len(self.cells) and self.numbers[end] == self.numbers[end - 1] + 1:
            end += 1
        return _rows(self, header + 1, end, width)


class Rows(NamedTuple):
    """Rows of samples, of equal width."""

    path: Path
    cells: Cells
    numbers: Indices
    """(N,) number of the line of each."""
    cut: tuple[int, ...]
    """Lines that end too early, at the end of the file."""

    @property
    def place(self) -> Place:
        return Place(self.path, self.numbers)

    def take(self, chosen: Flags) -> "Rows":
        """Some of the rows."""
        texts = [text for text, keep in zip(self.cells.texts, chosen, strict=True) if keep]
        cells = Cells(texts, self.cells.delimiter)
        return Rows(self.path, cells, self.numbers[chosen], self.cut)

    def words(self, column: int) -> list[str]:
        """Texts (N,) of a column."""
        return [row[column] for row in self.cells]

    def floats(self, columns: Sequence[int], labels: Sequence[str]) -> Floats:
        """Columns (N, len(columns)) as numbers, NaN where blank. Raises `RecordingError` at a text."""
        values = np.full((len(self.cells), len(columns)), np.nan)
        for i, row in enumerate(self.cells):
            for j, column in enumerate(columns):
                if row[column]:
                    values[i, j] = float(self._number(i, row[column], labels[j]))
        return values

    def times(self, column: int, label: str, nanoseconds: int | Decimal) -> tuple[Times, Flags]:
        """Stamps (N,) of a column in units of so many nanoseconds, exactly, and which rows have one."""
        times, known = np.zeros(len(self.cells), np.int64), np.zeros(len(self.cells), bool)
        for i, row in enumerate(self.cells):
            cell = row[column]
            if not cell:
                continue
            value = Decimal(self._number(i, cell, label)) * nanoseconds
            if not value.is_finite() or abs(value) >= 2**63:
                raise self.place.error(i, label, f"'{cell}'", "a time", "correcting the cell")
            times[i], known[i] = int(value.to_integral_value()), True
        return times, known

    def _number(self, row: int, cell: str, label: str) -> str:
        if not _NUMBER.fullmatch(cell):
            raise self.place.error(row, label, f"'{cell}'", "a number", "correcting the cell")
        return cell if self.cells.delimiter == "," else cell.replace(",", ".")


def bare(cell: str) -> str:
    """A column's name in lower case, without a unit behind it and without marks: ``Tx [mm]`` is ``tx``."""
    return re.sub(r"\s*[\[(].*[\])]\s*$", "", cell).strip().rstrip("#:").strip().lower()


def unit_of(cell: str) -> str | None:
    """The unit behind a column's name, in lower case; None where there is none."""
    found = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", cell)
    return found[1].lower() if found and found[1] else None


def length_unit(lines: Lines, at: int, unit: str, column: str) -> float:
    """Metres in a unit that a header states. Raises `RecordingError` for one that is not known."""
    if unit.lower() not in METRES:
        raise RecordingError(
            lines.path,
            f"the unit of length '{unit}'",
            "m, cm or mm",
            "exporting in millimetres",
            line=lines.numbers[at],
            column=column,
        )
    return METRES[unit.lower()]


def read_lines(path: Path | str, what: str) -> Lines:
    """A file's lines as cells; `what` says in messages what it should be.

    Raises `RecordingError` where it is not there, a folder, empty or not text in UTF-8.
    """
    path = Path(path)
    text = _text(path, what)
    if not text.strip():
        raise RecordingError(path, "an empty file", what, "exporting the recording again")
    counted = "\n".join(text.splitlines()[:_HEAD])
    delimiter = max(_DELIMITERS, key=lambda d: (counted.count(d), d == ","))
    texts, numbers = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.replace(delimiter, "").strip():
            texts.append(line)
            numbers.append(number)
    if not texts:
        raise RecordingError(path, "an empty file", what, "exporting the recording again")
    return Lines(path, Cells(texts, delimiter), numbers, delimiter)


def _text(path: Path, what: str) -> str:
    if path.is_dir():
        inside = sorted(child.name for child in path.iterdir() if child.is_file())
        told = ", ".join(inside[:_SHOWN]) + (", ..." if len(inside) > _SHOWN else "")
        got = f"a folder that holds {told}" if inside else "a folder without files"
        raise RecordingError(path, got, what, "naming one file in it")
    if not path.is_file():
        raise RecordingError(path, "no such file", what, "another path")
    try:
        raw = path.read_bytes()
        raw = gzip.decompress(raw) if raw[:2] == b"\x1f\x8b" else raw
    except (OSError, EOFError, zlib.error) as error:
        raise RecordingError(
            path, f"a file that cannot be read ({error})", what, "fetching it again"
        ) from error
    for mark, name in _ENCODINGS.items():
        if raw.startswith(mark):
            raise RecordingError(path, name, "UTF-8", "saving as UTF-8")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordingError(
            path,
            f"byte 0x{raw[error.start]:02x}, which is not UTF-8",
            "UTF-8",
            "saving as UTF-8",
            line=raw.count(b"\n", 0, error.start) + 1,
        ) from None


def _rows(lines: Lines, begin: int, end: int, width: int) -> Rows:
    texts, numbers, cut = [], [], []
    for i in range(begin, end):
        row = lines.cells[i]
        # Delimiters at the end of a row are no cells.
        if len(row) < width or any(row[width:]):
            if len(row) > width or i != len(lines.cells) - 1 or i == begin:
                raise RecordingError(
                    lines.path,
                    f"{len(row)} cells",
                    f"{width} as in the header",
                    "completing the row or removing it",
                    line=lines.numbers[i],
                )
            cut.append(lines.numbers[i])
            continue
        texts.append(lines.cells.texts[i])
        numbers.append(lines.numbers[i])
    if not texts:
        raise RecordingError(
            lines.path,
            "0 samples",
            "at least one",
            "exporting the recording again",
            line=lines.numbers[begin - 1],
        )
    cells = Cells(texts, lines.delimiter)
    return Rows(lines.path, cells, np.array(numbers, np.intp), tuple(cut))


def stripped(row: Sequence[str]) -> list[str]:
    """A header's cells without blank ones at its end."""
    row = list(row)
    while row and not row[-1]:
        row.pop()
    return row


def chosen_tool(lines: Lines, at: int, names: Sequence[str], tool: str | None) -> int:
    """Which of the tools that line `at` of a file names is meant, the only one where none is asked for.

    Raises `RecordingError`, which lists them.
    """
    told = ", ".join(names)
    if tool is None and len(names) == 1:
        return 0
    found = [i for i, name in enumerate(names) if tool and name.lower() == tool.strip().lower()]
    if len(found) == 1:
        return found[0]
    got = f"{len(names)} tools ({told})" if tool is None else f"no one tool '{tool}' among {told}"
    if not names:
        got = "no tool with a rotation and a position"
    raise RecordingError(
        lines.path, got, "one tool", "naming it: --tool NAME, tool=NAME", line=lines.numbers[at]
    )


class Timed(NamedTuple):
    """Rows that have a stamp, and what became of the others."""

    rows: Rows
    time_ns: Times
    dropped: dict[str, Reason]


def timed(rows: Rows, time_ns: Times, known: Flags) -> Timed:
    """Leave out rows without a stamp, and count those cut short. In an account, they have the stamp of the
    row before. Raises `RecordingError` where no row has one."""
    if not known.any():
        raise RecordingError(rows.path, "no row with a time", "one in each", "exporting again")
    before = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
    dropped = {}
    if not known.all():
        gone = np.flatnonzero(~known)
        dropped["no time"] = Reason(rows.numbers[gone], time_ns[before[gone]])
    if rows.cut:
        stamp = np.full(len(rows.cut), time_ns[before[-1]])
        dropped["cut short"] = Reason(np.array(rows.cut, np.intp), stamp)
    return Timed(rows.take(known), time_ns[known], dropped)


def accounted(account: Intake, source: Timed, notes: Sequence[str] = ()) -> Intake:
    """The account of a stream with the rows that had no part in it."""
    return replace(
        account,
        rows=account.rows + sum(reason.count for reason in source.dropped.values()),
        dropped={**account.dropped, **source.dropped},
        notes=(*_delimiting(source.rows.cells), *notes, *account.notes),
    )


def _delimiting(cells: Cells) -> tuple[str, ...]:
    if cells.delimiter == ",":
        return ()
    notes = [f"cells are separated by {_DELIMITERS[cells.delimiter]}s"]
    with_comma = (i for i, text in enumerate(cells.texts) if "," in text)
    if any("," in cell and _NUMBER.fullmatch(cell) for i in with_comma for cell in cells[i]):
        notes.append("numbers have decimal commas")
    return tuple(notes)


def pose_stream(
    source: Timed, quaternion: Floats, position: Floats, **said: Any
) -> tuple[Optical, Intake]:
    """A tracker's poses of an export as `intake.optical` judges them (w, x, y, z; metres).

    Numbers too large to be any are marks of a lost tool; so is the identity at the origin, which no tool
    has by chance.
    """
    with np.errstate(invalid="ignore"):
        marked = (np.abs(np.c_[quaternion, position]) > LARGEST).any(axis=1)
        none = (np.abs(quaternion[:, 1:]) < 1e-9).all(axis=1) & (np.abs(position) < 1e-9).all(
            axis=1
        )
    none &= np.abs(np.abs(quaternion[:, 0]) - 1.0) < 1e-9
    also = {"no value (-3.7e28)": marked, "identity at the origin": none}
    optical, account = screening.optical(
        source.rows.place, source.time_ns, quaternion, position, also=also, **said
    )
    return optical, accounted(account, source)


def tracker_alone(
    path: Path | str, otherwise: str, optical: Optical, account: Intake, info: dict[str, Any]
) -> Recording:
    """A run of a tracker without an IMU, named after its file, or `otherwise`."""
    name = Path(path).name.split(".")[0] or otherwise
    return Recording(name, optical=optical, info=info, path=Path(path), intake={"optical": account})
