"""Reading and writing JSON documents: numbers that are not finite are null, arrays are lists."""

import re
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.atomic import write_whole
from jaxekf.io.description import SCHEMA_VERSION

_EXCERPT = 12
"""Bytes shown of a text that is not JSON."""


class Document(msgspec.Struct, kw_only=True):
    """A JSON document; keys that are not known are ignored when it is read."""

    schema_version: int = SCHEMA_VERSION


DocumentT = TypeVar("DocumentT", bound=Document)


def plain(document: Any) -> Any:
    """Convert a document to dicts, lists, texts and numbers, as they are in its JSON text."""
    return msgspec.json.decode(msgspec.json.encode(document, enc_hook=_plain_value))


def as_text(document: Any) -> str:
    """Convert a document to indented JSON text with a final line break."""
    encoded = msgspec.json.encode(document, enc_hook=_plain_value)
    return msgspec.json.format(encoded, indent=2).decode() + "\n"


def write(file: Path, document: Any) -> None:
    """Write a document to a file, atomically; an existing file is replaced."""
    write_whole(file, as_text(document))


def convert(document: Any, kind: Any) -> Any:
    """Convert plain dicts and lists to structures.

    Raises `msgspec.ValidationError`, which names the key, for a value of another type.
    """
    return msgspec.convert(document, kind, dec_hook=_array)


def read(file: Path, kind: type[DocumentT], remedy: str) -> DocumentT:
    """Read a document from a file.

    Raises `RecordingError`, which names file and key, for a file that is missing or not JSON, for another
    version, and for a key that is missing or has a value of another type.
    """
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        raise RecordingError(file, "no such file", "a JSON document", remedy) from None
    try:
        found = msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        got = f"text that is not JSON ({error}{_excerpt(data, str(error))})"
        raise RecordingError(file, got, "JSON", remedy) from error
    version = found.get("schema_version") if isinstance(found, dict) else None
    if version != SCHEMA_VERSION:
        raise RecordingError(file, f"schema_version {version!r}", f"{SCHEMA_VERSION}", remedy)
    try:
        return convert(found, kind)
    except msgspec.ValidationError as error:
        key, got, expected = _fault(str(error))
        raise RecordingError(file, got, expected, remedy, column=key) from error


def _excerpt(data: bytes, error: str) -> str:
    """The text at the place that an error of the decoder names."""
    place = re.search(r"byte (\d+)", error)
    if place is None:
        return ""
    begin = int(place[1])
    return f": {data[begin : begin + _EXCERPT].decode('utf-8', 'replace')}"


def _fault(error: str) -> tuple[str, str, str]:
    """Key, type found and type expected, from an error of `msgspec`."""
    message, _, place = error.replace("`", "").partition(" - at $")
    key = place.removeprefix(".")
    if missing := re.fullmatch("Object missing required field (.+)", message):
        return ".".join(filter(None, (key, missing[1]))), "nothing", "a value"
    if wrong := re.fullmatch("Expected (.+), got (.+)", message):
        return key, wrong[2], wrong[1]
    return key, f"a value that is refused ({message})", "another value"


def _plain_value(value: Any) -> Any:
    """A value that `msgspec` does not know: arrays and numbers of NumPy and JAX, paths."""
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "__array__"):
        return np.asarray(value).tolist()
    raise NotImplementedError  # msgspec then names the type in its own error


def _array(_: type, value: Any) -> Any:
    """An array of a number or nested lists of one shape; null is NaN."""
    return np.array(value, float)
