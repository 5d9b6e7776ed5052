"""Parameters as one free vector in which every value is admissible.

Standard deviations are optimised by their logarithm and full matrices by a triangular factor with
logarithms on its diagonal, so that Q and R stay positive definite whatever the step. Calibration is
optimised as a change from its start in a natural unit.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.errors import TuningError
from jaxekf.estimation.parameters import as_arrays, for_model, leaf_names, leaves_by_name
from jaxekf.filtering import arguments
from jaxekf.filtering.model import Model, Parameters
from tuning.parametrisation.leaf import WEAK_LOG, Leaf
from tuning.parametrisation.truth_frame import TRUTH_UNITS, no_correction

# A step of one in the free vector changes a leaf of calibration or truth by this much, by its unit.
_NATURAL_STEP = {"s": 0.005, "1": 0.01, "rad": 0.01, "m": 0.01, "s/s": 1e-5}
# Standard deviations of weak priors by unit.
_WEAK = {"s": 0.05, "1": 0.05, "rad": 0.1, "m": 0.05, "s/s": 2e-4}
AXES = ("tied", "each", "full")


@dataclass(frozen=True)
class Free:
    """A free parameter, with its prior and bounds.

    Examples
    --------
    >>> import tuning
    >>> tuning.Free("calibration.clock_offset", each_run=True, prior=0.01, bounds=(-0.1, 0.1)).name
    'calibration.clock_offset'
    """

    name: str
    """A leaf such as ``noise.optical`` or ``calibration.clock_offset``, or a section such as ``noise``."""
    each_run: bool = False
    """Whether it is estimated separately for each run."""
    prior: float | None = None
    """Standard deviation about the start: of the logarithm for noise and initial belief, else in the
    parameter's unit. None is a weak prior: a factor of ten, 50 ms, 0.1 rad, 5 %, 5 cm, 200 ppm."""
    bounds: tuple[float, float] | None = None
    """Bounds in its unit; not for full matrices of noise."""


@dataclass(frozen=True)
class Layout:
    """Which leaves are free, in the order of the free vector. Hashable, so that it can be static.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> model = jaxekf.get_model("loose")
    >>> free = tuning.layout(model, model.parameters, ["noise.optical", "calibration.clock_offset"])
    >>> free.labels(), free.is_logarithm.tolist()
    (['noise.optical', 'calibration.clock_offset'], [True, False])
    """

    leaves: tuple[Leaf, ...]

    def to_free(self, params: Parameters) -> Array:
        """The free vector (n,) of parameters."""
        values = leaves_by_name(params)
        return jnp.concatenate(
            [leaf.to_free(jnp.asarray(values[leaf.name])) for leaf in self.leaves]
        )

    @property
    def own(self) -> frozenset[str]:
        """Names of the leaves that each run has for itself."""
        return frozenset(leaf.name for leaf in self.leaves if leaf.runs)

    @property
    def is_own(self) -> Any:
        """(n,) numbers that belong to one run only."""
        return np.array([leaf.runs > 0 for leaf, _ in self.numbers()], bool)

    @property
    def is_truth(self) -> Any:
        """(n,) numbers that belong to the encoder."""
        return np.array([leaf.name.startswith("truth.") for leaf, _ in self.numbers()], bool)

    @property
    def is_logarithm(self) -> Any:
        """(n,) numbers that are logarithms."""
        return np.array([leaf.is_logarithm(i) for leaf, i in self.numbers()])

    @property
    def own_of_one_run(self) -> Any:
        """Indices of a run's own numbers among all that it is filtered with."""
        own = np.concatenate([np.full(leaf.each, leaf.runs > 0) for leaf in self.leaves])
        return np.flatnonzero(own)

    @property
    def prior(self) -> Any:
        """(n,) standard deviation of each free number about its start."""
        return np.concatenate([np.full(leaf.size, leaf.prior) for leaf in self.leaves])

    def only(self, names: Collection[str]) -> "Layout":
        """The layout with some of its leaves."""
        return Layout(tuple(leaf for leaf in self.leaves if leaf.name in names))

    def of_one_run(self) -> "Layout":
        """The layout of the numbers that one run is filtered with, its own and the shared ones."""
        return Layout(tuple(replace(leaf, runs=0) for leaf in self.leaves))

    def for_runs_number(self, runs: int) -> "Layout":
        """The layout for another number of runs."""
        return Layout(tuple(replace(leaf, runs=runs if leaf.runs else 0) for leaf in self.leaves))

    def index(self, place: Any) -> Any:
        """(runs, m) indices of each run's numbers in the free vector, ordered as in `of_one_run`."""
        rows = []
        for run in np.asarray(place):
            row, start = [], 0
            for leaf in self.leaves:
                first = start + (int(run) * leaf.each if leaf.runs else 0)
                row += range(first, first + leaf.each)
                start += leaf.size
            rows.append(row)
        return np.array(rows, int).reshape(len(rows), -1)

    def of_runs(self, params: Parameters, setup: Any, place: Any) -> Parameters:
        """Parameters of some runs, each leaf with those on its first axis.

        `place` (runs,) is the index of each run among those with parameters of their own; `setup` has the
        runs on the first axis already.
        """
        shared = params._replace(setup=())
        leaves = [
            leaf[place]
            if name in self.own
            else jnp.broadcast_to(leaf, (len(place), *jnp.shape(leaf)))
            for name, leaf in leaves_by_name(shared).items()
        ]
        every = jax.tree.unflatten(jax.tree.structure(shared), leaves)
        return every._replace(setup=setup)

    def one_run(self, params: Parameters, place: int) -> Parameters:
        """The parameters of one run."""
        leaves = [
            leaf[place] if name in self.own else leaf
            for name, leaf in leaves_by_name(params).items()
        ]
        return jax.tree.unflatten(jax.tree.structure(params), leaves)

    def together(self, params: Parameters) -> Parameters:
        """One set for another run: the mean of the runs' own parameters, of logarithms for deviations."""
        kinds = {leaf.name: leaf for leaf in self.leaves if leaf.runs}
        leaves = []
        for name, value in leaves_by_name(params).items():
            if name in kinds:
                leaf = kinds[name]
                middle = leaf.to_free(value).reshape(leaf.runs, leaf.each).mean(axis=0)
                value = replace(leaf, runs=0).from_free(middle)
            leaves.append(value)
        return jax.tree.unflatten(jax.tree.structure(params), leaves)

    def from_free(self, free: Array, base: Parameters) -> Parameters:
        """Parameters with the free leaves of the vector and all others of `base`; leaves that each run has
        for itself have the runs on their first axis."""
        changed, start = {}, 0
        for leaf in self.leaves:
            changed[leaf.name] = leaf.from_free(free[start : start + leaf.size])
            start += leaf.size
        values = [changed.get(name, value) for name, value in leaves_by_name(base).items()]
        return jax.tree.unflatten(jax.tree.structure(base), values)

    def labels(self) -> list[str]:
        """A name for each free number."""
        names = []
        for leaf, i in self.numbers():
            run, entry = divmod(i, leaf.each)
            name = leaf.name if leaf.each == 1 else f"{leaf.name}[{entry}]"
            names.append(f"{name} of run {run}" if leaf.runs else name)
        return names

    def numbers(self) -> list[tuple[Leaf, int]]:
        """Leaf of each free number, and the number's index in it."""
        return [(leaf, i) for leaf in self.leaves for i in range(leaf.size)]


def layout(
    model: Model,
    params: Parameters,
    free: Sequence[str | Free] | None = None,
    runs: int = 0,
) -> Layout:
    """The layout of the free leaves; by default all of the noise.

    `free` holds leaf names such as ``noise.optical`` or ``calibration.clock_offset``, the name of a
    whole section, or `Free`; the last entry of a name counts. `runs` is the number of runs that may have
    parameters of their own. Raises `TuningError` for an unknown name, a start outside its domain or
    bounds, and an invalid prior or bounds.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> model = jaxekf.get_model("loose")
    >>> offset = tuning.Free("calibration.clock_offset", each_run=True)
    >>> tuning.layout(model, model.parameters, [offset], runs=2).labels()
    ['calibration.clock_offset of run 0', 'calibration.clock_offset of run 1']
    """
    params = arguments.parameters(model, params, check_shapes=False)
    values = leaves_by_name(params)
    units = leaves_by_name(model.units._replace(truth=TRUTH_UNITS if params.truth else ()))
    wanted = ["noise"] if free is None else list(free)
    if not wanted:
        raise TuningError(
            "got nothing that is free, expected some parameters; name noise, for example"
        )
    chosen: dict[str, Free] = {}
    for given in wanted:
        entry = given if isinstance(given, Free) else Free(given)
        found = [n for n in units if n == entry.name or n.startswith(f"{entry.name}.")]
        if not found:
            raise TuningError(
                f"got the free parameter '{entry.name}', expected some of {list(units)};"
                " check the spelling"
            )
        chosen |= dict.fromkeys(found, entry)
    return Layout(
        tuple(
            _leaf(name, np.asarray(values[name]), units[name], entry, runs)
            for name, entry in chosen.items()
        )
    )


def _leaf(name: str, value: Any, unit: str, entry: Free, runs: int) -> Leaf:
    linear = name.startswith(("calibration.", "truth."))
    step = _NATURAL_STEP.get(unit, 1.0) if linear else 1.0
    if not linear:
        _check_positive(name, value)
    kind = "linear" if linear else "factor" if value.ndim == 2 else "log"
    prior = entry.prior
    if prior is None:
        prior = _WEAK.get(unit, step) if linear else WEAK_LOG
    if not 0.0 < prior < np.inf:
        raise TuningError(
            f"got a prior of {prior} for {name}, expected a positive standard deviation; leave it out"
            " for a weak one"
        )
    leaf = Leaf(name, value.shape, kind, step, runs if entry.each_run else 0, prior / step)
    bounds = _bounds(name, value, kind, step, entry.bounds)
    if bounds is None:
        return leaf
    numbers = replace(leaf, runs=0).to_free(jnp.asarray(value))
    return replace(leaf, bounds=bounds, middle=tuple(np.asarray(numbers).tolist()))


def _bounds(name: str, value: Any, kind: str, step: float, given: Any) -> Any:
    """Bounds of the free numbers."""
    if given is None:
        return None
    low, high = (float(bound) for bound in given)
    if not (np.all(low < value) and np.all(value < high)) or kind == "factor":
        got = "a full matrix" if kind == "factor" else f"a start of {value.tolist()}"
        raise TuningError(
            f"got bounds {low} and {high} for {name} with {got}, expected numbers that hold the start"
            " between them; widen them, or leave them out"
        )
    if not np.isfinite(high - low) or (kind == "log" and low <= 0.0):
        raise TuningError(
            f"got bounds {low} and {high} for {name}, expected finite numbers, of deviations positive ones;"
            " give a small or a large number instead"
        )
    if kind == "log":
        return float(np.log(low)), float(np.log(high))
    return low / step, high / step


def _check_positive(name: str, value: Any) -> None:
    deviations = np.diagonal(value) if value.ndim == 2 else value
    if not np.all(np.isfinite(deviations) & (deviations > 0.0)):
        raise TuningError(
            f"got {name} = {value.tolist()} to start from, expected positive deviations;"
            " start from a small positive number"
        )


def with_axes(
    model: Model, params: Parameters, axes: str, free: Sequence[str | Free] | None = None
) -> Parameters:
    """Noise with one deviation for all axes (`tied`), one for `each`, or a `full` factor.

    With `free` (see `layout`) only the leaves that it names are changed.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> model = jaxekf.get_model("loose")
    >>> params = tuning.with_axes(model, model.parameters, "full", ["noise.optical"])
    >>> params.noise.optical.shape, params.noise.gyroscope.shape
    ((3, 3), ())
    """
    if axes not in AXES:
        raise TuningError(f"got axes '{axes}', expected one of {AXES}; choose one")
    params = arguments.parameters(model, params, check_shapes=False)

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


def initial_parameters(
    model: Model,
    start: Parameters | None,
    free: Sequence[str | Free] | None,
    axes: str | None,
) -> Parameters:
    """Parameters to start a search from, in the shapes that it keeps."""
    base = for_model(model, model.parameters if start is None else start)
    if any((f.name if isinstance(f, Free) else f).startswith("truth") for f in free or ()):
        base = base._replace(truth=no_correction())
    return base if axes is None else with_axes(model, base, axes, free)


SCALED = ("noise.", "initial.")
"""The sections that `scaled` scales."""


def scaled(params: Parameters, factor: float) -> Parameters:
    """All covariances (Q, R and P0) times `factor`: the estimate stays, its uncertainty scales.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> params = jaxekf.get_model("loose").parameters
    >>> float(tuning.scaled(params, 4.0).noise.optical / params.noise.optical)  # of a deviation
    2.0
    """
    root = np.sqrt(factor)
    return params._replace(
        noise=jax.tree.map(lambda a: a * root, arguments.float_leaves("noise", params.noise)),
        initial=jax.tree.map(lambda a: a * root, arguments.float_leaves("initial", params.initial)),
    )
