"""Attitude, rate, bias and pose from recorded runs of an optical tracker and an IMU.

Begin with ``jaxekf.set_up()``: it sets JAX to float64 and its compiler to what suits the filter.
"""

from typing import TYPE_CHECKING

from jaxekf.lazy import attributes

if TYPE_CHECKING:
    from jaxekf import manifold, rotation, timeline, unscented, vectors, wahba
    from jaxekf.consistency import Consistency, Whiteness
    from jaxekf.datasets import demo
    from jaxekf.diagnostics import Diagnosis, SensorDiagnosis, diagnose, diagnose_many
    from jaxekf.ekf import FilterOutput, initial_belief, run_filter, run_filter_batch
    from jaxekf.errors import (
        CacheError,
        FilterError,
        JaxekfError,
        MissingPackageError,
        ModelError,
        PrecisionError,
        RecordingError,
        ResourceError,
        TuningError,
    )
    from jaxekf.estimation import estimate, estimate_many
    from jaxekf.export import read_export
    from jaxekf.gaps import split_at_gaps
    from jaxekf.interpolation import InputSample
    from jaxekf.iterated import IteratedOutput, run_iterated_smoother, run_iterated_smoother_batch
    from jaxekf.kernels import jit, set_up
    from jaxekf.manifold import SO3, AdditiveQuaternion, Euclidean, Manifold
    from jaxekf.metrics import Score, score
    from jaxekf.model import Belief, Input, Model, Output, Parameters, Sensor, Start
    from jaxekf.models import get_model
    from jaxekf.online import estimate_online
    from jaxekf.parameters import load as load_parameters
    from jaxekf.parameters import save as save_parameters
    from jaxekf.program_cache import keep_programs
    from jaxekf.recording import Camera, Encoder, Imu, Markers, Optical, Recording, Samples
    from jaxekf.requested import Every, every
    from jaxekf.result import Estimate, OutputEstimate, SensorRecord
    from jaxekf.robust_weights import robust
    from jaxekf.smoother import SmootherOutput, run_smoother, run_smoother_batch
    from jaxekf.storage import load, save
    from jaxekf.stream import Known, Stream
    from jaxekf.verdicts import Fault, Verdict

__version__ = "0.1.0"

__all__ = [
    "SO3",
    "AdditiveQuaternion",
    "Belief",
    "CacheError",
    "Camera",
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
    "Samples",
    "Score",
    "Sensor",
    "SensorDiagnosis",
    "SensorRecord",
    "SmootherOutput",
    "Start",
    "Stream",
    "TuningError",
    "Verdict",
    "Whiteness",
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
    "manifold",
    "read_export",
    "robust",
    "rotation",
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
    "unscented",
    "vectors",
    "wahba",
]

_PLACES = {
    "jaxekf.consistency": ("Consistency", "Whiteness"),
    "jaxekf.datasets.demo": ("demo",),
    "jaxekf.diagnostics": ("Diagnosis", "SensorDiagnosis", "diagnose", "diagnose_many"),
    "jaxekf.ekf": ("FilterOutput", "initial_belief", "run_filter", "run_filter_batch"),
    "jaxekf.errors": (
        "CacheError",
        "FilterError",
        "JaxekfError",
        "MissingPackageError",
        "ModelError",
        "PrecisionError",
        "RecordingError",
        "ResourceError",
        "TuningError",
    ),
    "jaxekf.estimation": ("estimate", "estimate_many"),
    "jaxekf.export": ("read_export",),
    "jaxekf.gaps": ("split_at_gaps",),
    "jaxekf.interpolation": ("InputSample",),
    "jaxekf.iterated": ("IteratedOutput", "run_iterated_smoother", "run_iterated_smoother_batch"),
    "jaxekf.kernels": ("jit", "set_up"),
    "jaxekf.manifold": ("SO3", "AdditiveQuaternion", "Euclidean", "Manifold"),
    "jaxekf.metrics": ("Score", "score"),
    "jaxekf.model": ("Belief", "Input", "Model", "Output", "Parameters", "Sensor", "Start"),
    "jaxekf.models": ("get_model",),
    "jaxekf.online": ("estimate_online",),
    "jaxekf.parameters": ("load_parameters", "save_parameters"),
    "jaxekf.program_cache": ("keep_programs",),
    "jaxekf.recording": ("Camera", "Encoder", "Imu", "Markers", "Optical", "Recording", "Samples"),
    "jaxekf.requested": ("Every", "every"),
    "jaxekf.result": ("Estimate", "OutputEstimate", "SensorRecord"),
    "jaxekf.robust_weights": ("robust",),
    "jaxekf.smoother": ("SmootherOutput", "run_smoother", "run_smoother_batch"),
    "jaxekf.storage": ("load", "save"),
    "jaxekf.stream": ("Known", "Stream"),
    "jaxekf.verdicts": ("Fault", "Verdict"),
}
_RENAMED = {"load_parameters": "load", "save_parameters": "save"}

if not TYPE_CHECKING:
    # Hidden from type checkers, which would take any name for one that is there.
    __getattr__, __dir__ = attributes(__name__, _PLACES, _RENAMED)
