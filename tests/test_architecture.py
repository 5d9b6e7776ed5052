"""The rules of the architecture: which way imports run, and who may know what."""

import ast
import re
from pathlib import Path

import pytest

import jaxekf
import tuning

ROOT = Path(__file__).parents[1]
# A module may import those before it. What stands in one entry does not import its neighbours.
ORDER = [
    ("errors", "lazy", "chi_square"),
    ("rows", "optional", "memory", "program_cache"),
    ("rotation", "linalg", "recording", "temporary", "projection"),
    ("three_unknowns", "placement", "resection"),
    ("files", "differential"),
    ("densities", "rest", "intake", "text", "container_guard", "likeness", "inclination"),
    ("allan",),
    ("manifold", "tables", "truth", "description", "streams", "gaps", "vectors"),
    ("stated", "hashes", "unscented", "wahba", "frame_lines"),
    (
        "model",
        "pose",
        "synchronise",
        "marker_storage",
        "camera_storage",
        "encoder_storage",
        "export",
        "requested",
    ),
    (
        "timeline",
        "attitude_match",
        "evidence",
        "container_layout",
        "container_files",
        "container_streams",
        "repeats",
    ),
    ("containers",),
    ("alignment", "plausible"),
    ("camera_evidence",),
    ("inspection",),
    ("interpolation", "padding", "programs", "kernels", "reverse_only"),
    ("structure", "lanes", "blocks", "epochs", "many"),
    ("patterned", "packed", "group_derivative", "own_derivative"),
    ("linearise", "algebra"),
    ("system",),
    ("outliers", "about"),
    ("step",),
    ("recursion", "relinearise"),
    ("backward",),
    ("ekf", "models.sources", "storage"),
    ("models.loose", "models.inertial"),
    ("models.earth", "models.correspondences"),
    (
        "models.loose_rate",
        "models.loose_additive",
        "models.loose_pose",
        "models.tight",
        "models.triad",
        "models.marg",
        "models.visual",
    ),
    ("models",),
    ("parameters", "robust_weights", "static_noise", "regions"),
    ("result", "smoother"),
    ("estimation", "iterated"),
    ("metrics", "simulate", "online", "stream", "consistency"),
    ("signatures", "verdicts"),
    ("diagnostics",),
    ("simulate_tool",),
    ("simulate_surgery", "simulate_camera"),
    ("datasets.columns", "datasets.exports", "datasets.bag_files"),
    ("datasets.bags",),
    ("datasets.ros_messages",),
    (
        "datasets.adis",
        "datasets.asl",
        "datasets.broad",
        "datasets.demo",
        "datasets.ndi",
        "datasets.optitrack",
        "datasets.repoimu",
        "datasets.ros",
        "datasets.vicon",
    ),
    ("datasets", "datasets.formats"),
    ("plots.style", "plots.sight"),
    (
        "plots.attitudes",
        "plots.vectors",
        "plots.biases",
        "plots.paths",
        "plots.single_markers",
        "plots.deviations",
        "plots.timeaxis",
    ),
    ("plots",),
    ("report.saved", "report.thinning", "report.tuned"),
    ("report.evidence", "report.grid"),
    ("report.figures", "report.summary"),
    ("report.consistency", "report.tuning_figures", "report.markup"),
    ("report.tunings",),
    ("report.page",),
    ("report",),
    ("cli.commands",),
    ("cli.console", "cli.machine", "cli.options"),
    ("cli.comparison",),
    ("cli.simulate", "cli.estimate", "cli.report", "cli.allan", "cli.folds", "cli.imports"),
    ("cli.plot", "cli.tune", "cli.align"),
    ("cli.demo", "cli.check"),
    ("cli",),
    ("__main__",),
]
RANK = {name: i for i, names in enumerate(ORDER) for name in names}


def module_name(file):
    parts = file.relative_to(ROOT / "jaxekf").with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(file):
    """Every module a file imports, ``from a import b`` as ``a.b`` where that is a module."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                is_module = (ROOT / (name.replace(".", "/") + ".py")).exists()
                is_package = (ROOT / name.replace(".", "/") / "__init__.py").exists()
                yield name if is_module or is_package else node.module


FILES = sorted((ROOT / "jaxekf").rglob("*.py"))


@pytest.mark.parametrize("file", FILES, ids=module_name)
def test_imports_run_one_way(file):
    """Would catch a cycle, or a core that comes to know its models or its command line."""
    name = module_name(file)
    if name == "":
        return
    for imported in imports(file):
        if imported == "jaxekf" or not imported.startswith("jaxekf."):
            continue
        other = imported.removeprefix("jaxekf.")
        if other == "__version__":
            continue
        assert RANK[other] < RANK[name], f"{name} imports {other}"


@pytest.mark.parametrize("file", FILES, ids=module_name)
def test_who_may_know_what(file):
    """Would catch matplotlib outside plots, plotly outside report, HDF5 outside exports, optax outside
    tuning, and tuning outside the command line."""
    name, tops = module_name(file), {m.split(".")[0] for m in imports(file)}
    assert "matplotlib" not in tops or name.split(".")[0] == "plots"
    assert "plotly" not in tops or name.split(".")[0] == "report"
    assert "optax" not in tops
    assert "h5py" not in tops or name in ("export", "container_files")
    assert "tuning" not in tops or name.startswith("cli")
    assert not ({"click", "rich"} & tops) or name.startswith("cli")


@pytest.mark.parametrize("package", [jaxekf, tuning])
def test_public_names_are_documented(package):
    """Would catch a public name that is gone, or has no docstring of its own."""
    assert package.__all__ == sorted(
        package.__all__, key=lambda n: (not n.isupper(), n.islower(), n)
    )
    for name in package.__all__:
        thing = getattr(package, name)
        assert (thing.__doc__ or "").strip(), name


@pytest.mark.parametrize("folder", ["jaxekf", "tuning"])
def test_functions_stay_short(folder):
    """Would catch the 700-line step function."""
    for file in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef):
                length = (node.end_lineno or 0) - node.lineno
                assert length <= 90, f"{file.name}:{node.name} has {length} lines"


def test_packages_are_typed():
    """Would catch a release that type checkers ignore."""
    for package in (jaxekf, tuning):
        assert (Path(package.__file__).parent / "py.typed").is_file()


def test_ci_runs_the_command_of_the_readme():
    """Would catch a README whose test command is not the one that is known to work."""
    readme = (ROOT / "README.md").read_text()
    commands = re.findall(r"^python3 -m venv .*$", readme, re.M)
    assert len(commands) == 2
    assert "jaxekf demo" in commands[0]
    assert "pytest" in commands[1]
    assert "README.md" in (ROOT / ".ci" / "run").read_text()
