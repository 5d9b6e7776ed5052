"""A recorded run in one file: which data sets it has, of which type, shape, unit and frame."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import RecordingError
from jaxekf.recordings.facts import BODY_TO_REFERENCE

KIND = "jaxekf run"
"""What `kind` says at the root."""
TIME, COUNT, NUMBER, FLAG, TEXT = "time", "count", "number", "flag", "text"
_LARGEST_EXACT = 2**53
"""Integers up to here are float64 without loss."""


class Field(NamedTuple):
    """One data set of a stream."""

    kind: str
    shape: tuple[str | int, ...] = ()
    """N samples, M markers, L landmarks."""
    unit: str = ""
    frame: str = ""
    needed: bool = False

    @property
    def described(self) -> dict[str, str]:
        """Its attributes."""
        about = {"unit": self.unit, "frame": self.frame}
        return {key: text for key, text in about.items() if text}


_TIMES = Field(TIME, ("N",), "ns", needed=True)
_LATENCY = Field(COUNT, (), "ns")
_ATTITUDE = Field(NUMBER, ("N", 4), "1", BODY_TO_REFERENCE, needed=True)
_POSITION = Field(NUMBER, ("N", 3), "m", "reference")
_FLAGS = Field(FLAG, ("N",), "1")

LAYOUT: Mapping[str, Mapping[str, Field]] = {
    "optical": {
        "time_ns": _TIMES,
        "q_ref_body": _ATTITUDE,
        "valid": _FLAGS,
        "position": _POSITION,
        "error": Field(NUMBER, ("N",), "m"),
        "p_body_tool": Field(NUMBER, (3,), "m", "body"),
        "latency_ns": _LATENCY,
    },
    "markers": {
        "time_ns": _TIMES,
        "names": Field(TEXT, ("M",), needed=True),
        "position": Field(NUMBER, ("N", "M", 3), "m", "reference", needed=True),
        "visible": Field(FLAG, ("N", "M"), "1"),
        "p_body_marker": Field(NUMBER, ("M", 3), "m", "body", needed=True),
        "quality": Field(NUMBER, ("N", "M")),
        "quality_min": Field(NUMBER),
        "error": Field(NUMBER, ("N", "M"), "m"),
        "latency_ns": _LATENCY,
    },
    "camera": {
        "time_ns": _TIMES,
        "names": Field(TEXT, ("L",), needed=True),
        "pixel": Field(NUMBER, ("N", "L", 2), "px", "image, u to the right, v down", needed=True),
        "visible": Field(FLAG, ("N", "L"), "1"),
        "p_ref_landmark": Field(NUMBER, ("L", 3), "m", "reference", needed=True),
        "focal": Field(NUMBER, (2,), "px", needed=True),
        "centre": Field(NUMBER, (2,), "px", needed=True),
        "radial": Field(NUMBER, (2,), "1"),
        "p_body_camera": Field(NUMBER, (3,), "m", "body"),
        "q_body_camera": Field(NUMBER, (4,), "1", "w,x,y,z, camera to body"),
        "sigma": Field(NUMBER, ("N", "L"), "px"),
        "latency_ns": _LATENCY,
    },
    "imu": {
        "time_ns": _TIMES,
        "gyroscope": Field(NUMBER, ("N", 3), "rad/s", "body", needed=True),
        "accelerometer": Field(NUMBER, ("N", 3), "m/s^2", "body"),
        "magnetometer": Field(NUMBER, ("N", 3), "", "body"),
    },
    "encoder": {
        "time_ns": _TIMES,
        "q_ref_body": _ATTITUDE,
        "valid": _FLAGS,
        "scored": _FLAGS,
        "position": _POSITION,
    },
}
"""Streams and their data sets, the same paths in HDF5 and NPZ."""


def check_names(place: str, label: str, names: set[str]) -> None:
    """A group holds the data sets that it must, and none that is not known."""
    fields = LAYOUT[label]
    missing = [key for key, field in fields.items() if field.needed and key not in names]
    unknown = sorted(names - set(fields))
    if missing or unknown:
        wrong = [f"without {', '.join(missing)}"] if missing else []
        wrong += [f"with the unknown {', '.join(unknown)}"] if unknown else []
        layout = ", ".join(key if field.needed else f"[{key}]" for key, field in fields.items())
        raise RecordingError(
            f"{place}:{label}",
            f"the data sets {', '.join(sorted(names)) or 'none'}, {' and '.join(wrong)}",
            f"{layout} (those in brackets may be left out)",
            "adding, renaming or removing data sets",
        )


def check_described(place: str, key: str, about: Mapping[str, str], field: Field) -> None:
    """Unit and frame are what this version reads, where they are said: nothing is taken for another."""
    for name, expected in field.described.items():
        if name in about and about[name] != expected:
            raise RecordingError(
                f"{place}:{key}@{name}",
                f"'{about[name]}'",
                f"'{expected}'",
                "converting the numbers, or leaving the attribute out where it is only another word",
            )


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


def content_hash(said: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    """SHA-256 of what is said at the root and of every data set, in the order of their paths.

    Of values, not of bytes in a file: HDF5 and NPZ files of one run have the same.
    """
    state = hashlib.sha256()
    for key in ("schema_version", "name", "info"):
        state.update(json.dumps([key, said.get(key)]).encode())
    for key, value in sorted(data.items()):
        if isinstance(value, tuple):
            state.update(json.dumps([key, value]).encode())
            continue
        array = np.ascontiguousarray(value)
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        state.update(json.dumps([key, little.dtype.str, np.shape(value)]).encode())
        state.update(little.tobytes())
    return state.hexdigest()
