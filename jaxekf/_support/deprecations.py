"""Old names of modules and functions: valid for one release, with a `DeprecationWarning`."""

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

# Where modules are now: "old>new" where the name changed too, "name" where only the room did.
_ROOMS = {
    "jaxekf._support": "chi_square errors kernels>compilation lazy memory optional program_cache",
    "jaxekf.calibration": (
        "alignment allan attitude_match>attitude_alignment densities>noise_densities "
        "likeness>motion_agreement rest>static_interval static_noise synchronise>time_offset"
    ),
    "jaxekf.checks": (
        "camera_evidence>_camera_agreement evidence>sensor_agreement inspection "
        "plausible>plausibility"
    ),
    "jaxekf.estimation": (
        "online>causal padding parameters requested>output_times result stream>live timeline"
    ),
    "jaxekf.evaluation": (
        "consistency diagnostics>diagnosis metrics signatures>_fault_signatures verdicts"
    ),
    "jaxekf.filtering": (
        "about>_lowered_model algebra>_covariance_update backward>_smoother_pass ekf "
        "epochs>_substeps interpolation iterated>iterated_smoother linearise>_linearisation "
        "many>_repeated_groups model outliers>_gating recursion>_recursion "
        "relinearise>_iterated_update smoother step>_step system>_lowered_model"
    ),
    "jaxekf.filtering.lowering": (
        "blocks>batching group_derivative lanes own_derivative>batched_vjp packed "
        "patterned>structured_matrix programs>scalar_graph reverse_only structure>sparsity"
    ),
    "jaxekf.geometry": (
        "linalg manifold projection>pinhole rotation three_unknowns>quadratic_least_squares "
        "unscented vectors>triad wahba"
    ),
    "jaxekf.io": (
        "camera_storage>streams.camera container_files>_container_arrays "
        "container_guard>_container_integrity container_layout>_container_schema "
        "container_streams>streams containers>container datasets>importers "
        "description encoder_storage>streams.encoder export files>atomic frame_lines>_frame_rows "
        "hashes marker_storage>streams.markers stated>_section_entries storage>run_folder "
        "tables>csv_table temporary>_temporary text>_csv_text"
    ),
    "jaxekf.io.importers": (
        "datasets.adis datasets.asl datasets.bag_files>_bag_files datasets.bags>_bags "
        "datasets.broad datasets.columns>_asl_columns datasets.exports>_exports datasets.formats "
        "datasets.ndi datasets.optitrack datasets.repoimu datasets.ros "
        "datasets.ros_messages>_ros_messages datasets.vicon"
    ),
    "jaxekf.models": (
        "models.correspondences>_correspondences models.earth>_earth regions>search_regions "
        "robust_weights>robust"
    ),
    "jaxekf.pose_solvers": (
        "differential>gyro_free_rate inclination>tilt placement>accelerometer_array "
        "pose>marker_pose resection>pnp"
    ),
    "jaxekf.recordings": (
        "gaps intake>screening recording>types repeats>frozen_poses rows>accounts "
        "streams>sample_selection truth"
    ),
    "jaxekf.reporting": "plots report",
    "jaxekf.reporting.plots": (
        "plots.attitudes>_attitudes plots.biases>_biases plots.deviations plots.paths>_paths "
        "plots.sight>_measurements plots.single_markers>_single_markers plots.style plots.timeaxis "
        "plots.vectors>_vectors"
    ),
    "jaxekf.reporting.report": (
        "report.consistency>_consistency report.evidence>_comparison report.figures>_figures "
        "report.grid>_grid report.markup>_tables report.page>_page report.saved>_saved "
        "report.summary>_summary report.thinning>_thinning report.tuned>_tuned "
        "report.tuning_figures>_tuning_figures report.tunings>_tunings"
    ),
    "jaxekf.simulation": (
        "datasets.demo simulate>attitude_runs simulate_camera>camera_runs "
        "simulate_surgery>gyro_free_runs simulate_tool>marker_runs"
    ),
    "tuning": "fit>tuner",
    "tuning.comparison": (
        "validation>compare folds>cross_validation beside>baselines allan_only work>cost"
    ),
    "tuning.objective": (
        "objectives data consistency>covariance_scale information>fisher_information"
    ),
    "tuning.parametrisation": "noise>free_vector spec>free_toml frame>truth_frame",
    "tuning.persistence": (
        "resume>checkpoint kept>fold_checkpoint record>tuning_document cautions>_tuning_warnings"
    ),
    "tuning.results": "fitted",
    "tuning.search": (
        "walk>_line_search descent batches>_minibatch starts>multistart derivative_free "
        "ways>optimisers"
    ),
}
# Names that left their module: where they are now.
_NAMES = {
    "jaxekf.description": {
        "facts": "jaxekf.recordings.facts:known_entries",
        **{
            name: f"jaxekf.recordings.facts:{name}"
            for name in ("finite_number", "finite_vector", "nonzero_vector", "unit_vector")
        },
    },
    "jaxekf.datasets": {"demo": "jaxekf.simulation:demo"},
    "jaxekf.static_noise": {"read_log": "jaxekf.io.run_folder:read_log"},
    "tuning.descent": {"total_counts": "tuning.search.evaluation:total_counts"},
    "tuning.beside": {"BESIDE": "tuning.comparison.baselines:BASELINES"},
    "tuning.folds": {
        name: f"tuning.results.held_out:{name}" for name in ("ParameterSpread", "Spread")
    },
    "tuning.work": {"Work": "tuning.results.held_out:Work"},
    "tuning.fitted": {"Fit": "tuning.results.fitted:FittedParameters"},
    "tuning.validation": {
        name: f"tuning.results.comparison:{name}" for name in ("as_dicts", "mean_by_variant")
    },
    "tuning.walk": {"Walk": "tuning.search._line_search:LineSearch"},
}


def _moved() -> dict[str, str]:
    """Today's name of every module, by its name before."""
    found = {}
    for room, modules in _ROOMS.items():
        package = room.partition(".")[0]
        for entry in modules.split():
            old, _, new = entry.partition(">")
            found[f"{package}.{old}"] = f"{room}.{new or old.rpartition('.')[2]}"
    return found


MOVED = _moved()


P = ParamSpec("P")
T = TypeVar("T")


def warn_renamed(old: str, new: str, stacklevel: int = 2) -> None:
    """Warn of an old name, at the line of the caller's caller unless given."""
    warnings.warn(
        f"{old} is now {new}; the old name will be gone in the next release",
        DeprecationWarning,
        stacklevel=stacklevel + 1,
    )


def _rename_keys(
    options: dict[str, Any], renamed: Mapping[str, str], kind: str, owner: str
) -> None:
    """Put keyword arguments under their new names, with a warning at the line of the call."""
    for old, new in renamed.items():
        if old in options:
            warn_renamed(f"the {kind} {old} of {owner}", new, stacklevel=3)
            options[new] = options.pop(old)


def renamed_arguments(**renamed: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorator of a function that takes keyword arguments under their old names too: ``old="new"``."""

    def decorated(function: Callable[P, T]) -> Callable[P, T]:
        @wraps(function)
        def call(*args: P.args, **options: P.kwargs) -> T:
            _rename_keys(options, renamed, "argument", function.__name__)
            return function(*args, **options)

        return call

    return decorated


def renamed_fields(**renamed: str) -> Callable[[type[T]], type[T]]:
    """Decorator of a dataclass whose fields are set and read by their old names too: ``old="new"``."""

    def decorated(cls: type[T]) -> type[T]:
        init: Any = cls.__init__

        @wraps(init)
        def __init__(self: Any, *args: Any, **options: Any) -> None:
            _rename_keys(options, renamed, "field", cls.__name__)
            init(self, *args, **options)

        def reader(old: str, new: str) -> property:
            def read(self: Any) -> Any:
                warn_renamed(f"the field {old} of {cls.__name__}", new)
                return getattr(self, new)

            return property(read)

        cls.__init__ = __init__
        for old, new in renamed.items():
            setattr(cls, old, reader(old, new))
        return cls

    return decorated


def moved(name: str, stacklevel: int) -> ModuleType:
    """The module that was `name`, which is warned of at the caller's line."""
    warn_renamed(f"the module {name}", MOVED[name], stacklevel + 1)
    module = import_module(MOVED[name])
    for old, place in _NAMES.get(name, {}).items():
        home, _, new = place.partition(":")
        setattr(module, old, getattr(import_module(home), new))
    return module


class _OldNames:
    """Finds moved modules by their old names, before the new folder of one is searched for another."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return spec_from_loader(name, self) if name in MOVED else None  # pyright: ignore

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = moved(spec.name, stacklevel=2)
        self._own: Any = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # The import system gave it the spec of the old name.
        module.__spec__ = self._own


def keep_old_names() -> None:
    """Find modules under their old names from now on."""
    if not any(isinstance(finder, _OldNames) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OldNames())  # pyright: ignore[reportArgumentType]


def renamed(module: str, names: str) -> Callable[[str], Any]:
    """``__getattr__`` of `module` that finds its old names.

    `names` are "old>new", or "old>package.module.new" if the name left the module, separated by blanks.
    """
    places = dict(entry.split(">") for entry in names.split())

    def __getattr__(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module '{module}' has no attribute '{name}'", name=name)
        home, _, new = places[name].rpartition(".")
        warn_renamed(f"{module}.{name}", f"{home or module}.{new}")
        return getattr(import_module(home or module), new)

    return __getattr__
