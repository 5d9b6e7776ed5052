"""How soon a user sees something: what is imported when, and which programs are compiled again."""

import ast
import json
import os
import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import click
import jax
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache
from scipy import stats

import jaxekf
import tuning
from jaxekf._support import chi_square, deprecations, program_cache
from jaxekf.cli import main

ROOT = Path(__file__).parents[1]
HEAVY = {
    "jax",
    "numpy",
    "scipy",
    "matplotlib",
    "plotly",
    "h5py",
    "optax",
    "rich",
    "yaml",
    "msgspec",
    "jinja2",
}


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
        "import jaxekf.models.robust\n"
        "print(json.dumps([callable(robust), callable(jaxekf.robust), demo.__name__, timeline.__name__,"
        " jaxekf.io.run_folder.__name__]))"
    )
    assert run_python(code) == [
        True,
        True,
        "jaxekf.simulation.demo",
        "jaxekf.estimation.timeline",
        "jaxekf.io.run_folder",
    ]


def test_old_names_are_found_for_one_release():
    """Would catch a moved module that breaks a user's script, is loaded twice, or comes without a
    warning."""
    for old, new in deprecations.MOVED.items():
        with pytest.warns(DeprecationWarning, match="will be gone in the next release"):
            module = import_module(old)
        assert module is import_module(new) and module.__spec__.name == new
    with pytest.warns(DeprecationWarning, match=r"jaxekf\.geometry\.triad"):
        assert jaxekf._support.deprecations.moved("jaxekf.vectors", 1) is jaxekf.geometry.triad
    code = (
        "import warnings; warnings.simplefilter('ignore')\nimport json, jaxekf\n"
        "from jaxekf import rotation, storage\nfrom jaxekf.datasets import demo\n"
        "from jaxekf.description import facts\nfrom jaxekf.estimation import estimate\n"
        "from tuning.fit import tune\n"
        "print(json.dumps([rotation.__name__, storage.load is jaxekf.load, demo is jaxekf.demo,"
        " facts({}, ''), callable(estimate), callable(tune)]))"
    )
    assert run_python(code) == ["jaxekf.geometry.rotation", True, True, {}, True, True]


def renamed_in(file):
    """The old names of what a module has renamed: the texts of its calls of `renamed`."""
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "renamed":
            text = ast.literal_eval(node.args[1])
            yield from (entry.partition(">")[0] for entry in text.split())


def test_names_that_a_module_has_renamed_are_found():
    """Would catch an old name that was changed along with the new one, or leads nowhere."""
    found = 0
    for file in sorted((ROOT / "jaxekf").rglob("*.py")):
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for old in renamed_in(file):
            module = import_module(name)
            assert old not in vars(module), f"{name}.{old}"
            with pytest.warns(DeprecationWarning, match=rf"{old} is now .*next release"):
                assert getattr(module, old) is not None
            found += 1
    assert found > 30


def test_every_listed_command_is_there():
    """Would catch a line of the help for a command that cannot be imported or is called otherwise."""
    context = click.Context(main)
    for name in main.list_commands(context):
        command = main.get_command(context, name)
        assert isinstance(command, click.Command) and command.name == name
        assert len(main.lazy_commands[name].summary) < 60
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


COUNTED = """
import collections, json, sys
import jax

events = collections.Counter()
jax.monitoring.register_event_listener(lambda name, **_: events.update([name.split("/")[-1]]))


def counts():
    asked, read = events["compile_requests_use_cache"], events["cache_hits"]
    return {"programs": asked, "compiled": asked - read, "written": events["cache_misses"]}
"""
FILTER_AND_GRADIENT = """
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
import jaxekf

if sys.argv[2] == "late":
    jnp.sin(jnp.ones(3)).block_until_ready()
early = counts()["compiled"]
place = jaxekf.keep_programs(sys.argv[1])
sys.path.insert(0, sys.argv[3])
import toy_models
from jaxekf import Rows, Steps

one = np.eye(2)
model = toy_models.linear_model(one, 0.1 * one, [one], [0.2 * one])
time = np.arange(1.0, 5.0)[:, None]


def likelihood(values):
    rows = Rows(values, None, np.ones((4, 1, 2), bool), np.ones((4, 1)))
    steps = Steps(time, np.ones_like(time), time > 0.0, None, {"sensor_0": rows}, {})
    belief = jaxekf.Belief(jnp.zeros(2), jnp.eye(2))
    return jaxekf.run_filter(model, model.parameters, belief, steps).instants.log_likelihood.sum()


value, slope = jaxekf.jit(jax.value_and_grad(likelihood))(jnp.ones((4, 1, 2)))
found = counts() | {"early": early, "value": float(value), "slope": slope.tolist()}
print(json.dumps(found))
"""


def test_a_second_process_compiles_nothing(tmp_path):
    """Would catch programs that are not kept, for their size, their time or a setting that came too late,
    or whose key changes from process to process."""
    runs = [
        run_python(COUNTED + FILTER_AND_GRADIENT, tmp_path, when, ROOT / "tests")
        for when in ("first", "first", "late")
    ]
    assert runs[0]["programs"] > 1
    assert runs[0]["compiled"] == runs[0]["written"] == runs[0]["programs"]
    assert runs[1]["programs"] == runs[0]["programs"]
    assert runs[1]["compiled"] == runs[1]["written"] == 0
    assert runs[2]["compiled"] == runs[2]["early"] > 0
    assert all(run["value"] == runs[0]["value"] for run in runs)
    assert all(run["slope"] == runs[0]["slope"] for run in runs)


def test_kept_programs_are_apart_by_version_and_processor(tmp_path, monkeypatch):
    """Would catch a folder shared by machines or releases whose programs do not run on one another."""
    info = tmp_path / "cpuinfo"
    names = []
    for flags in ("fpu avx2", "avx2 fpu", "fpu avx2 avx512f", ""):
        info.write_text(f"processor : 0\nmodel name : A: b\nflags : {flags}\n\nprocessor : 1\n")
        monkeypatch.setattr(program_cache, "_CPU_INFO", info)
        names.append(program_cache.processor())
    monkeypatch.setattr(program_cache, "_CPU_INFO", tmp_path / "none")
    names.append(program_cache.processor())
    assert names[0] == names[1]
    assert len(set(names)) == 4


def test_keeping_programs_changes_folder_and_refuses_one_line(tmp_path, restored_cache):
    """Would catch a second folder that JAX ignores, and a traceback for one that cannot be written, or
    settings that a failed call left half made."""
    first = jaxekf.keep_programs(tmp_path / "first")
    jax.jit(lambda x: x * 3.25)(np.ones(3)).block_until_ready()
    second = jaxekf.keep_programs(tmp_path / "second")
    jax.jit(lambda x: x * 4.25)(np.ones(3)).block_until_ready()
    assert [any(place.iterdir()) for place in (first, second)] == [True, True]
    assert first.parent == tmp_path / "first" and version("jaxlib") in first.name
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(jaxekf.CacheError, match="expected a folder that can be written") as refused:
        jaxekf.keep_programs(tmp_path / "file")
    assert "\n" not in str(refused.value)
    assert jax.config.jax_compilation_cache_dir == str(second)


@pytest.fixture
def restored_cache():
    names = ("compilation_cache_dir", "persistent_cache_min_compile_time_secs")
    names = [f"jax_{name}" for name in (*names, "persistent_cache_min_entry_size_bytes")]
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_the_default_folder_follows_the_environment(tmp_path, monkeypatch):
    """Would catch programs written beside the user's other files instead of the cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert program_cache.default_folder() == tmp_path / "jaxekf"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert program_cache.default_folder() == Path.home() / ".cache" / "jaxekf"


OPTIMISER = """
import numpy as np

jax.config.update("jax_enable_x64", True)
import jaxekf
from tuning.search._line_search import LineSearch

jaxekf.keep_programs(sys.argv[1])
slopes = np.array([1.0, 3.0, 10.0])
search, found = LineSearch(np.array([1.0, -2.0, 0.5]), None), []
for _ in range(8):
    point = np.asarray(search.candidate)
    search.move(float(0.5 * point @ (slopes * point)), slopes * point, True)
    found.append(counts()["programs"])
print(json.dumps({"programs": found, "value": search.value}))
"""


def test_the_optimiser_is_two_programs(tmp_path):
    """Would catch optax called operation by operation: eighty programs, and two more at each step."""
    found = run_python(COUNTED + OPTIMISER, tmp_path)
    assert found["programs"][-1] == found["programs"][0] <= 3
    assert found["value"] < 0.1


DATA = """
import dataclasses

import numpy as np

jax.config.update("jax_enable_x64", True)
import jaxekf
from jaxekf.simulation import demo
from tuning.objective.data import prepare
from tuning.objective.objectives import attitude_error, innovation_likelihood
from tuning.search.evaluation import total_counts

jaxekf.keep_programs(sys.argv[1])
runs = [jaxekf.load(path) for path in demo.paths(demo.TRAINING[:1])]
model = jaxekf.get_model("loose")
state = model.space
start = type(state)(*(np.eye(1, *part.shape)[0] for part in state))
# A model's own start is its own affair.
model = dataclasses.replace(model, initial_mean=lambda first: start)
before = counts()["programs"]
data = prepare(model, runs)
aim = attitude_error() + innovation_likelihood()
counted = total_counts([data], aim)
shown = {name: int(number) for name, number in counted.items()}
print(json.dumps({"programs": counts()["programs"] - before, "counted": shown}))
"""


def test_preparing_runs_compiles_nothing(tmp_path):
    """Would catch a program compiled for each shape of array that the tuner takes or counts in."""
    found = run_python(COUNTED + DATA, tmp_path)
    assert found["programs"] == 0
    assert found["counted"]["attitude"] > 1000 and found["counted"]["likelihood"] > 1000


COMMAND = """
from jaxekf.cli import main

main(sys.argv[1:], standalone_mode=False)
print(json.dumps(counts()))
"""


def test_a_command_compiles_nothing_the_second_time(tmp_path):
    """Would catch a command line that keeps only what was slow to compile, or keeps it elsewhere."""
    cache, made = tmp_path / "cache", tmp_path / "runs"
    quick = {"JAXEKF_CACHE": str(cache), "JAXEKF_COMPILE": "quick"}
    run_python(COUNTED + COMMAND, "simulate", "-o", made, "--duration", 5, **quick)
    (run,) = [path.parent for path in made.rglob("recording.toml")]
    first, second = (
        run_python(COUNTED + COMMAND, "estimate", run, "-o", tmp_path / name, **quick)
        for name in ("first", "second")
    )
    assert first["written"] == first["compiled"] > 0
    assert second["programs"] == first["programs"]
    assert second["compiled"] == 0
    assert [path.name for path in cache.iterdir()] == [
        f"jaxlib-{version('jaxlib')}-{program_cache.processor()}"
    ]


def test_a_folder_that_cannot_be_written_is_one_note(tmp_path):
    """Would catch a command that fails, or says nothing, for a cache that was asked for and cannot be."""
    (tmp_path / "file").write_text("no folder")
    done = subprocess.run(
        [sys.executable, "-m", "jaxekf", "report", str(tmp_path / "none")],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "JAXEKF_CACHE": str(tmp_path / "file")},
        check=False,
    )
    notes = [line for line in done.stderr.splitlines() if "not kept" in line]
    assert len(notes) == 1 and "Traceback" not in done.stderr
