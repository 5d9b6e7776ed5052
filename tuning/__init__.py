"""Noise covariances, and calibration, tuned by gradient against encoder truth or by likelihood."""

from typing import TYPE_CHECKING

from jaxekf.lazy import attributes

if TYPE_CHECKING:
    from tuning.beside import BESIDE
    from tuning.data import Data, prepare
    from tuning.derivative_free import Searched, tune_by_coordinates, tune_by_nelder_mead
    from tuning.descent import Iteration
    from tuning.fit import Tuned, fit_runs, tune
    from tuning.fitted import Fitted
    from tuning.folds import CrossValidation, Fold, Limits, ParameterSpread, Spread, cross_validate
    from tuning.frame import TruthFrame
    from tuning.information import Information
    from tuning.kept import forget_folds
    from tuning.noise import Free, Layout, layout, scaled, with_axes
    from tuning.objectives import (
        Objective,
        attitude_error,
        evaluate,
        innovation_likelihood,
        rate_error,
    )
    from tuning.record import save_record
    from tuning.spec import read_free
    from tuning.starts import Outcome
    from tuning.validation import Comparison, Row, compare, mean_by_variant
    from tuning.work import Work

__all__ = [
    "BESIDE",
    "Comparison",
    "CrossValidation",
    "Data",
    "Fitted",
    "Fold",
    "Free",
    "Information",
    "Iteration",
    "Layout",
    "Limits",
    "Objective",
    "Outcome",
    "ParameterSpread",
    "Row",
    "Searched",
    "Spread",
    "TruthFrame",
    "Tuned",
    "Work",
    "attitude_error",
    "compare",
    "cross_validate",
    "evaluate",
    "fit_runs",
    "forget_folds",
    "innovation_likelihood",
    "layout",
    "mean_by_variant",
    "prepare",
    "rate_error",
    "read_free",
    "save_record",
    "scaled",
    "tune",
    "tune_by_coordinates",
    "tune_by_nelder_mead",
    "with_axes",
]

_PLACES = {
    "tuning.beside": ("BESIDE",),
    "tuning.data": ("Data", "prepare"),
    "tuning.derivative_free": ("Searched", "tune_by_coordinates", "tune_by_nelder_mead"),
    "tuning.descent": ("Iteration",),
    "tuning.fit": ("Tuned", "fit_runs", "tune"),
    "tuning.fitted": ("Fitted",),
    "tuning.folds": (
        "CrossValidation",
        "Fold",
        "Limits",
        "ParameterSpread",
        "Spread",
        "cross_validate",
    ),
    "tuning.frame": ("TruthFrame",),
    "tuning.information": ("Information",),
    "tuning.kept": ("forget_folds",),
    "tuning.noise": ("Free", "Layout", "layout", "scaled", "with_axes"),
    "tuning.objectives": (
        "Objective",
        "attitude_error",
        "evaluate",
        "innovation_likelihood",
        "rate_error",
    ),
    "tuning.record": ("save_record",),
    "tuning.spec": ("read_free",),
    "tuning.starts": ("Outcome",),
    "tuning.validation": ("Comparison", "Row", "compare", "mean_by_variant"),
    "tuning.work": ("Work",),
}

if not TYPE_CHECKING:
    # Hidden from type checkers, which would take any name for one that is there.
    __getattr__, __dir__ = attributes(__name__, _PLACES)
