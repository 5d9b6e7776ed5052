"""Parameters that were found on some runs and that other runs are estimated with."""

from typing import NamedTuple, Protocol

from jaxekf.filtering.model import Model, Parameters
from tuning.parametrisation.free_vector import Layout


class Fitted(Protocol):
    """Anything with parameters for further runs, such as `Tuned` and `Searched`."""

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
