"""`tuning.json`: search, parameters, comparison and folds of a tuning."""

from typing import Any

import numpy as np
from msgspec import Struct, field

from jaxekf.io.documents.codec import Document
from jaxekf.io.documents.result import Quantity
from jaxekf.recordings.types import Floats


class Step(Struct):
    """One iteration of the search; None is not finite."""

    number: int
    training: float | None
    validation: float | None
    rejected: bool


class Start(Struct):
    """The best of one of several searches."""

    value: float | None
    iterations: int
    ending: str


class FreeNumber(Struct, kw_only=True):
    """One number that was tuned."""

    label: str = ""
    name: str
    run: str | None
    """Run of a parameter estimated separately for each run."""
    truth: bool
    """Whether it belongs to the encoder's clock or frames."""
    unit: str
    logarithm: bool
    start: float | None
    tuned: float | None
    """As in the parameter files."""
    searched: float | None = None
    """Value before the common scale of all covariances."""
    interval: tuple[float | None, float | None] | None
    """95 %, in the scale of `tuned`; None for an end that the data do not give."""
    moved: str
    change: float | None = None
    left_open: bool
    """Whether the data do not determine it."""
    would_tell: str | None = None
    """Motion that would determine it."""
    bounds: tuple[float, float] | None = None


class RunScore(Struct):
    """One run under one variant of the parameters; None is not known."""

    run: str
    variant: str
    attitude_rmse_deg: float | None
    rate_rmse_deg_s: float | None
    nis: float | None
    nees: float | None
    position_rmse_mm: float | None
    position_nees: float | None


class ParameterSpread(Struct):
    """A parameter over the folds, in its unit."""

    start: Floats
    mean: Floats
    deviation: Floats
    each: Floats | None = None

    def __post_init__(self) -> None:
        np.broadcast_shapes(self.start.shape, self.mean.shape, self.deviation.shape)


class FoldsDocument(Struct, kw_only=True):
    """Cross-validation; `spread` and `work` are those of `tuning.CrossValidation.as_dict`."""

    rows: list[RunScore]
    spread: dict[str, Any] = field(default_factory=dict)
    held_out: list[list[str]]
    parameters: dict[str, ParameterSpread]
    work: dict[str, Any] = field(default_factory=dict)


class TuningDocument(Document, kw_only=True):
    """`tuning.json`; keys with a default are missing in tunings of earlier versions."""

    kind: str = "jaxekf tuning"
    model: str
    objective: str
    errors: list[str] = field(default_factory=list)
    runs: list[str]
    validation_runs: list[str]
    date: str | None
    provenance: dict[str, Any]
    tuning: str | None = None
    inputs: dict[str, Any] = field(default_factory=dict)
    stopped: str
    evaluations: int
    rejected_steps: int
    covariance_scale: float
    also_scaled: list[str] = field(default_factory=list)
    accepted: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Rows that pass the gates with these parameters, and all visible ones, by sensor."""
    gates_off: bool = False
    """Whether the gates were off during the search."""
    history: list[Step]
    best_iteration: int
    starts: list[Start]
    numbers: list[FreeNumber]
    units: dict[str, str]
    truth: dict[str, Quantity] | None
    judged_on: str | None
    rows: list[RunScore]
    folds: FoldsDocument | None
    warnings: list[str]
