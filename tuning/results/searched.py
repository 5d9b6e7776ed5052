"""Result of a search without gradients."""

from dataclasses import dataclass
from typing import NamedTuple

from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Floats
from tuning.parametrisation.free_vector import Layout


class Lowered(NamedTuple):
    """Point of a search at which a lower value was first found."""

    evaluations: int
    """Number of evaluations up to this one, included."""
    value: float


class Found(NamedTuple):
    """Minimum that a search found."""

    best: Floats
    """(n,)"""
    value: float
    history: tuple[Lowered, ...]
    """From the start on, each lower than the one before."""
    evaluations: int
    """Total number."""


@dataclass(frozen=True)
class Searched:
    """Result of a tuning without gradients.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"]}
    >>> found = tuning.tune_by_nelder_mead(runs, **problem, evaluations=8)
    >>> found.history[0].evaluations, found.history[-1].value == found.value
    (1, True)
    >>> found.evaluations, found.filterings
    (8, 8)
    """

    model: Model
    params: Parameters
    """Best parameters, scaled; the mean over the runs where each run has its own."""
    value: float
    """Objective of `params`."""
    history: tuple[Lowered, ...]
    evaluations: int
    """Evaluations of the objective, all without a gradient."""
    start: Parameters
    layout: Layout
    free: Floats
    """(n,) best free vector, before the scale."""
    scale: float = 1.0
    """Factor on all covariances after the search, so that the errors match them."""
    filterings: int = 0
    """Filterings of all runs: the evaluations, and one more for the scale."""
