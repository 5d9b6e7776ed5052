"""Parameters that were found on some runs and that other runs are estimated with."""

from typing import NamedTuple, Protocol

from jaxekf.filtering.model import Model, Parameters
from tuning.parametrisation.free_vector import Layout


class Fitted(Protocol):
    """Anything with parameters for further runs, such as `Tuned` and `Searched`.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"]}
    >>> fitted = [tuning.tune(runs, **problem, iterations=5)]
    >>> fitted.append(tuning.tune_by_coordinates(runs, **problem, sweeps=2))
    >>> [sorted(tuning.fit_runs([jaxekf.demo.FOLDER / "free-5"], one)) for one in fitted]
    [['free-5'], ['free-5']]
    """

    @property
    def model(self) -> Model:
        """Model that the parameters belong to."""
        ...

    @property
    def params(self) -> Parameters:
        """Parameters; the mean over the runs where each run has its own."""
        ...

    @property
    def layout(self) -> Layout:
        """Free parameters, and which of them each run has for itself."""
        ...


class FittedParameters(NamedTuple):
    """The smallest `Fitted`."""

    model: Model
    params: Parameters
    layout: Layout
