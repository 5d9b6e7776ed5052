"""Tables of several estimates of the same runs."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from jaxekf.estimation.result import Estimate
from jaxekf.recordings.types import Recording


class Row(NamedTuple):
    """Scores of one run with one set of parameters."""

    run: str
    variant: str
    attitude_rmse_deg: float
    rate_rmse_deg_s: float
    nis: float
    """Mean normalised innovation squared of the tracker by degree of freedom; 1 for a consistent filter."""
    nees: float
    """Mean normalised attitude error squared by degree of freedom; 1 for a consistent filter."""
    position_rmse_mm: float = float("nan")
    """NaN if the model has no position or the encoder measures none."""
    position_nees: float = float("nan")
    """As `nees`, for the position."""


class Comparison(NamedTuple):
    """Rows of all runs and variants, and the estimates that they were computed from."""

    rows: list[Row]
    estimates: dict[str, list[Estimate]]
    recordings: list[Recording]


def by_variant(rows: Sequence[Row], column: str) -> dict[str, list[float]]:
    """Numbers of one column by variant; NaN is left out."""
    grouped: dict[str, list[float]] = {}
    for row in rows:
        value = float(getattr(row, column))
        grouped.setdefault(row.variant, []).extend([] if value != value else [value])
    return grouped


def mean_by_variant(rows: Sequence[Row], field: str = "attitude_rmse_deg") -> dict[str, float]:
    """Mean of one column by variant, over the runs that have a number there; NaN if none has."""
    return {
        name: sum(values) / len(values) if values else float("nan")
        for name, values in by_variant(rows, field).items()
    }


def as_dicts(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Rows for JSON; unknown numbers are None."""
    return [
        {key: None if isinstance(v, float) and v != v else v for key, v in row._asdict().items()}
        for row in rows
    ]
