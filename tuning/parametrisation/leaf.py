"""One free leaf: the map between its value and its free numbers, logarithms and bounds included."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.recordings.types import Floats

WEAK_LOG = 2.3
"""Standard deviation of a weak prior of a logarithm: a factor of ten."""
# Nearer to a bound, as a share of the half width, a number does not come.
_INSIDE = 1.0 - 1e-9


@dataclass(frozen=True)
class Leaf:
    """One free leaf: its name, its shape, and its parametrisation."""

    name: str
    shape: tuple[int, ...]
    """Shape of one run's value."""
    kind: str
    """`log`, `factor` or `linear`."""
    step: float = 1.0
    runs: int = 0
    """Number of runs that each have their own value; 0 if all share one."""
    prior: float = WEAK_LOG
    """Standard deviation of a free number about its start."""
    bounds: tuple[float, float] | None = None
    """Bounds of the free number before `_bend`."""
    middle: tuple[float, ...] = ()
    """With bounds: initial free numbers of one run, at which `_bend` changes nothing."""

    @property
    def each(self) -> int:
        """Free numbers of one run's value."""
        if self.kind == "factor":
            return self.shape[0] * (self.shape[0] + 1) // 2
        return int(np.prod(self.shape, dtype=int))

    @property
    def size(self) -> int:
        """Free numbers."""
        return self.each * max(self.runs, 1)

    def to_free(self, value: Array) -> Array:
        """Free numbers of a value, with `runs` on its first axis or not."""
        if not self.runs:
            return self._free(value)
        own = jnp.ndim(value) > len(self.shape)
        every = value if own else jnp.broadcast_to(value, (self.runs, *self.shape))
        return jax.vmap(self._free)(every).reshape(-1)

    def from_free(self, free: Array) -> Array:
        """Value of free numbers, with the runs on the first axis if each has its own."""
        if not self.runs:
            return self._value(free)
        return jax.vmap(self._value)(free.reshape(self.runs, self.each))

    def is_logarithm(self, number: int) -> bool:
        """Whether one of its free numbers is a logarithm."""
        diagonal = self.kind == "factor" and number % self.each < self.shape[0]
        return self.kind == "log" or diagonal

    def unbounded(self, free: float, number: int) -> float:
        """One of its free numbers as it is between its bounds."""
        if self.bounds is None:
            return float(free)
        middle = np.asarray(self.middle[number % self.each])
        return float(_bend(jnp.asarray(free), self.bounds, middle))

    def _free(self, value: Array) -> Array:
        return _unbend(self._straight(value), self.bounds, np.asarray(self.middle))

    def _straight(self, value: Array) -> Array:
        if self.kind == "log":
            return jnp.log(value).reshape(-1)
        if self.kind == "factor":
            logs = jnp.log(jnp.diagonal(value))
            rows, columns = np.tril_indices(self.shape[0], -1)
            return jnp.concatenate([logs, value[rows, columns] / value[rows, rows]])
        return (value / self.step).reshape(-1)

    def _value(self, free: Array) -> Array:
        free = _bend(free, self.bounds, np.asarray(self.middle))
        if self.kind == "log":
            return jnp.exp(free).reshape(self.shape)
        if self.kind == "factor":
            size = self.shape[0]
            diagonal = jnp.exp(free[:size])
            rows, columns = np.tril_indices(size, -1)
            below = free[size:] * diagonal[rows]
            return jnp.diag(diagonal).at[rows, columns].set(below)
        return free.reshape(self.shape) * self.step


def _bend(free: Array, bounds: tuple[float, float] | None, start: Floats) -> Array:
    """Map any number to one between the bounds. The start is mapped to itself with a slope of one, so that
    steps, priors and intervals mean the same with bounds as without."""
    if bounds is None:
        return free
    middle, half, at, reach = _curve(bounds, start)
    return middle + half * jnp.tanh(at + (free - start) / reach)


def _unbend(bent: Array, bounds: tuple[float, float] | None, start: Floats) -> Array:
    if bounds is None:
        return bent
    begin = jnp.asarray(start)
    middle, half, at, reach = _curve(bounds, start)
    # Covariances that are scaled to the errors may leave the bounds; then the nearest point is taken.
    inside = jnp.clip((bent - middle) / half, -_INSIDE, _INSIDE)
    return begin + reach * (jnp.arctanh(inside) - at)


def _curve(bounds: tuple[float, float], start: Floats) -> tuple[float, float, Floats, Floats]:
    """Middle and half width of the interval between the bounds, position of the start on the curve, and the
    free distance that is one there."""
    middle, half = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
    share = np.clip((start - middle) / half, -_INSIDE, _INSIDE)
    return middle, half, np.arctanh(share), half * (1.0 - share**2)
