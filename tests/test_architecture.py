"""The rules of the architecture: which way imports run, and who may know what."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import jaxekf
import tuning

ROOT = Path(__file__).parents[1]
# A room may import those before it, and `jaxekf` itself only holds what is public.
ROOMS = {
    "jaxekf": (
        "_support",
        "geometry",
        "recordings",
        "filtering",
        "pose_solvers",
        "models",
        "calibration",
        "checks",
        "io",
        "estimation",
        "evaluation",
        "simulation",
        "reporting",
        "cli",
    ),
    "tuning": (
        "parametrisation",
        "objective",
        "results",
        "search",
        "persistence",
        "tuner",
        "comparison",
    ),
}
# Rooms within rooms, and the only room that may import them.
INNER = {"jaxekf.filtering.lowering": "filtering"}
FOR_ALL = ("_support",)
FILES = [file for top in ROOMS for file in sorted((ROOT / top).rglob("*.py"))]


def module_name(file):
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(file) for file in FILES}


def imports(file):
    """Every module a file imports, ``from a import b`` as ``a.b`` where that is a module; those inside
    functions and under ``TYPE_CHECKING`` too."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in MODULES else node.module


def room_of(module):
    """The room of a module, '' for `jaxekf` and `tuning` themselves and for ``python -m jaxekf``."""
    room = [*module.split("."), ""][1]
    return "" if room == "__main__" else room


def test_the_house_has_these_rooms():
    """Would catch a file in the hall, and a room that no rule knows."""
    for top, rooms in ROOMS.items():
        there = {
            p.name.removesuffix(".py") for p in (ROOT / top).iterdir() if p.name != "__pycache__"
        }
        assert there - {"__init__", "__main__", "py.typed"} == set(rooms)
    assert len(ROOMS["jaxekf"]) <= 14


@pytest.mark.parametrize("file", FILES, ids=module_name)
def test_imports_run_one_way(file):
    """Would catch a core that comes to know its models, its files or its command line."""
    name = module_name(file)
    top, room = name.split(".")[0], room_of(name)
    for imported in imports(file):
        other_top, other = imported.split(".")[0], room_of(imported)
        if other_top not in ROOMS or room == "" or other in ("", room):
            continue
        if other_top == top:
            order = ROOMS[top]
            assert order.index(other) < order.index(room), f"{name} imports {imported}"
        else:
            assert top == "tuning" or room == "cli", f"{name} imports {imported}"


@pytest.mark.parametrize("file", FILES, ids=module_name)
def test_private_modules_stay_in_their_room(file):
    """Would catch a room that reaches into another's inner parts."""
    name = module_name(file)
    room = room_of(name)
    for imported in imports(file):
        if imported.split(".")[0] not in ROOMS or room in ("", room_of(imported)):
            continue
        for inner, owner in INNER.items():
            assert not imported.startswith(inner) or room == owner, f"{name} imports {imported}"
        private = [part for part in imported.split(".") if part.startswith("_")]
        assert set(private) <= set(FOR_ALL), f"{name} imports {imported}"


def test_no_module_imports_itself_in_a_circle():
    """Would catch two modules that can only be understood together, also where ``TYPE_CHECKING`` hides
    it."""
    known = {module_name(file): {m for m in imports(file) if m in MODULES} for file in FILES}
    for package in ROOMS:
        known.pop(package)
    list(TopologicalSorter(known).static_order())


def test_rooms_say_what_they_hold():
    """Would catch a room that a newcomer has to guess at, and a file that is too long to be read at
    once."""
    for file in FILES:
        text = file.read_text()
        assert len(text.splitlines()) <= 450, file
        if file.name == "__init__.py":
            doc = ast.get_docstring(ast.parse(text)) or ""
            assert doc.count(". ") + doc.count(".\n") + doc.endswith(".") >= 1, file


@pytest.mark.parametrize("file", FILES, ids=module_name)
def test_who_may_know_what(file):
    """Would catch matplotlib outside plots, plotly and jinja2 outside report, HDF5 outside exports, msgspec
    outside documents, optax outside tuning, and tuning outside the command line."""
    name, tops = module_name(file), {m.split(".")[0] for m in imports(file)}
    assert "matplotlib" not in tops or name.startswith("jaxekf.reporting.plots")
    assert not ({"plotly", "jinja2"} & tops) or name.startswith("jaxekf.reporting.report")
    documents = ("jaxekf.io.documents", "jaxekf.cli.align", "jaxekf.reporting.report")
    assert "msgspec" not in tops or name.startswith(documents)
    assert "optax" not in tops or name.startswith("tuning")
    assert "h5py" not in tops or name in ("jaxekf.io.export", "jaxekf.io._container_arrays")
    assert "tuning" not in tops or name.startswith(("tuning", "jaxekf.cli"))
    assert not ({"click", "rich"} & tops) or name.startswith("jaxekf.cli")


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
                text = ast.get_docstring(node, clean=False) or ""
                length = (node.end_lineno or 0) - node.lineno - len(text.splitlines())
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
