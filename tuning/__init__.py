"""Noise covariances, and calibration, tuned by gradient against encoder truth or by likelihood.

Examples
--------
>>> import jaxekf, tuning
>>> jaxekf.set_up()
>>> training = jaxekf.demo.paths(("free-1", "free-2"))
>>> tuned = tuning.tune(training, objective="likelihood", free=["noise.optical"], iterations=5)
>>> print(f"{tuned.params.noise.optical:.5f} rad")
0.00530 rad
"""

from typing import TYPE_CHECKING

from jaxekf._support.lazy import attributes

if TYPE_CHECKING:
    from tuning._tune import Tuned, fit_runs, tune
    from tuning.comparison.baselines import BESIDE
    from tuning.comparison.compare import Comparison, Row, compare, mean_by_variant
    from tuning.comparison.cost import Work
    from tuning.comparison.cross_validation import (
        CrossValidation,
        Fold,
        Limits,
        ParameterSpread,
        Spread,
        cross_validate,
    )
    from tuning.objective.data import Data, prepare
    from tuning.objective.fisher_information import Information
    from tuning.objective.objectives import (
        Objective,
        attitude_error,
        evaluate,
        innovation_likelihood,
        rate_error,
    )
    from tuning.parametrisation.free_toml import read_free
    from tuning.parametrisation.free_vector import Free, Layout, layout, scaled, with_axes
    from tuning.parametrisation.truth_frame import TruthFrame
    from tuning.persistence.fold_checkpoint import forget_folds
    from tuning.persistence.tuning_document import save_record
    from tuning.results import Fitted
    from tuning.search.derivative_free import Searched, tune_by_coordinates, tune_by_nelder_mead
    from tuning.search.descent import Iteration
    from tuning.search.multistart import Outcome

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
    "tuning.comparison.baselines": ("BESIDE",),
    "tuning.objective.data": ("Data", "prepare"),
    "tuning.search.derivative_free": ("Searched", "tune_by_coordinates", "tune_by_nelder_mead"),
    "tuning.search.descent": ("Iteration",),
    "tuning._tune": ("Tuned", "fit_runs", "tune"),
    "tuning.results": ("Fitted",),
    "tuning.comparison.cross_validation": (
        "CrossValidation",
        "Fold",
        "Limits",
        "ParameterSpread",
        "Spread",
        "cross_validate",
    ),
    "tuning.parametrisation.truth_frame": ("TruthFrame",),
    "tuning.objective.fisher_information": ("Information",),
    "tuning.persistence.fold_checkpoint": ("forget_folds",),
    "tuning.parametrisation.free_vector": ("Free", "Layout", "layout", "scaled", "with_axes"),
    "tuning.objective.objectives": (
        "Objective",
        "attitude_error",
        "evaluate",
        "innovation_likelihood",
        "rate_error",
    ),
    "tuning.persistence.tuning_document": ("save_record",),
    "tuning.parametrisation.free_toml": ("read_free",),
    "tuning.search.multistart": ("Outcome",),
    "tuning.comparison.compare": ("Comparison", "Row", "compare", "mean_by_variant"),
    "tuning.comparison.cost": ("Work",),
}

if not TYPE_CHECKING:
    # Hidden from type checkers, which would take any name for one that is there.
    __getattr__, __dir__ = attributes(__name__, _PLACES)
