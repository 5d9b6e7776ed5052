"""The text of a CSV file, whatever its compression, encoding and line ends."""

import gzip
import hashlib
import re
import zlib
from pathlib import Path
from typing import NamedTuple

from jaxekf._support.errors import RecordingError

_GZIP = b"\x1f\x8b"
_ENCODINGS = {
    b"\xff\xfe\x00\x00": "UTF-32",
    b"\x00\x00\xfe\xff": "UTF-32",
    b"\xff\xfe": "UTF-16",
    b"\xfe\xff": "UTF-16",
}
_LISTED_FILES = 12
_INCOMPLETE_NUMBER = re.compile(rb"[+-]?(\d*\.?\d*[eE][+-]?|[.]?)|[+-]")
"""Part of a number that is no number itself, with which a truncated file may end."""


class Content(NamedTuple):
    """A file's text."""

    path: Path
    data: bytes
    """UTF-8, each line ended by a line feed."""
    sha256: str
    """Hash of the file as it is stored."""

    def line(self, offset: int) -> int:
        """Number, from 1, of the line at an offset of `data`."""
        return self.data.count(b"\n", 0, offset) + 1


def read_content(path: Path, expected: str = "a CSV file of samples") -> Content:
    """Read the text of a file; `expected` describes it in messages.

    Raises
    ------
    RecordingError
        If the file is missing, a folder, unreadable, empty or not UTF-8.
    """
    try:
        if path.is_dir():
            names = sorted(child.name for child in path.iterdir() if child.is_file())
            listed = ", ".join(names[:_LISTED_FILES]) + (", ..." * (len(names) > _LISTED_FILES))
            got = f"a folder that holds {listed}" if names else "a folder without files"
            raise RecordingError(path, got, expected, "naming one file in it")
        if not path.exists():
            raise RecordingError(path, "no such file", expected, "adding the file, or another path")
        raw = path.read_bytes()
        digest = hashlib.sha256(raw).hexdigest()
        raw = gzip.decompress(raw) if raw.startswith(_GZIP) else raw
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or error
        hint = "checking its permissions, or copying it again"
        raise RecordingError(
            path, f"a file that cannot be read ({reason})", expected, hint
        ) from error
    data = _decoded(path, raw)
    if data.isspace():
        raise empty_file(path, expected)
    return Content(path, data, digest)


def empty_file(path: Path, expected: str) -> RecordingError:
    """The error of a file without content."""
    return RecordingError(path, "an empty file", expected, "exporting the recording again")


def _decoded(path: Path, raw: bytes) -> bytes:
    """UTF-8 without a byte-order mark, lines ended by a line feed."""
    for mark, name in _ENCODINGS.items():
        if raw.startswith(mark):
            raise RecordingError(path, name, "UTF-8", "saving as UTF-8")
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if b"\0" in raw[:4096] or b"\0" in raw:
        sparse = raw[:4096].count(b"\0") > 0.3 * len(raw[:4096])
        name = "UTF-16" if sparse else "text with NUL bytes"
        raise RecordingError(path, name, "UTF-8", "saving as UTF-8")
    if not raw.isascii():
        try:
            raw.decode("utf-8")
        except UnicodeDecodeError as error:
            got = f"byte 0x{raw[error.start]:02x}, which is not UTF-8"
            raise RecordingError(
                path, got, "UTF-8", "saving as UTF-8", line=raw.count(b"\n", 0, error.start) + 1
            ) from None
    if b"\r" in raw:
        raw = raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return raw if raw.endswith(b"\n") else _without_half_a_number(raw + b"\n")


def _without_half_a_number(raw: bytes) -> bytes:
    """The text without a last cell that is part of a number, so that its line counts as truncated."""
    at = max(raw.rfind(b",", 0, -1), raw.rfind(b";", 0, -1), raw.rfind(b"\t", 0, -1))
    last = raw[at + 1 : -1].strip()
    if at > raw.rfind(b"\n", 0, -1) and last and _INCOMPLETE_NUMBER.fullmatch(last):
        return raw[:at] + b"\n"
    return raw
