"""The figures of an estimate by name, each with the condition under which it can be drawn."""

from collections.abc import Callable
from typing import NamedTuple

from matplotlib.figure import Figure

from jaxekf.estimation.result import Estimate
from jaxekf.recordings.types import Recording

Draw = Callable[[Estimate, Recording], Figure]
Condition = Callable[[Estimate, Recording], bool]


class Registered(NamedTuple):
    """A figure: the function that draws it, and whether an estimate and its recording have its data."""

    draw: Draw
    applies: Condition


FIGURES: dict[str, Registered] = {}


def figure(applies: Condition) -> Callable[[Draw], Draw]:
    """Register the decorated function as the figure of its own name.

    Parameters
    ----------
    applies
        Whether an estimate and its recording have the data that the figure shows.
    """

    def register(draw: Draw) -> Draw:
        FIGURES[draw.__name__] = Registered(draw, applies)
        return draw

    return register


def has_output(name: str) -> Condition:
    """The condition of a figure that shows this output of the model."""
    return lambda estimate, recording: name in estimate.outputs
