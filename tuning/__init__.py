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

from jaxekf._support.lazy import attributes, type_checked

if TYPE_CHECKING:
    from tuning.comparison.baselines import BASELINES
    from tuning.comparison.compare import compare
    from tuning.comparison.cross_validation import Limits, cross_validate
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
    from tuning.persistence.tuning_folder import save
    from tuning.results.comparison import Comparison, Row, mean_by_variant
    from tuning.results.fitted import Fitted
    from tuning.results.held_out import CrossValidation, Fold, ParameterSpread, Spread, Work
    from tuning.results.searched import Searched
    from tuning.results.tuned import Iteration, Outcome, Tuned
    from tuning.search.derivative_free import tune_by_coordinates, tune_by_nelder_mead
    from tuning.search.optimisers import LBFGS, Adam, FisherScoring
    from tuning.tuner import fit_runs, tune

__all__ = [
    "BASELINES",
    "LBFGS",
    "Adam",
    "Comparison",
    "CrossValidation",
    "Data",
    "FisherScoring",
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
    "save",
    "save_record",
    "scaled",
    "tune",
    "tune_by_coordinates",
    "tune_by_nelder_mead",
    "with_axes",
]

if not TYPE_CHECKING:
    # Hidden from type checkers, which would accept any name.
    __getattr__, __dir__ = attributes(__name__, type_checked(__file__), {"BESIDE": "BASELINES"})
