"""Warnings and notes of a check, and the words that several checks share."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxekf.recordings.types import NANOSECONDS, Times


class Findings(NamedTuple):
    """Findings of one check on a run."""

    warnings: tuple[str, ...] = ()
    """To look at before the run is used."""
    notes: tuple[str, ...] = ()
    """Occur in good runs, too."""


def from_to(time_ns: Times, rows: NDArray[np.intp]) -> str:
    """First and last time of some rows, s on the recording's clock."""
    first, last = (f"{time_ns[i] / NANOSECONDS:.3f}" for i in (rows[0], rows[-1]))
    return f"at {first} s" if first == last else f"from {first} to {last} s"


def listed(words: Iterable[str]) -> str:
    """Words in a sentence: a, b and c."""
    *most, last = words
    return f"{', '.join(most)} and {last}" if most else last
