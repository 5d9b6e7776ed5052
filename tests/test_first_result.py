"""How soon a user sees something: what is imported when, and which programs are compiled again."""

import ast
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import click
import numpy as np
import pytest
from scipy import stats

import jaxekf
import tuning
from jaxekf import chi_square
from jaxekf.cli import main

ROOT = Path(__file__).parents[1]
HEAVY = {"jax", "numpy", "scipy", "matplotlib", "plotly", "h5py", "optax", "rich", "yaml"}


def run_python(code, *args, **environment):
    """What a new process prints as JSON on its last line."""
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, args)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def modules_after(code):
    return set(run_python(f"{code}\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"))


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["no-such-command"]])
def test_help_imports_nothing_heavy(arguments):
    """Would catch a command line whose help waits for JAX, or for any command's own imports."""
    code = (
        "import contextlib, io\nfrom jaxekf.cli import main\n"
        "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):\n"
        f"    main({arguments!r})"
    )
    loaded = modules_after(code)
    assert not HEAVY & loaded
    assert not {name for name in loaded if name.startswith("jaxekf.cli.")} - {"jaxekf.cli.commands"}


def test_importing_the_packages_imports_nothing_heavy():
    """Would catch an eager import in `jaxekf` or `tuning`: half of a second for a name not used."""
    loaded = modules_after("import jaxekf, tuning\ndir(jaxekf), dir(tuning)")
    assert not (HEAVY | {"click"}) & loaded


def test_an_estimate_imports_only_what_it_needs():
    """Would catch `scipy.stats`, the slowest import there was, and pictures, in the way of an estimate."""
    loaded = modules_after("import jaxekf\njaxekf.estimate, jaxekf.load, jaxekf.run_filter")
    assert not {"scipy.stats", "scipy.signal", "matplotlib", "plotly", "optax", "click"} & loaded


@pytest.mark.parametrize("package", [jaxekf, tuning])
def test_lazy_names_are_those_type_checkers_see(package):
    """Would catch a public name that exists for type checkers only, or at run time only."""
    tree = ast.parse(Path(package.__file__).read_text())
    guarded = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in guarded.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert set(seen) == set(package.__all__)
    assert set(package.__all__) <= set(dir(package))
    for name, (module, original) in seen.items():
        found = getattr(package, name)
        home = import_module(module)
        expected = getattr(home, original, None) or import_module(f"{module}.{original}")
        assert found is expected, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = package.nothing


@pytest.mark.parametrize("package", [jaxekf, tuning])
def test_no_module_takes_the_name_of_a_function(package):
    """Would catch a module `robust.py` beside a function `robust`: whoever imports it hides the other."""
    folder = Path(package.__file__).parent
    modules = {file.stem for file in folder.glob("*.py")} | {
        file.parent.name for file in folder.glob("*/__init__.py")
    }
    for name in modules & set(package.__all__):
        assert getattr(package, name) is import_module(f"{package.__name__}.{name}"), name


def test_star_import_and_submodules_work_in_a_new_process():
    """Would catch lazy names that only work in a process that has imported their modules already."""
    code = (
        "import json, jaxekf\nfrom jaxekf import *\nfrom jaxekf.cli import estimate\n"
        "import jaxekf.robust_weights\n"
        "print(json.dumps([callable(robust), callable(jaxekf.robust), demo.__name__, rotation.__name__,"
        " jaxekf.storage.__name__]))"
    )
    assert run_python(code) == [
        True,
        True,
        "jaxekf.datasets.demo",
        "jaxekf.rotation",
        "jaxekf.storage",
    ]


def test_every_listed_command_is_there():
    """Would catch a line of the help for a command that cannot be imported or is called otherwise."""
    context = click.Context(main)
    for name in main.list_commands(context):
        command = main.get_command(context, name)
        assert isinstance(command, click.Command) and command.name == name
        assert len(main.places[name].summary) < 60
    assert main.get_command(context, "nothing") is None
    offered = [item.value for item in main.shell_complete(context, "al")]
    assert offered == ["align", "allan"]


def test_chi_square_has_the_numbers_of_scipy():
    """Would catch a bound of a gate that changed with the import it came from."""
    share = np.array([0.0, 0.025, 0.5, 0.95, 1.0, -0.1, 2.0])
    value = np.array([-1.0, 0.0, 0.5, 3.0, 100.0, np.inf, np.nan])
    degrees = np.array([0.0, 1.0, 2.0, 3.0, 2.5, 1e5])[:, None]
    np.testing.assert_array_equal(chi_square.ppf(share, degrees), stats.chi2.ppf(share, degrees))
    np.testing.assert_array_equal(chi_square.cdf(value, degrees), stats.chi2.cdf(value, degrees))
    np.testing.assert_array_equal(chi_square.sf(value, degrees), stats.chi2.sf(value, degrees))
