"""Matrices on lanes of which most numbers are known when the program is built."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import NDArray

from jaxekf.lanes import written_sum
from jaxekf.structure import Known


@dataclass(frozen=True)
class Pattern:
    """A matrix that is `base` plus a block of unknown numbers at `rows` and `cols`, where `base` is 0."""

    shape: tuple[int, int]
    constants: tuple[tuple[float, ...], ...]
    rows: tuple[int, ...]
    cols: tuple[int, ...]

    @property
    def base(self) -> NDArray[np.float64]:
        """The known part, (rows, cols)."""
        return np.array(self.constants).reshape(self.shape)

    @property
    def transposed(self) -> "Pattern":
        """The pattern of the transposed matrix."""
        return _pattern(self.base.T, self.cols, self.rows)

    @property
    def is_constant(self) -> bool:
        """Whether nothing is unknown."""
        return not self.rows

    @property
    def is_identity(self) -> bool:
        """Whether it is the identity, whatever it was computed from."""
        square = self.shape[0] == self.shape[1]
        return self.is_constant and square and bool(np.all(self.base == np.eye(self.shape[0])))


def pattern(matrix: Known) -> Pattern:
    """The pattern of a matrix from what is known of it."""
    unknown = ~np.asarray(matrix.known)
    rows = np.flatnonzero(unknown.any(axis=1))
    cols = np.flatnonzero(unknown.any(axis=0))
    base = np.where(unknown, 0.0, matrix.value)
    base[np.ix_(rows, cols)] = 0.0
    return _pattern(base, tuple(map(int, rows)), tuple(map(int, cols)))


def _pattern(base: NDArray[Any], rows: tuple[int, ...], cols: tuple[int, ...]) -> Pattern:
    constants = tuple(tuple(float(v) for v in row) for row in base)
    return Pattern((base.shape[0], base.shape[1]), constants, rows, cols)


def stack(patterns: Sequence[Pattern]) -> Pattern:
    """The pattern of matrices with the same columns, one below the other."""
    base = np.concatenate([p.base for p in patterns])
    unknown = np.zeros(base.shape, bool)
    start = 0
    for p in patterns:
        unknown[np.ix_([start + r for r in p.rows], p.cols)] = True
        start += p.shape[0]
    return pattern(Known(base, ~unknown))


def take(array: Array, index: Sequence[int], axis: int) -> Array:
    """Rows of `array` along `axis`, as slices of consecutive ones."""
    pieces = [lax.slice_in_dim(array, run[0], run[-1] + 1, axis=axis) for run in _runs(list(index))]
    return pieces[0] if len(pieces) == 1 else lax.concatenate(pieces, axis)


def _runs(index: Sequence[int]) -> list[list[int]]:
    runs: list[list[int]] = []
    for i in index:
        if runs and runs[-1][-1] == i - 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    return runs


def transpose(block: Array | None) -> Array | None:
    """The unknown block of the transposed matrix."""
    return None if block is None else block.swapaxes(0, 1)


def dense(p: Pattern, block: Array | None, lanes: int, dtype: Any) -> Array:
    """The whole matrix, (rows, cols, lanes)."""
    base = np.broadcast_to(p.base[:, :, None], (*p.shape, lanes))
    if block is None or not p.rows:
        return jnp.asarray(base, dtype)
    wide = _placed(block, p.cols, p.shape[1], 1)
    return _placed(wide, p.rows, p.shape[0], 0) + jnp.asarray(base, dtype)


def _placed(array: Array, index: Sequence[int], size: int, axis: int) -> Array:
    """`array` spread along `axis` to the places of `index` among zeros, `size` in all."""
    pieces, filled, taken = [], 0, 0

    def zeros(count: int) -> Array:
        shape = list(array.shape)
        shape[axis] = count
        return jnp.zeros(shape, array.dtype)

    for run in _runs(list(index)):
        if run[0] > filled:
            pieces.append(zeros(run[0] - filled))
        pieces.append(lax.slice_in_dim(array, taken, taken + len(run), axis=axis))
        filled, taken = run[-1] + 1, taken + len(run)
    if size > filled:
        pieces.append(zeros(size - filled))
    return lax.concatenate(pieces, axis)


def multiply(p: Pattern, block: Array | None, x: Array, axis: int = 0) -> Array:
    """The matrix times `x`, (columns, ..., lanes), contracted over `axis` of `x`.

    With ``axis=1`` it is ``x @ matrix.T``.
    """
    unknown = None
    if block is not None and p.rows:
        unknown = written_sum(
            [_along(block[:, t], x, axis) * _one(x, col, axis) for t, col in enumerate(p.cols)]
        )
    pieces = []
    for start, stop in _segments(p):
        terms = []
        for col in np.flatnonzero(p.base[start]):
            part = lax.slice_in_dim(x, int(col), int(col) + stop - start, axis=axis)
            value = p.base[start, col]
            terms.append(part if value == 1.0 else value * part)
        if start in p.rows and unknown is not None:
            at = p.rows.index(start)
            terms.append(lax.slice_in_dim(unknown, at, at + stop - start, axis=axis))
        if not terms:
            shape = list(x.shape)
            shape[axis] = stop - start
            terms.append(jnp.zeros(shape, x.dtype))
        pieces.append(written_sum(terms))
    return pieces[0] if len(pieces) == 1 else lax.concatenate(pieces, axis)


def row(p: Pattern, block: Array | None, index: int, x: Array, axis: int = 0) -> Array | None:
    """One row of ``matrix @ x`` without the axis contracted; None where the row is known to be zero."""
    terms = []
    for col in np.flatnonzero(p.base[index]):
        part = lax.index_in_dim(x, int(col), axis, keepdims=False)
        value = p.base[index, col]
        terms.append(part if value == 1.0 else value * part)
    if block is not None and index in p.rows:
        at = p.rows.index(index)
        for t, col in enumerate(p.cols):
            part = lax.index_in_dim(x, col, axis, keepdims=False)
            factor = block[at, t]
            terms.append(factor.reshape((1,) * (part.ndim - 1) + factor.shape) * part)
    return written_sum(terms) if terms else None


def _one(x: Array, index: int, axis: int) -> Array:
    return lax.slice_in_dim(x, index, index + 1, axis=axis)


def _along(column: Array, x: Array, axis: int) -> Array:
    """A vector (rows, lanes) as an array of the rank of `x`, its rows on `axis`."""
    shape = [1] * x.ndim
    shape[axis], shape[-1] = column.shape
    return column.reshape(shape)


def _segments(p: Pattern) -> list[tuple[int, int]]:
    """Rows that are computed alike: all with unknowns or none, the known part moving with the row."""
    base = p.base
    dense_rows = set(p.rows)

    def follows(row: int) -> bool:
        if (row in dense_rows) != (row - 1 in dense_rows):
            return False
        before, here = np.flatnonzero(base[row - 1]), np.flatnonzero(base[row])
        return len(before) == len(here) and bool(
            np.all(before + 1 == here) and np.all(base[row - 1, before] == base[row, here])
        )

    starts = [row for row in range(p.shape[0]) if row == 0 or not follows(row)]
    return list(zip(starts, [*starts[1:], p.shape[0]], strict=True))
