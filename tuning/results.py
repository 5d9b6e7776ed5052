"""What a fit leaves behind that runs it has not seen are estimated with."""

from typing import NamedTuple, Protocol

from jaxekf.filtering.model import Model, Parameters
from tuning.parametrisation.free_vector import Layout


class Fitted(Protocol):
    """Anything with parameters for further runs, such as `Tuned` and `Searched`."""

    @property
    def model(self) -> Model:
        """Whose parameters they are."""
        ...

    @property
    def params(self) -> Parameters:
        """Of what each run has of its own the mean."""
        ...

    @property
    def layout(self) -> Layout:
        """What was free, and of what each run has its own."""
        ...


class Fit(NamedTuple):
    """No more than that."""

    model: Model
    params: Parameters
    layout: Layout
