"""Tables of several estimates of the same runs."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from jaxekf.estimation.result import Estimate
from jaxekf.recordings.types import Recording


class Row(NamedTuple):
    """Scores of one run with one set of parameters.

    Examples
    --------
    >>> import tuning
    >>> row = tuning.Row("a", "tuned", attitude_rmse_deg=0.1, rate_rmse_deg_s=1.0, nis=1.0, nees=1.1)
    >>> row.variant, row.position_rmse_mm
    ('tuned', nan)
    """

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
    """Rows of all runs and variants, and the estimates that they were computed from.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> params = jaxekf.get_model("loose").parameters
    >>> found = tuning.compare("loose", [jaxekf.demo.FOLDER / "free-5"], {"start": params})
    >>> [row.variant for row in found.rows], found.estimates["start"][0].run, len(found.recordings)
    (['hold last', 'start'], 'free-5', 1)
    """

    rows: list[Row]
    """Scores, run by run."""
    estimates: dict[str, list[Estimate]]
    """Estimates of the runs, by variant."""
    recordings: list[Recording]
    """The runs, in the order given."""


def by_variant(rows: Sequence[Row], column: str) -> dict[str, list[float]]:
    """Numbers of one column by variant; NaN is left out."""
    grouped: dict[str, list[float]] = {}
    for row in rows:
        value = float(getattr(row, column))
        grouped.setdefault(row.variant, []).extend([] if value != value else [value])
    return grouped


def mean_by_variant(rows: Sequence[Row], field: str = "attitude_rmse_deg") -> dict[str, float]:
    """Mean of one column by variant, over the runs that have a number there; NaN if none has.

    Examples
    --------
    >>> import tuning
    >>> rows = [
    ...     tuning.Row("free-4", "start", 0.3, 1.2, 1.4, 1.5),
    ...     tuning.Row("free-4", "tuned", 0.2, 1.0, 1.0, 1.0),
    ...     tuning.Row("free-5", "start", 0.5, 1.2, 1.6, 1.7),
    ...     tuning.Row("free-5", "tuned", 0.2, 1.0, 1.0, 1.0),
    ... ]
    >>> tuning.mean_by_variant(rows), tuning.mean_by_variant(rows, "nis")
    ({'start': 0.4, 'tuned': 0.2}, {'start': 1.5, 'tuned': 1.0})
    """
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
