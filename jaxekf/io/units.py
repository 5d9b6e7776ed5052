"""Units that CSV files may have, and their size in SI units. A new unit is an entry in `UNITS`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf.recordings.facts import wrong_entry
from jaxekf.recordings.types import Floats

UNITS: Mapping[str, dict[str, float]] = {
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "rad/s": {"rad/s": 1.0, "deg/s": np.pi / 180.0},
    "m/s^2": {"m/s^2": 1.0, "g": STANDARD_GRAVITY, "mm/s^2": 1e-3},
    "rad": {"rad": 1.0, "deg": np.pi / 180.0},
    "N": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "N m": {"N m": 1.0, "N mm": 1e-3},
    "Pa": {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3, "bar": 1e5},
}
"""Units that a file may have, and their size in the SI unit; any other SI unit is only itself."""


def factors(
    label: str, units: Sequence[str], about: Mapping[str, Any], place: Path | str
) -> tuple[float, ...]:
    """Size of each stated unit, ``unit = "deg/s, g"``, in the SI `units` of a stream; 1 where none is
    stated.

    Examples
    --------
    >>> from jaxekf.io import units
    >>> units.factors("optical", ["m"], {"unit": "mm"}, "recording.toml")
    (0.001,)
    """
    known = [UNITS.get(unit, {unit: 1.0}) for unit in units]
    value = about.get("unit")
    parts = [part.strip() for part in value.split(",")] if isinstance(value, str) else []
    good = all(part in choices for part, choices in zip(parts, known, strict=False))
    # Further units, such as a magnetometer's, are not used.
    if value is not None and (not parts or not good):
        expected = ", then ".join(" or ".join(choices) for choices in known)
        raise wrong_entry(place, f"{label}.unit", value, expected)
    stated = [choices[part] for part, choices in zip(parts, known, strict=False)]
    return (*stated, *[1.0] * (len(known) - len(stated)))


def scaled(values: Floats, factor: float) -> Floats:
    """Numbers in SI; the same array, no copy, where they are."""
    return values if factor == 1.0 else factor * values
