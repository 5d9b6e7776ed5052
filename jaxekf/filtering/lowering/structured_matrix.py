"""Matrices on the batch axis with mostly compile-time-constant entries, such as Jacobians.

A `Pattern` holds the constant part of a matrix and the places of its unknown entries, in rectangular
bands; the unknown entries are arrays, `Bands`. `multiply` leaves out products with known entries.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import NDArray

from jaxekf.filtering.lowering import batched_products
from jaxekf.filtering.lowering.lanes import materialise, unrolled_sum
from jaxekf.filtering.lowering.sparsity import KnownEntries

_FILL_LIMIT = 1.3
"""Largest ratio of the entries of a band of several rows to its unknown entries."""

Bands = tuple[Array, ...]
"""The unknown entries of a matrix: an array (rows, cols, lanes) for each band of its pattern."""


@dataclass(frozen=True)
class Pattern:
    """The sparsity of a matrix: constant entries plus rectangular bands of unknown entries."""

    shape: tuple[int, int]
    constants: tuple[tuple[float, ...], ...]
    bands: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
    """Rows and columns of each band, ascending; no two bands share an entry."""

    @property
    def base(self) -> NDArray[np.float64]:
        """The constant part, (rows, cols); 0 in the bands."""
        return np.array(self.constants).reshape(self.shape)

    @property
    def transposed(self) -> "Pattern":
        """The pattern of the transposed matrix; its bands are those of `transpose_bands`."""
        bands = tuple((cols, rows) for rows, cols in self.bands)
        return Pattern((self.shape[1], self.shape[0]), _nested(self.base.T), bands)

    @property
    def is_identity(self) -> bool:
        """Whether the matrix is known to be the identity."""
        square = self.shape[0] == self.shape[1]
        return square and not self.bands and bool(np.all(self.base == np.eye(self.shape[0])))


def _nested(base: NDArray[Any]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in base)


def find_pattern(matrix: KnownEntries) -> Pattern:
    """The pattern of a matrix from its known entries.

    Neighbouring rows with nearly the same unknown columns make one band.
    """
    unknown = ~np.asarray(matrix.known)
    groups: list[list[int]] = []
    for row in np.flatnonzero(unknown.any(axis=1)):
        joined = [*groups[-1], int(row)] if groups else []
        if joined and _band_area(unknown, joined) <= _FILL_LIMIT * unknown[joined].sum():
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


def _band_area(unknown: NDArray[np.bool_], rows: list[int]) -> int:
    return len(rows) * int(unknown[rows].any(axis=0).sum())


def row_mixed_pattern(p: Pattern) -> Pattern:
    """The pattern after a multiplication from the left by any matrix.

    Every column in which `p` has an entry that is not zero is unknown.
    """
    used = (p.base != 0.0).any(axis=0)
    for _, cols in p.bands:
        used[list(cols)] = True
    unknown = np.broadcast_to(used, p.shape)
    return find_pattern(KnownEntries(np.zeros(p.shape), ~unknown))


def take_slices(array: Array, index: Sequence[int], axis: int) -> Array:
    """``jnp.take(array, index, axis)`` for a static, ascending `index`, made of slices."""
    pieces = split_slices(array, index, axis)
    return pieces[0] if len(pieces) == 1 else lax.concatenate(pieces, axis)


def split_slices(array: Array, index: Sequence[int], axis: int) -> list[Array]:
    """The slices of `take_slices`, one for each run of consecutive indices."""
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


def select_rows(p: Pattern, bands: Bands, start: int, stop: int) -> tuple[Pattern, Bands]:
    """Pattern and bands of the rows from `start` to before `stop`."""
    kept, values = [], []
    for (rows, cols), band in zip(p.bands, bands, strict=True):
        inside = [i for i, row in enumerate(rows) if start <= row < stop]
        if inside:
            kept.append((tuple(rows[i] - start for i in inside), cols))
            values.append(take_slices(band, inside, 0))
    part = Pattern((stop - start, p.shape[1]), p.constants[start:stop], tuple(kept))
    return part, tuple(values)


def extract_bands(matrix: Array, p: Pattern) -> Bands:
    """The bands of a dense matrix, or of a cotangent of one."""
    return tuple(take_slices(take_slices(matrix, rows, 0), cols, 1) for rows, cols in p.bands)


def transpose_bands(bands: Bands) -> Bands:
    """The bands of the transposed matrix."""
    return tuple(band.swapaxes(0, 1) for band in bands)


def to_dense(p: Pattern, bands: Bands, lanes: int, dtype: Any) -> Array:
    """The dense matrix, (rows, cols, lanes)."""
    total = jnp.broadcast_to(jnp.asarray(p.base[:, :, None], dtype), (*p.shape, lanes))
    for (rows, cols), band in zip(p.bands, bands, strict=True):
        for above in _runs(rows):
            part = take_slices(band, [rows.index(row) for row in above], 0)
            for left in _runs(cols):
                block = take_slices(part, [cols.index(col) for col in left], 1)
                total = _write_slice(total, block, (above[0], left[0], 0))
    return total


def _write_slice(whole: Array, part: Array, start: tuple[int, ...]) -> Array:
    """`whole` with `part` written at `start`.

    A concatenation fused with its operands would test for every entry which operand it is in, and XLA would
    not vectorise that loop.
    """
    if part.shape == whole.shape:
        return part
    return materialise(lax.dynamic_update_slice(whole, part, start))


def multiply(p: Pattern, bands: Bands, x: Array, axis: int = 0) -> Array:
    """The matrix times `x`, (columns, ..., lanes), contracted over `axis` of `x`.

    With ``axis=1`` it is ``x @ matrix.T``.
    """
    products = [
        materialise(_multiply_band(band, cols, x, axis))
        for band, (_, cols) in zip(bands, p.bands, strict=True)
    ]
    segments = _row_segments(p)
    kept = [segment for segment in segments if _is_identity_row(p, segment[0])]
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
                terms.append(take_slices(product, range(at, at + stop - start), axis))
        if not terms and kept:
            terms.append(jnp.zeros((*shape[:axis], stop - start, *shape[axis + 1 :]), x.dtype))
        if terms:
            at = (*([0] * axis), start, *([0] * (x.ndim - axis - 1)))
            found = _write_slice(found, unrolled_sum(terms), at)
    return found


def _is_identity_row(p: Pattern, start: int) -> bool:
    """Whether row `start` is that of the identity."""
    if p.shape[0] != p.shape[1] or any(start in rows for rows, _ in p.bands):
        return False
    return np.array_equal(p.base[start], np.eye(p.shape[1])[start])


def _multiply_band(band: Array, cols: tuple[int, ...], x: Array, axis: int) -> Array:
    """A band at `cols` times `x` (``x @ band.T`` with ``axis=1``), by runs of consecutive columns."""
    terms, start = [], 0
    for run in _runs(cols):
        part = lax.slice_in_dim(x, run[0], run[-1] + 1, axis=axis)
        block = lax.slice_in_dim(band, start, start + len(run), axis=1)
        start += len(run)
        if x.ndim == 2:
            terms.append(batched_products.multiply_vector(block, part))
        elif axis == 0:
            terms.append(batched_products.multiply(block, part))
        else:
            terms.append(batched_products.multiply_transposed(part, block))
    return unrolled_sum(terms)


def _row_segments(p: Pattern) -> list[tuple[int, int]]:
    """Ranges of rows that are computed as one slice: same bands, constant part shifted row by row."""
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
