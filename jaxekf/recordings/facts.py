"""Entries of a run's description whose meaning is fixed, each checked and named by its key."""

import math
from collections.abc import Mapping
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.recordings.types import Floats

FILE = "recording.toml"
"""The description of a run in a folder."""
BODY_TO_REFERENCE = "w,x,y,z, body to reference"


def wrong_entry(
    place: Path | str, key: str, value: Any, expected: str, hint: str = f"correcting {FILE}"
) -> RecordingError:
    """The error of an entry, by its whole name."""
    return RecordingError(place, f"{key} = {value!r}", expected, hint, column=key)


def finite_number(value: Any, place: Path | str, key: str) -> float:
    """A finite number."""
    number = as_number(value)
    if number is None:
        raise wrong_entry(place, key, value, "a finite number")
    return number


def finite_vector(value: Any, size: int, place: Path | str, key: str) -> Floats:
    """A vector (size,) of finite numbers."""
    vector = _vector(value, size)
    if vector is None:
        raise wrong_entry(place, key, value, f"{size} finite numbers")
    return vector


def nonzero_vector(value: Any, size: int, place: Path | str, key: str) -> Floats:
    """A vector (size,) of finite numbers that has a length, and so a direction."""
    vector = _vector(value, size)
    if vector is None or np.linalg.norm(vector) < 1e-9:
        raise wrong_entry(place, key, value, f"{size} finite numbers, not all 0")
    return vector


def unit_vector(value: Any, size: int, place: Path | str, key: str) -> Floats:
    """A direction or quaternion (size,), scaled to unit length.

    One that has it to rounding is left as it is, so that what is saved is read again exactly.
    """
    vector = nonzero_vector(value, size, place, key)
    length = np.linalg.norm(vector)
    return vector if abs(length - 1.0) < 1e-15 else vector / length


def known_entries(entries: Mapping[str, Any], place: Path | str) -> dict[str, list[float]]:
    """Those of a run's own entries whose meaning is fixed, as lists of floats.

    ``gravity_ref``    [x, y, z]     gravity vector in the reference frame, m/s^2, not 0
    ``field_ref``      [x, y, z]     of the magnetic field there, of which the horizontal direction counts
    ``p_body_object``  [x, y, z]     the point of the tool that is asked for, in the body, m
    ``q_body_object``  [w, x, y, z]  from its frame to the body's, scaled to unit length
    """
    known = {
        "gravity_ref": (nonzero_vector, 3),
        "field_ref": (nonzero_vector, 3),
        "p_body_object": (finite_vector, 3),
        "q_body_object": (unit_vector, 4),
    }
    return {
        key: read(entries[key], size, place, key).tolist()
        for key, (read, size) in known.items()
        if key in entries
    }


def _vector(value: Any, size: int) -> Floats | None:
    items = list(value) if isinstance(value, (list, tuple, np.ndarray)) else []
    found = [number for number in map(as_number, items) if number is not None]
    return np.array(found) if len(found) == len(items) == size else None


def as_number(value: Any) -> float | None:
    """A finite float of TOML's numbers; True and '1' are none."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
