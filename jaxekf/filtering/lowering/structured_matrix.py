"""Matrices on lanes of which most numbers are known when the program is built."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import NDArray

from jaxekf.filtering.lowering.lanes import along, folded_sum, stage, written_sum
from jaxekf.filtering.lowering.sparsity import Known

_FILL = 1.3
"""How many times as many numbers as are unknown a band of several rows may have."""

Bands = tuple[Array, ...]
"""The unknown numbers of a matrix: for each band of its pattern, (rows, cols, lanes)."""


@dataclass(frozen=True)
class Pattern:
    """A matrix that is `base` plus rectangular bands of unknown numbers, where `base` is 0."""

    shape: tuple[int, int]
    constants: tuple[tuple[float, ...], ...]
    bands: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
    """Rows and columns of each band, ascending; no two bands share a number."""

    @property
    def base(self) -> NDArray[np.float64]:
        """The known part, (rows, cols)."""
        return np.array(self.constants).reshape(self.shape)

    @property
    def transposed(self) -> "Pattern":
        """The pattern of the transposed matrix; its bands are those of `transpose`."""
        bands = tuple((cols, rows) for rows, cols in self.bands)
        return Pattern((self.shape[1], self.shape[0]), _nested(self.base.T), bands)

    @property
    def is_identity(self) -> bool:
        """Whether it is the identity, whatever it was computed from."""
        square = self.shape[0] == self.shape[1]
        return square and not self.bands and bool(np.all(self.base == np.eye(self.shape[0])))


def _nested(base: NDArray[Any]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in base)


def pattern(matrix: Known) -> Pattern:
    """The pattern of a matrix from what is known of it: rows with much the same unknown columns are one
    band."""
    unknown = ~np.asarray(matrix.known)
    groups: list[list[int]] = []
    for row in np.flatnonzero(unknown.any(axis=1)):
        joined = [*groups[-1], int(row)] if groups else []
        if joined and _area(unknown, joined) <= _FILL * unknown[joined].sum():
            groups[-1] = joined
        else:
            groups.append([int(row)])
    base = np.where(unknown, 0.0, matrix.value)
    bands = []
    for rows in groups:
        cols = [int(c) for c in np.flatnonzero(unknown[rows].any(axis=0))]
        base[np.ix_(rows, cols)] = 0.0
        bands.append((tuple(rows), tuple(cols)))
    return Pattern((base.shape[0], base.shape[1]), _nested(base), tuple(bands))


def _area(unknown: NDArray[np.bool_], rows: list[int]) -> int:
    return len(rows) * int(unknown[rows].any(axis=0).sum())


def whole(p: Pattern) -> Pattern:
    """The pattern of a matrix that may have numbers in any column in which `p` has one: what is left of it
    when its rows are mixed."""
    used = (p.base != 0.0).any(axis=0)
    for _, cols in p.bands:
        used[list(cols)] = True
    unknown = np.broadcast_to(used, p.shape)
    return pattern(Known(np.zeros(p.shape), ~unknown))


def take(array: Array, index: Sequence[int], axis: int) -> Array:
    """Entries of `array` along `axis`, as slices of consecutive ones."""
    pieces = parts(array, index, axis)
    return pieces[0] if len(pieces) == 1 else lax.concatenate(pieces, axis)


def parts(array: Array, index: Sequence[int], axis: int) -> list[Array]:
    """The same slices one by one."""
    if list(index) == list(range(array.shape[axis])):
        return [array]
    return [lax.slice_in_dim(array, run[0], run[-1] + 1, axis=axis) for run in _runs(list(index))]


def _runs(index: Sequence[int]) -> list[list[int]]:
    runs: list[list[int]] = []
    for i in index:
        if runs and runs[-1][-1] == i - 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    return runs


def rows_of(p: Pattern, bands: Bands, start: int, stop: int) -> tuple[Pattern, Bands]:
    """The rows from `start` to before `stop`."""
    kept, values = [], []
    for (rows, cols), band in zip(p.bands, bands, strict=True):
        inside = [i for i, row in enumerate(rows) if start <= row < stop]
        if inside:
            kept.append((tuple(rows[i] - start for i in inside), cols))
            values.append(take(band, inside, 0))
    part = Pattern((stop - start, p.shape[1]), p.constants[start:stop], tuple(kept))
    return part, tuple(values)


def cut(matrix: Array, p: Pattern) -> Bands:
    """The unknown bands of a whole matrix, or of a cotangent of one."""
    return tuple(take(take(matrix, rows, 0), cols, 1) for rows, cols in p.bands)


def transpose(bands: Bands) -> Bands:
    """The bands of the transposed matrix."""
    return tuple(band.swapaxes(0, 1) for band in bands)


def dense(p: Pattern, bands: Bands, lanes: int, dtype: Any) -> Array:
    """The whole matrix, (rows, cols, lanes)."""
    total = jnp.broadcast_to(jnp.asarray(p.base[:, :, None], dtype), (*p.shape, lanes))
    for (rows, cols), band in zip(p.bands, bands, strict=True):
        for above in _runs(rows):
            part = take(band, [rows.index(row) for row in above], 0)
            for left in _runs(cols):
                block = take(part, [cols.index(col) for col in left], 1)
                total = _put(total, block, (above[0], left[0], 0))
    return total


def _put(whole: Array, part: Array, start: tuple[int, ...]) -> Array:
    """`whole` with `part` from `start` on.

    A concatenation that is computed together with what it is made of asks at every number which piece it
    is in, and keeps the loop from being done on registers of lanes.
    """
    return (
        part if part.shape == whole.shape else stage(lax.dynamic_update_slice(whole, part, start))
    )


def multiply(p: Pattern, bands: Bands, x: Array, axis: int = 0) -> Array:
    """The matrix times `x`, (columns, ..., lanes), contracted over `axis` of `x`.

    With ``axis=1`` it is ``x @ matrix.T``.
    """
    products = [
        stage(_band_times(band, cols, x, axis))
        for band, (_, cols) in zip(bands, p.bands, strict=True)
    ]
    segments = _segments(p)
    kept = [segment for segment in segments if _keeps(p, segment[0])]
    shape = (*x.shape[:axis], p.shape[0], *x.shape[axis + 1 :])
    found = x if kept else jnp.zeros(shape, x.dtype)
    for start, stop in segments:
        if (start, stop) in kept:
            continue
        terms = []
        for col in np.flatnonzero(p.base[start]):
            part = lax.slice_in_dim(x, int(col), int(col) + stop - start, axis=axis)
            value = p.base[start, col]
            terms.append(part if value == 1.0 else value * part)
        for (rows, _), product in zip(p.bands, products, strict=True):
            if start in rows:
                at = rows.index(start)
                terms.append(take(product, range(at, at + stop - start), axis))
        if not terms and kept:
            terms.append(jnp.zeros((*shape[:axis], stop - start, *shape[axis + 1 :]), x.dtype))
        if terms:
            at = (*([0] * axis), start, *([0] * (x.ndim - axis - 1)))
            found = _put(found, written_sum(terms), at)
    return found


def _keeps(p: Pattern, start: int) -> bool:
    """Whether the matrix leaves the numbers from `start` on as they are."""
    if p.shape[0] != p.shape[1] or any(start in rows for rows, _ in p.bands):
        return False
    return np.array_equal(p.base[start], np.eye(p.shape[1])[start])


def _band_times(band: Array, cols: tuple[int, ...], x: Array, axis: int) -> Array:
    """A band at `cols` times `x` (``x @ band.T`` with ``axis=1``), a run of columns at a time."""
    terms, start = [], 0
    for run in _runs(cols):
        part = lax.slice_in_dim(x, run[0], run[-1] + 1, axis=axis)
        block = lax.slice_in_dim(band, start, start + len(run), axis=1)
        start += len(run)
        if x.ndim == 2:
            terms.append(folded_sum(block * along(part, block.shape, 1), 1))
        elif axis == 0:
            shape = (*block.shape[:2], *part.shape[1:])
            terms.append(folded_sum(along(block, shape, 0, 1) * along(part, shape, 1, 2), 1))
        else:
            shape = (part.shape[0], *block.shape)
            terms.append(folded_sum(along(part, shape, 0, 2) * along(block, shape, 1, 2), 2))
    return written_sum(terms)


def _segments(p: Pattern) -> list[tuple[int, int]]:
    """Rows that are computed alike: in the same bands, the known part moving with the row."""
    base = p.base

    def bands_of(row: int) -> list[int]:
        return [i for i, (rows, _) in enumerate(p.bands) if row in rows]

    def follows(row: int) -> bool:
        if bands_of(row) != bands_of(row - 1):
            return False
        before, here = np.flatnonzero(base[row - 1]), np.flatnonzero(base[row])
        return len(before) == len(here) and bool(
            np.all(before + 1 == here) and np.all(base[row - 1, before] == base[row, here])
        )

    starts = [row for row in range(p.shape[0]) if row == 0 or not follows(row)]
    return list(zip(starts, [*starts[1:], p.shape[0]], strict=True))
