"""Tuning judged on runs that it has not learnt from: each run is held out once, and its fold's tuning
knows nothing of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxekf.errors import TuningError
from jaxekf.estimation import Run, read
from jaxekf.model import Model, Parameters
from jaxekf.models import adapted, get_model
from jaxekf.parameters import leaf_names
from jaxekf.recording import Floats, Recording
from tuning.fit import Tuned, fit_runs, tune
from tuning.validation import Row, as_dicts, compare

COLUMNS = tuple(name for name in Row._fields if name not in ("run", "variant"))
_BEST_AT_ONE = ("nis", "nees", "position_nees")


class Fold(NamedTuple):
    """One tuning, and the runs it has not seen."""

    held_out: tuple[str, ...]
    """Names."""
    tuned: Tuned


class Spread(NamedTuple):
    """A column of a table over the runs that have a number there; NaN where there are too few."""

    mean: float
    deviation: float
    """Standard deviation of a run, by n - 1."""
    worst: float
    """The largest error; of NIS and NEES what is farthest from 1 as a factor."""


class ParameterSpread(NamedTuple):
    """What the folds found for one parameter, in its unit."""

    start: Floats
    """Of the parameter's shape."""
    mean: Floats
    deviation: Floats
    """Standard deviation of a fold, by n - 1. Two folds share most of their runs, so that it is less than
    how far tunings on other runs would lie apart."""
    each: Floats
    """(folds, ...)"""


@dataclass(frozen=True)
class CrossValidation:
    """What came out of `cross_validate`."""

    rows: list[Row]
    """Of each run that was held out, in the order given: `hold last`, `start`, and `tuned` by its fold."""
    folds: tuple[Fold, ...]

    def spread(self, column: str = "attitude_rmse_deg") -> dict[str, Spread]:
        """One of `COLUMNS` over the runs, by variant."""
        grouped: dict[str, list[float]] = {}
        for row in self.rows:
            value = float(getattr(row, column))
            grouped.setdefault(row.variant, []).extend([] if value != value else [value])
        return {name: _spread(values, column) for name, values in grouped.items()}

    @property
    def parameters(self) -> dict[str, ParameterSpread]:
        """The free parameters over the folds, by name; of what each run has of its own the fold's mean."""
        first, found = self.folds[0].tuned, {}
        values = [_by_name(fold.tuned.params) for fold in self.folds]
        start = _by_name(first.start._replace(truth=()))
        for name in (leaf.name for leaf in first.layout.leaves):
            if name in start:
                each = np.stack([value[name] for value in values])
                found[name] = ParameterSpread(
                    start[name], each.mean(axis=0), each.std(axis=0, ddof=1), each
                )
        return found

    def as_dict(self) -> dict[str, Any]:
        """All of it for JSON: rows, spread over the runs, and the parameters of each fold in SI units."""
        by_column = {column: self.spread(column) for column in COLUMNS}
        return {
            "rows": as_dicts(self.rows),
            "spread": {
                variant: {column: spread[variant]._asdict() for column, spread in by_column.items()}
                for variant in dict.fromkeys(row.variant for row in self.rows)
            },
            "held_out": [list(fold.held_out) for fold in self.folds],
            "parameters": {
                name: {key: np.asarray(value).tolist() for key, value in told._asdict().items()}
                for name, told in self.parameters.items()
            },
        }


def cross_validate(
    runs: Sequence[Run],
    folds: int | None = None,
    *,
    model: str | Model = "loose",
    validate: Sequence[Run] = (),
    start: Parameters | None = None,
    burn_in_s: float = 0.0,
    smooth: bool = False,
    **options: Any,
) -> CrossValidation:
    """Tune once for each fold, on all runs but the fold's, and judge it on those.

    There are `folds` of them, each of every `folds`-th run, or with None one for each run (leave one out).
    Runs without an encoder cannot be judged and are learnt from each time. What each run has of its own
    (see `Free.each_run`) is found for a held-out run by `fit_runs`, from its innovations and never from
    its truth. Validation runs judge every fold's iterations and are never held out. With `smooth` the
    smoothed estimates are compared. The other arguments are those of `tune`, but for `checkpoint`, and
    so are the errors raised. Ctrl-C ends the whole.

    Raises `TuningError` also for less than two folds, more than there are runs to be held out, two runs of
    one name, and a checkpoint.
    """
    recordings, judging = read(runs), read(validate)
    chosen = adapted(get_model(model), [*recordings, *judging])
    parts = _parts(recordings, judging, folds)
    if options.get("checkpoint") is not None:
        raise TuningError(
            "got a checkpoint for several tunings, expected none; tune on all runs with it afterwards"
        )
    options |= {"validate": judging, "start": start, "burn_in_s": burn_in_s, "smooth": smooth}
    done: list[Fold] = []
    of_run: dict[str, Parameters] = {}
    for names in parts:
        seen = [run for run in recordings if run.name not in names]
        hidden = [run for run in recordings if run.name in names]
        tuned = tune(seen, model=chosen, **options)
        if "interrupted" in tuned.stopped:
            raise KeyboardInterrupt
        # The fold's own model may lack a marker that only its held-out runs have.
        of_run |= fit_runs(hidden, replace(tuned, model=chosen), burn_in_s=burn_in_s)
        done.append(Fold(tuple(names), tuned))
    judged = [run for run in recordings if run.name in of_run]
    before = chosen.parameters if start is None else start
    variants = {"start": before, "tuned": [of_run[run.name] for run in judged]}
    return CrossValidation(compare(chosen, judged, variants, smooth=smooth).rows, tuple(done))


def _parts(
    recordings: Sequence[Recording], judging: Sequence[Recording], folds: int | None
) -> list[list[str]]:
    """The names of the runs that each fold holds out."""
    names = [run.name for run in [*recordings, *judging]]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise TuningError(
            f"got {twice} more than once among runs and validation runs, expected different names, for a"
            " run that is held out must not be learnt from; leave out or rename one"
        )
    scored = [run.name for run in recordings if run.encoder is not None]
    count = len(scored) if folds is None else folds
    if not 2 <= count <= len(scored):
        raise TuningError(
            f"got {count} folds for {len(scored)} runs with an encoder, expected at least two folds and not"
            " more than runs; name more runs or ask for other folds"
        )
    return [scored[i::count] for i in range(count)]


def _spread(values: Sequence[float], column: str) -> Spread:
    nan = float("nan")
    if not values:
        return Spread(nan, nan, nan)
    array = np.array(values)
    with np.errstate(divide="ignore"):
        badness = np.abs(np.log(array)) if column in _BEST_AT_ONE else array
    deviation = float(array.std(ddof=1)) if len(values) > 1 else nan
    return Spread(float(array.mean()), deviation, float(array[np.argmax(badness)]))


def _by_name(params: Parameters) -> dict[str, Floats]:
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(params)]
    return dict(zip(leaf_names(params), leaves, strict=True))
