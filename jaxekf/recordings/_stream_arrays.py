"""The fields of a stream, or of samples, converted to the types that their annotations state."""

from collections.abc import Mapping
from dataclasses import fields
from functools import cache, partial
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from jaxekf._support import arrays
from jaxekf._support.arrays import Refuse, Shape
from jaxekf._support.errors import RecordingError

Times = NDArray[np.int64]
Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_NUMBERS = {int: arrays.whole_number, float: arrays.number}
_ARRAYS = {Times: arrays.times, Floats: arrays.floats, Flags: arrays.flags}


def convert(stream: Any, label: str, shapes: Mapping[str, Shape]) -> None:
    """Replace the fields of a frozen dataclass that have another type than is stated.

    Raises `RecordingError`, which names label and field, for a field that cannot be converted exactly or
    has not the shape in `shapes`.
    """
    for name, kind, is_optional in _kinds(type(stream)):
        value = getattr(stream, name)
        if value is None and is_optional:
            continue
        refuse = partial(RecordingError, label, column=name)
        if value is None:
            raise refuse("None", "a value for each sample", "leaving out the stream")
        if kind in _ARRAYS:
            found = _ARRAYS[kind](value, refuse, shapes.get(name))
        elif kind in _NUMBERS:
            found = _NUMBERS[kind](value, refuse)
        else:
            found = _words(value, refuse)
        if found is not value:
            object.__setattr__(stream, name, found)


@cache
def _kinds(cls: type) -> tuple[tuple[str, Any, bool], ...]:
    """Name and type of the fields that are converted, and whether they may be None."""
    known = {tuple[str, ...], *_ARRAYS, *_NUMBERS}
    stated = ((f.name, f.type, get_args(f.type)) for f in fields(cls))
    every = [
        (name, args[0] if type(None) in args else kind, type(None) in args)
        for name, kind, args in stated
    ]
    return tuple(one for one in every if one[1] in known)


def _words(value: Any, refuse: Refuse) -> tuple[str, ...]:
    """Names, as a tuple."""
    words = value if isinstance(value, tuple) else np.asarray(value).tolist()
    if not isinstance(words, list | tuple) or not all(isinstance(word, str) for word in words):
        raise refuse(f"{value!r}", "a sequence of names", "a tuple of texts")
    return value if isinstance(value, tuple) else tuple(words)
