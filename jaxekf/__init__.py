"""Attitude, rate, bias and pose from recorded runs of an optical tracker and an IMU.

Begin with ``jaxekf.set_up()``: it sets JAX to float64 and its compiler to what suits the filter.
"""

from typing import TYPE_CHECKING

from jaxekf._support.deprecations import keep_old_names
from jaxekf._support.lazy import attributes, type_checked

if TYPE_CHECKING:
    from jaxekf._support.compilation import jit, set_up
    from jaxekf._support.errors import (
        ArgumentError,
        CacheError,
        FilterError,
        JaxekfError,
        MissingPackageError,
        ModelError,
        PrecisionError,
        RecordingError,
        ResourceError,
        SlowModelWarning,
        TuningError,
    )
    from jaxekf._support.program_cache import keep_programs
    from jaxekf.estimation import timeline
    from jaxekf.estimation.batch import estimate, estimate_many
    from jaxekf.estimation.causal import estimate_online
    from jaxekf.estimation.clock import Clock
    from jaxekf.estimation.live import Known, Stream
    from jaxekf.estimation.output_times import Every, every
    from jaxekf.estimation.parameters import load as load_parameters
    from jaxekf.estimation.parameters import save as save_parameters
    from jaxekf.estimation.result import Estimate, OutputEstimate, SensorRecord
    from jaxekf.evaluation.consistency import Consistency, Whiteness
    from jaxekf.evaluation.diagnosis import Diagnosis, SensorDiagnosis, diagnose, diagnose_many
    from jaxekf.evaluation.metrics import Score, score
    from jaxekf.evaluation.verdicts import Fault, Verdict
    from jaxekf.filtering.ekf import FilterOutput, initial_belief, run_filter, run_filter_batch
    from jaxekf.filtering.interpolation import InputSample
    from jaxekf.filtering.iterated_smoother import (
        IteratedOutput,
        run_iterated_smoother,
        run_iterated_smoother_batch,
    )
    from jaxekf.filtering.model import Belief, Input, Model, Output, Parameters, Sensor, Start
    from jaxekf.filtering.smoother import SmootherOutput, run_smoother, run_smoother_batch
    from jaxekf.filtering.steps import Knots, Rows, Steps
    from jaxekf.geometry.manifold import SO3, AdditiveQuaternion, Euclidean, Manifold
    from jaxekf.io.export import read_export
    from jaxekf.io.run_folder import load, save
    from jaxekf.models import get_model
    from jaxekf.models.robust import robust
    from jaxekf.recordings.gaps import crop, split_at_gaps
    from jaxekf.recordings.types import Camera, Encoder, Imu, Markers, Optical, Recording, Samples
    from jaxekf.simulation import demo

__version__ = "0.1.0"

__all__ = [
    "SO3",
    "AdditiveQuaternion",
    "ArgumentError",
    "Belief",
    "CacheError",
    "Camera",
    "Clock",
    "Consistency",
    "Diagnosis",
    "Encoder",
    "Estimate",
    "Euclidean",
    "Every",
    "Fault",
    "FilterError",
    "FilterOutput",
    "Imu",
    "Input",
    "InputSample",
    "IteratedOutput",
    "JaxekfError",
    "Knots",
    "Known",
    "Manifold",
    "Markers",
    "MissingPackageError",
    "Model",
    "ModelError",
    "Optical",
    "Output",
    "OutputEstimate",
    "Parameters",
    "PrecisionError",
    "Recording",
    "RecordingError",
    "ResourceError",
    "Rows",
    "Samples",
    "Score",
    "Sensor",
    "SensorDiagnosis",
    "SensorRecord",
    "SlowModelWarning",
    "SmootherOutput",
    "Start",
    "Steps",
    "Stream",
    "TuningError",
    "Verdict",
    "Whiteness",
    "crop",
    "demo",
    "diagnose",
    "diagnose_many",
    "estimate",
    "estimate_many",
    "estimate_online",
    "every",
    "get_model",
    "initial_belief",
    "jit",
    "keep_programs",
    "load",
    "load_parameters",
    "read_export",
    "robust",
    "run_filter",
    "run_filter_batch",
    "run_iterated_smoother",
    "run_iterated_smoother_batch",
    "run_smoother",
    "run_smoother_batch",
    "save",
    "save_parameters",
    "score",
    "set_up",
    "split_at_gaps",
    "timeline",
]

keep_old_names()
if not TYPE_CHECKING:
    # Hidden from type checkers, which would take any name for one that is there.
    __getattr__, __dir__ = attributes(__name__, type_checked(__file__))
