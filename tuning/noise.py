"""Parameters as one free vector in which every value is admissible.

Standard deviations are optimised by their logarithm and full matrices by a triangular factor with
logarithms on its diagonal, so that Q and R stay positive definite whatever the step. Calibration is
optimised as a change from its start in a natural unit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.errors import TuningError
from jaxekf.model import Model, Parameters
from jaxekf.parameters import as_arrays, leaf_names

# A step of one in the free vector changes a calibration leaf by this much, by its unit.
_NATURAL_STEP = {"s": 0.005, "1": 0.01, "rad": 0.01, "m": 0.01}
AXES = ("tied", "each", "full")


@dataclass(frozen=True)
class Leaf:
    """One free leaf: where it stands, its shape, and how it is parametrised."""

    name: str
    shape: tuple[int, ...]
    kind: str
    """`log`, `factor` or `linear`."""
    step: float = 1.0

    @property
    def size(self) -> int:
        """Free numbers."""
        if self.kind == "factor":
            return self.shape[0] * (self.shape[0] + 1) // 2
        return int(np.prod(self.shape, dtype=int))

    def to_free(self, value: Array) -> Array:
        """Free numbers of a value."""
        if self.kind == "log":
            return jnp.log(value).reshape(-1)
        if self.kind == "factor":
            logs = jnp.log(jnp.diagonal(value))
            rows, columns = np.tril_indices(self.shape[0], -1)
            return jnp.concatenate([logs, value[rows, columns] / value[rows, rows]])
        return (value / self.step).reshape(-1)

    def from_free(self, free: Array) -> Array:
        """Value of free numbers."""
        if self.kind == "log":
            return jnp.exp(free).reshape(self.shape)
        if self.kind == "factor":
            size = self.shape[0]
            diagonal = jnp.exp(free[:size])
            rows, columns = np.tril_indices(size, -1)
            below = free[size:] * diagonal[rows]
            return jnp.diag(diagonal).at[rows, columns].set(below)
        return free.reshape(self.shape) * self.step


@dataclass(frozen=True)
class Layout:
    """Which leaves are free, in the order of the free vector. Hashable, so that it can be static."""

    leaves: tuple[Leaf, ...]

    def to_free(self, params: Parameters) -> Array:
        """The free vector (n,) of parameters."""
        values = _by_name(params)
        return jnp.concatenate(
            [leaf.to_free(jnp.asarray(values[leaf.name])) for leaf in self.leaves]
        )

    def from_free(self, free: Array, base: Parameters) -> Parameters:
        """Parameters with the free leaves of the vector and all others of `base`."""
        changed, start = {}, 0
        for leaf in self.leaves:
            changed[leaf.name] = leaf.from_free(free[start : start + leaf.size])
            start += leaf.size
        values = [changed.get(name, value) for name, value in _by_name(base).items()]
        return jax.tree.unflatten(jax.tree.structure(base), values)

    def labels(self) -> list[str]:
        """A name for each free number."""
        return [
            leaf.name if leaf.size == 1 else f"{leaf.name}[{i}]"
            for leaf in self.leaves
            for i in range(leaf.size)
        ]


def _by_name(params: Parameters) -> dict[str, Any]:
    return dict(zip(leaf_names(params), jax.tree.leaves(params), strict=True))


def layout(model: Model, params: Parameters, free: Sequence[str] | None = None) -> Layout:
    """The layout of the free leaves; by default all of the noise.

    `free` holds leaf names such as ``noise.optical`` or ``calibration.clock_offset``, or the name of a
    whole section. Raises `TuningError` for a name that is none, or a start outside its domain.
    """
    values, units = _by_name(params), _by_name(model.units)
    wanted = ["noise"] if free is None else list(free)
    if not wanted:
        raise TuningError("got nothing that is free, expected some parameters; name noise, for one")
    chosen: list[str] = []
    for name in wanted:
        found = [n for n in units if n == name or n.startswith(f"{name}.")]
        if not found:
            raise TuningError(
                f"got the free parameter '{name}', expected some of {list(units)};"
                " check the spelling"
            )
        chosen += [n for n in found if n not in chosen]
    return Layout(tuple(_leaf(name, np.asarray(values[name]), units[name]) for name in chosen))


def _leaf(name: str, value: Any, unit: str) -> Leaf:
    if name.startswith("calibration."):
        return Leaf(name, value.shape, "linear", _NATURAL_STEP.get(unit, 1.0))
    _check_positive(name, value)
    return Leaf(name, value.shape, "factor" if value.ndim == 2 else "log")


def _check_positive(name: str, value: Any) -> None:
    deviations = np.diagonal(value) if value.ndim == 2 else value
    if not np.all(np.isfinite(deviations) & (deviations > 0.0)):
        raise TuningError(
            f"got {name} = {value.tolist()} to start from, expected positive deviations;"
            " start from a small positive number"
        )


def with_axes(
    model: Model, params: Parameters, axes: str, free: Sequence[str] | None = None
) -> Parameters:
    """The same noise with one deviation for all axes (`tied`), one for `each`, or a `full` factor.

    With `free` (see `layout`) only the leaves that it names are changed.
    """
    if axes not in AXES:
        raise TuningError(f"got axes '{axes}', expected one of {AXES}; choose one")

    def reshape(value: Any, dim: int) -> Any:
        value = np.asarray(value, float)
        _check_positive("noise", value)
        cov = value @ value.T if value.ndim == 2 else np.diag(np.broadcast_to(value, dim) ** 2)
        if axes == "full":
            return np.linalg.cholesky(cov)
        each = np.sqrt(np.diagonal(cov))
        return each if axes == "each" else np.sqrt(np.mean(each**2))

    chosen = {leaf.name for leaf in layout(model, params, free).leaves}
    names = [f"noise.{name}" for name in leaf_names(params.noise)]
    leaves, structure = jax.tree.flatten(params.noise)
    dims = jax.tree.leaves(model.noise_dims)
    changed = [
        reshape(leaf, dim) if free is None or name in chosen else leaf
        for name, leaf, dim in zip(names, leaves, dims, strict=True)
    ]
    return as_arrays(params._replace(noise=jax.tree.unflatten(structure, changed)))


def scaled(params: Parameters, factor: float) -> Parameters:
    """All covariances (Q, R and P0) times `factor`: the estimate stays, its uncertainty scales."""
    root = np.sqrt(factor)
    return params._replace(
        noise=jax.tree.map(lambda a: a * root, params.noise),
        initial=jax.tree.map(lambda a: a * root, params.initial),
    )
