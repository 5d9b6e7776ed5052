"""Noise covariances, and calibration, tuned by gradient against encoder truth or by likelihood."""

from tuning.data import Data, prepare
from tuning.fit import Iteration, Tuned, tune
from tuning.noise import Layout, layout, scaled, with_axes
from tuning.objectives import (
    Objective,
    attitude_error,
    evaluate,
    innovation_likelihood,
    rate_error,
)
from tuning.validation import Comparison, Row, compare, mean_by_variant

__all__ = [
    "Comparison",
    "Data",
    "Iteration",
    "Layout",
    "Objective",
    "Row",
    "Tuned",
    "attitude_error",
    "compare",
    "evaluate",
    "innovation_likelihood",
    "layout",
    "mean_by_variant",
    "prepare",
    "rate_error",
    "scaled",
    "tune",
    "with_axes",
]
