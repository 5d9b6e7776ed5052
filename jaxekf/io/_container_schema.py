"""Types, shapes, units and frames of the data sets in a run's HDF5 or NPZ file, against its schemas."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import RecordingError
from jaxekf.io.schema import COUNT, FLAG, TEXT, TIME, Field

KIND = "jaxekf run"
"""Attribute `kind` of the root."""
_LARGEST_EXACT = 2**53
"""Integers up to here are float64 without loss."""


def check_names(place: str, label: str, names: set[str], fields: Mapping[str, Field]) -> None:
    """A group holds the data sets that it must, and none that is not known."""
    missing = [key for key, field in fields.items() if field.needed and key not in names]
    unknown = sorted(names - set(fields))
    if missing or unknown:
        wrong = [f"without {', '.join(missing)}"] if missing else []
        wrong += [f"with the unknown {', '.join(unknown)}"] if unknown else []
        layout = ", ".join(key if field.needed else f"[{key}]" for key, field in fields.items())
        got = f"the data sets {', '.join(sorted(names)) or 'none'}, {' and '.join(wrong)}"
        expected = f"{layout} (those in brackets may be left out)"
        hint = "adding, renaming or removing data sets"
        raise RecordingError(f"{place}:{label}", got, expected, hint)


def check_described(place: str, key: str, about: Mapping[str, Any], field: Field) -> None:
    """Unit and frame, where stated, are those that this version reads."""
    for name, expected in field.described.items():
        where = f"{key}@{name}"
        if where in about and (stated := str(about[where])) != expected:
            hint = (
                "converting the numbers, or leaving the attribute out where it is only another word"
            )
            raise RecordingError(f"{place}:{where}", f"'{stated}'", f"'{expected}'", hint)


def check_type(place: str, key: str, dtype: np.dtype, field: Field) -> None:
    """The type is one that may be read without loss, judged before anything is read."""
    kind, size = dtype.kind, dtype.itemsize
    if field.kind == TEXT:
        good, expected = kind in "USO", "texts"
    elif field.kind in (TIME, COUNT):
        good, expected = kind in "iu", "integers, nanoseconds that fit into int64"
    elif field.kind == FLAG:
        good, expected = kind in "biu", "boolean, or integers 0 and 1"
    else:
        good = kind in "iu" or (kind == "f" and size <= 8)
        expected = "float64, or what becomes it without loss"
    if good:
        return
    hint = "exporting it again with this type"
    if field.kind == TIME and kind == "f":
        hint = "computing the times as integers: a float cannot hold nanoseconds since 1970"
    raise RecordingError(f"{place}:{key}", f"the type {dtype}", expected, hint)


def check_shape(
    place: str, key: str, shape: tuple[int, ...], field: Field, sizes: dict[str, int]
) -> None:
    """The shape is the documented one; `sizes` of N, M and L are filled in by the first that has them."""
    fits = len(shape) == len(field.shape) or (field.shape == () and shape == (1,))
    for wanted, size in zip(field.shape, shape, strict=False):
        fits &= size == (sizes.setdefault(wanted, size) if isinstance(wanted, str) else wanted)
    if not fits:
        names = ", ".join(
            f"{name} = {sizes[name]}" for name in field.shape if isinstance(name, str)
        )
        expected = f"({', '.join(map(str, field.shape))})" + (f" with {names}" if names else "")
        raise RecordingError(
            f"{place}:{key}", f"the shape {shape}", expected, "exporting the whole data set again"
        )
    if field.kind == TIME and shape[0] == 0:
        raise RecordingError(f"{place}:{key}", "0 samples", "at least one", "recording again")


def exact(place: str, key: str, raw: NDArray[Any], field: Field) -> Any:
    """An array in the type that a recording has, or an error where that would change a value."""

    def refuse(bad: NDArray[np.bool_], expected: str) -> None:
        if bad.any():
            at = tuple(int(i) for i in np.argwhere(bad)[0])
            where = f"{place}:{key}[{', '.join(map(str, at))}]" if at else f"{place}:{key}"
            hint = "exporting it again with values that fit"
            raise RecordingError(where, f"{raw[at]} of type {raw.dtype}", expected, hint)

    if field.kind == TEXT:
        return tuple(t.decode() if isinstance(t, bytes) else str(t) for t in raw.tolist())
    raw = raw.reshape(()) if field.shape == () else raw
    if field.kind in (TIME, COUNT):
        if raw.dtype.kind == "u":
            refuse(raw > np.uint64(2**63 - 1), "a time that fits into int64")
        values = raw.astype(np.int64)
        if field.kind == COUNT:
            refuse(values < 0, "0 or more")
        return values
    if field.kind == FLAG:
        if raw.dtype.kind != "b":
            refuse((raw != 0) & (raw != 1), "0 or 1")
        return raw.astype(bool)
    if raw.dtype.kind in "iu" and raw.dtype.itemsize > 4:
        bad = raw > _LARGEST_EXACT
        refuse(bad if raw.dtype.kind == "u" else bad | (raw < -_LARGEST_EXACT), "at most 2^53")
    return raw.astype(np.float64)


def content_hash(attributes: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    """SHA-256 of the attributes of the root and of every data set, in the order of their paths.

    Of values, not of bytes in a file: HDF5 and NPZ files of one run have the same.
    """
    state = hashlib.sha256()
    for key in ("schema_version", "name", "info"):
        state.update(json.dumps([key, attributes.get(key)]).encode())
    for key, value in sorted(data.items()):
        if isinstance(value, tuple):
            state.update(json.dumps([key, value]).encode())
            continue
        array = np.ascontiguousarray(value)
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        state.update(json.dumps([key, little.dtype.str, np.shape(value)]).encode())
        state.update(little.tobytes())
    return state.hexdigest()
