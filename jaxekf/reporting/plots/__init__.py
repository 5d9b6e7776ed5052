"""Figures of an estimate, with the measurements and the truth of its recording.

A figure is a function of an estimate and its recording, in a private module of this package. Its
decorator `_registry.figure` states which data it needs and registers it under its own name. Modules
whose names begin with ``_`` are found without being listed: `_attitudes` (attitude, occlusion),
`_vectors` (position, velocity, rate), `_biases`, `_paths`, `_single_markers`. A new figure is one file,
or one function, and its test.
"""

from importlib import import_module
from pkgutil import iter_modules

from jaxekf.estimation.result import Estimate
from jaxekf.recordings.types import Recording
from jaxekf.reporting.plots._attitudes import euler_sigma_deg
from jaxekf.reporting.plots._measurements import longest_gap
from jaxekf.reporting.plots._registry import FIGURES, Draw
from jaxekf.reporting.plots.style import ESTIMATE, MEASURED, STYLE, TRUTH, band, save

__all__ = [
    "ESTIMATE",
    "MEASURED",
    "STYLE",
    "TRUTH",
    "available_figures",
    "band",
    "euler_sigma_deg",
    "figure_functions",
    "longest_gap",
    "save",
]

_FEWEST_INSTANTS = 10

for _module in iter_modules(__path__):
    if _module.name.startswith("_"):
        import_module(f"{__name__}.{_module.name}")


def figure_functions() -> dict[str, Draw]:
    """The functions that draw the figures, by name, in alphabetical order."""
    return {name: FIGURES[name].draw for name in sorted(FIGURES)}


def available_figures(estimate: Estimate, recording: Recording) -> tuple[str, ...]:
    """Names of the figures that an estimate and its recording have the data for.

    Parameters
    ----------
    estimate
        The estimate of one run. With fewer than ten instants it has no figure.
    recording
        The recording that was estimated.

    Returns
    -------
    tuple of str
        Names in `figure_functions`, in alphabetical order.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.reporting import plots
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> names = plots.available_figures(jaxekf.estimate(run), run)
    >>> "attitude" in names, "position" in names  # the model has no position
    (True, False)
    """
    if len(estimate.time_ns) < _FEWEST_INSTANTS:
        return ()
    return tuple(name for name in sorted(FIGURES) if FIGURES[name].applies(estimate, recording))
