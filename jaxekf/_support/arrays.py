"""Arguments as NumPy arrays of one type: converted, without a copy where they have it, or refused in a
sentence.

What can be an array by NumPy's protocol is accepted: lists, arrays of JAX, columns of pandas.
"""

import operator
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import ArgumentError

Refuse = Callable[[str, str, str], Exception]
"""Builds an error from three texts: the value found, the expected one, and the remedy."""
Shape = tuple[int | None, ...]
"""The length of each axis; None for any."""

_FLAG = (bool, np.bool_)
_EXACTLY = "np.round(1e9 * seconds).astype(np.int64), or reading the nanoseconds as integers"


def argument(name: str) -> Refuse:
    """The error of an argument of this name."""
    return lambda got, expected, hint: ArgumentError(
        f"{name}: got {got}, expected {expected}; try {hint}"
    )


def floats(value: Any, refuse: Refuse, shape: Shape | None = None) -> NDArray[np.float64]:
    """Real numbers as float64, of a shape if one is given."""
    array = _plain(value, refuse)
    if array.dtype.kind == "O" and _all(array, Real):
        array = array.astype(np.float64)
    if array.dtype.kind not in "fiu":
        raise refuse(_contents(array), "real numbers", "converting them: np.asarray(values, float)")
    array = array.astype(np.float64, copy=False)
    check_shape(array, refuse, shape)
    return array


def times(value: Any, refuse: Refuse, shape: Shape | None = (None,)) -> NDArray[np.int64]:
    """Times (N,) as int64 nanoseconds, exactly; `datetime64` counts from its epoch."""
    array = _plain(value, refuse)
    kind, found = array.dtype.kind, None
    if kind == "M":
        found = array.astype("M8[ns]")
        is_exact = not np.isnat(array).any() and (found.astype(array.dtype) == array).all()
        found = found.astype(np.int64) if is_exact else None
    elif kind in "iu" or array.size == 0 or (kind == "O" and _all(array, Integral)):
        limits = np.iinfo(np.int64)
        fits = kind == "i" or array.size == 0
        if fits or (array.min() >= limits.min and array.max() <= limits.max):
            found = array.astype(np.int64, copy=False)
    if found is None:
        raise refuse(_contents(array), "int64 nanoseconds", _EXACTLY)
    check_shape(found, refuse, shape)
    return found


def flags(value: Any, refuse: Refuse, shape: Shape | None = None) -> NDArray[np.bool_]:
    """Flags as bool: also numbers that are all 0 or 1."""
    array = _plain(value, refuse)
    if array.dtype.kind == "O" and all(isinstance(item, _FLAG) for item in array.flat):
        array = array.astype(np.bool_)
    if array.dtype.kind in "fiu" and ((array == 0) | (array == 1)).all():
        array = array == 1
    if array.dtype.kind != "b":
        raise refuse(_contents(array), "True or False each", "a condition, such as values > 0")
    check_shape(array, refuse, shape)
    return array


def float_tree(tree: Any, refuse: Refuse, *, keep_whole: bool = False) -> Any:
    """A pytree of arrays with float64 leaves; a list is a leaf. With `keep_whole`, arrays of whole numbers
    and flags stay what they are."""
    if tree is None:
        return None
    if isinstance(tree, Mapping):
        return {key: float_tree(v, refuse, keep_whole=keep_whole) for key, v in tree.items()}
    if isinstance(tree, tuple):
        parts = [float_tree(value, refuse, keep_whole=keep_whole) for value in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    kept = keep_whole and isinstance(tree, np.ndarray) and tree.dtype.kind in "iub"
    return tree if kept else floats(tree, refuse)


def number(value: Any, refuse: Refuse) -> float:
    """One real number."""
    return float(floats(value, refuse, ()))


def whole_number(value: Any, refuse: Refuse) -> int:
    """One whole number, as an int."""
    try:
        if not isinstance(value, _FLAG):
            return operator.index(value)
    except TypeError:
        pass
    got = f"{value!r} of type {type(value).__name__}"
    raise refuse(got, "a whole number", "round(value), which gives an int")


def need(value: Any, kind: type, name: str, remedy: str) -> None:
    """Raise `ArgumentError` if an argument of this name is not of a public class."""
    if not isinstance(value, kind):
        got = f"a value of type {type(value).__name__}"
        raise argument(name)(got, f"a jaxekf.{kind.__name__}", remedy)


def check_shape(array: NDArray[Any], refuse: Refuse, shape: Shape | None) -> None:
    """Raise if an array does not have a shape."""
    if shape is None:
        return
    if array.ndim != len(shape) or any(
        b not in (None, a) for a, b in zip(array.shape, shape, strict=True)
    ):
        named = ", ".join("N" if size is None else str(size) for size in shape)
        expected = f"({named},)" if len(shape) == 1 else f"({named})"
        hint = "one row for each sample" if None in shape else "np.reshape, or other values"
        raise refuse(f"an array of shape {array.shape}", f"one of shape {expected}", hint)


def _plain(value: Any, refuse: Refuse) -> NDArray[Any]:
    """An array without a mask, of any type."""
    if np.ma.isMaskedArray(value):
        masked = int(np.ma.getmaskarray(value).sum())
        if masked:
            hint = "filled(np.nan) for numbers, and valid=False for samples without a time"
            raise refuse(
                f"{masked} masked entries of {value.size}", "an array without a mask", hint
            )
        value = np.ma.getdata(value)
    try:
        return np.asarray(value)
    except Exception as error:  # an object's own conversion may raise anything
        reason = str(error).split(". ")[0]
        got = f"{type(value).__name__} that is not an array ({reason})"
        raise refuse(got, "an array", "np.asarray of rows of equal length") from error


def _all(array: NDArray[Any], kind: Any) -> bool:
    """Whether all objects are of a kind of numbers, and none a flag."""
    return all(isinstance(item, kind) and not isinstance(item, _FLAG) for item in array.flat)


def _contents(array: NDArray[Any]) -> str:
    if array.dtype.kind == "O":
        names = sorted({type(item).__name__ for item in array.flat})
        return f"objects of type {', '.join(names[:4])}"
    return f"values of type {array.dtype}"
