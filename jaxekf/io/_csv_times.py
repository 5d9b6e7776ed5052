"""Times in text to int64 nanoseconds and back, exactly."""

import re
from collections.abc import Callable
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from jaxekf.io._csv_text import Text
from jaxekf.recordings.types import NANOSECONDS, Times

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
CHUNK = 1 << 16
_LONGEST = 20
"""Characters of a time that is read without a Python object."""
_LARGEST_NS = Decimal(2**63 - 1)
_POWERS = np.array([10**i for i in range(20)], np.uint64)


def parse_seconds(text: str, exponent: int = 9) -> int:
    """Decimal seconds, or units of another `exponent`, to nanoseconds, exactly; further digits are rounded.

    Raises `ValueError` for a text that is not a time within the 64 bits of nanoseconds.
    """
    whole, _, part = text.partition(".")
    digits = (whole + part).isascii() and whole.isdigit() and (part.isdigit() or not part)
    if exponent == 9 and digits and len(whole) < 10 and len(part) <= 9:
        return int(whole) * NANOSECONDS + int(part.ljust(9, "0") or 0)
    return scaled(text, Decimal(1).scaleb(exponent))


def scaled(text: str, unit_ns: Decimal) -> int:
    """A number of units of `unit_ns` nanoseconds to nanoseconds, rounded; raises `ValueError`."""
    value = Decimal(text) if NUMBER.fullmatch(text) else Decimal("nan")
    if not value.is_finite() or value.adjusted() > 20:
        raise ValueError(text)
    value = (value * unit_ns).to_integral_value()
    if not -_LARGEST_NS - 1 <= value <= _LARGEST_NS:
        raise ValueError(text)
    return int(value)


def format_seconds(time_ns: int, decimals: int = 0) -> str:
    """Nanoseconds as decimal seconds, exactly, with at least this number of `decimals`."""
    sign, size = ("-", -time_ns) if time_ns < 0 else ("", time_ns)
    whole, part = divmod(int(size), NANOSECONDS)
    digits = f"{part:09d}".rstrip("0").ljust(decimals, "0")
    return f"{sign}{whole}.{digits}" if digits else f"{sign}{whole}"


def parsed_times(text: Text, column: int, unit_ns: Decimal, parsed: Callable[[int], int]) -> Times:
    """A column (N,) of times in units of `unit_ns` nanoseconds.

    Cells of digits with at most one decimal mark are read together; `parsed` reads the others by row.
    """
    exponent = unit_ns.adjusted()
    decimal = unit_ns == Decimal(1).scaleb(exponent)
    begin, end = text.begins(column), text.ends[:, column]
    times = np.zeros(len(text.lines), np.int64)
    for i in range(0, len(times), CHUNK):
        chunk = slice(i, i + CHUNK)
        found, plain = _plain_times(text, begin[chunk], end[chunk], exponent if decimal else 0)
        if not decimal:
            plain &= found <= int(_LARGEST_NS / unit_ns)
            counts = np.where(plain, found, 0).tolist()
            found = np.array([int((unit_ns * n).to_integral_value()) for n in counts], np.int64)
        times[chunk] = found
        for row in np.flatnonzero(~plain):
            times[i + row] = parsed(i + int(row))
    return times


def _plain_times(
    text: Text, begin: NDArray[np.int64], end: NDArray[np.int64], exponent: int
) -> tuple[Times, NDArray[np.bool_]]:
    """Times (n,) of cells that are digits with at most one decimal mark, and which cells are."""
    width = int((end - begin).max(initial=1))
    plain = (end > begin) & (end - begin <= _LONGEST)
    cells = gather(text.data, begin, end, min(width, _LONGEST))
    mark = ord("\x1f" if text.decimal_commas else ".")
    value = np.zeros(len(begin), np.uint64)
    digits, decimals = np.zeros((2, len(begin)), np.int64)
    after = np.zeros(len(begin), bool)
    for column in cells.T:
        digit = (column >= 48) & (column <= 57)
        point = column == mark
        plain &= digit | (point & ~after) | (column == 0)
        value = np.where(digit, value * 10 + (column - 48), value)
        digits += digit
        decimals += digit & after
        after |= point
    power = exponent - decimals
    # 19 digits fit into 64 bits without a sign; a fraction of a nanosecond has to be rounded.
    plain &= (digits > 0) & (power >= 0) & (digits + power <= 19)
    value = np.where(plain, value * _POWERS[np.clip(power, 0, 19)], np.uint64(0))
    plain &= value < 2**63
    return np.where(plain, value, np.uint64(0)).astype(np.int64), plain


def gather(
    data: bytes, begin: NDArray[np.int64], end: NDArray[np.int64], width: int
) -> NDArray[np.uint8]:
    """(n, width) bytes of cells, padded with zeros."""
    flat = np.frombuffer(data, np.uint8)
    at = begin[:, None] + np.arange(width)
    inside = at < end[:, None]
    return np.where(inside, flat[np.minimum(at, len(flat) - 1)], 0).astype(np.uint8)
