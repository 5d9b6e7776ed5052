"""Screening of quaternions: scaled to norm 1, with the reasons for which rows are masked."""

import numpy as np

from jaxekf.recordings.accounts import Place
from jaxekf.recordings.types import Flags, Floats

MOST_BAD_NORMS = 0.05
"""Share of rows with a norm that no rounding explains, above which the columns are no quaternions."""
NORM_ROUNDED, NORM_WRONG = 1e-3, 0.1


def whole(values: Floats) -> Flags:
    """Rows (N,) of values (N, c) that are finite."""
    return np.asarray(np.isfinite(values).all(axis=1))


def judge_quaternions(
    place: Place, values: Floats
) -> tuple[Floats, dict[str, Flags], tuple[str, ...]]:
    """Unit quaternions (N, 4) of what a tracker wrote, reasons to mask rows, and what was scaled.

    What is missing (blank, not finite, zero, or of a norm that no rounding explains) becomes the identity.
    Raises `RecordingError` where more than 5 % of the rows are of such a norm: these are no quaternions.
    """
    blank, lost = np.asarray(np.isnan(values).all(axis=1)), ~whole(values)
    # Scaled first, so that no square overflows.
    size = np.max(np.abs(np.where(lost[:, None], 0.0, values)), axis=1, initial=0.0)
    safe = np.where(size > 0.0, size, 1.0)
    norm = safe * np.linalg.norm(np.where(lost[:, None], 0.0, values) / safe[:, None], axis=1)
    zero = ~lost & (norm < 1e-9)
    off = np.abs(norm - 1.0)
    wrong = ~lost & ~zero & (off > NORM_WRONG)
    there = ~lost & ~zero
    if wrong.sum() > MOST_BAD_NORMS * max(int(there.sum()), 1) and wrong.sum() > 1:
        first = int(np.flatnonzero(wrong)[0])
        share = f"{wrong.sum()} of {there.sum()} quaternions off by more than {NORM_WRONG:g}"
        got = f"a norm of {norm[first]:.4g}, and {share}"
        hint = "checking which columns hold the quaternion"
        raise place.error(first, "qw", got, "quaternions of norm 1", hint)
    good = there & ~wrong
    rounded = good & (off > NORM_ROUNDED)
    unit = np.zeros_like(values)
    unit[:, 0] = 1.0
    unit[good] = values[good] / norm[good, None]
    # What is a unit quaternion to rounding stays to the last bit, so that what is saved is read again.
    exact = good & (off < 1e-15)
    unit[exact] = values[exact]
    notes: tuple[str, ...] = ()
    if rounded.any():
        first, last = (place.number(row) for row in np.flatnonzero(rounded)[[0, -1]])
        notes = (
            f"{rounded.sum()} quaternions are scaled to norm 1, off by up to {off[rounded].max():.2g}"
            f" ({place.unit}s {first} to {last})",
        )
    reasons = {
        "blank": blank,
        "not finite": lost & ~blank,
        "missing tool (zero quaternion)": zero,
        "norm off by more than 0.1": wrong,
    }
    return unit, reasons, notes
