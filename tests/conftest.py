"""Settings and fixtures shared by all tests."""

import atexit
import ctypes
import functools
import gc
import os
import shutil
import sys
import tempfile
from pathlib import Path

import jax
import pytest
from hypothesis import settings

import jaxekf
from jaxekf._support import compilation
from jaxekf.estimation.result import Estimate
from tuning.search import evaluation

# Most tests wait for the compiler, not for what it made. Those of the filter itself, long descents and the
# long forms are compiled as users have it.
if os.environ.get("JAXEKF_LONG") != "1":
    os.environ.setdefault("JAXEKF_COMPILE", "quick")

jaxekf.set_up()
jax.config.update("jax_numpy_rank_promotion", "raise")

# Nearly all the time goes into compiling. Programs are kept for this run of the tests, so that what two
# files, or the two processes, ask for is compiled once; the first process makes the folder.
if "JAXEKF_TEST_PROGRAMS" not in os.environ:
    os.environ["JAXEKF_TEST_PROGRAMS"] = tempfile.mkdtemp(prefix="jaxekf-programs-")
    atexit.register(shutil.rmtree, os.environ["JAXEKF_TEST_PROGRAMS"], ignore_errors=True)
jax.config.update("jax_compilation_cache_dir", os.environ["JAXEKF_TEST_PROGRAMS"])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)

settings.register_profile("jaxekf", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("jaxekf")

LONGEST = {
    f"test_{name}.py"
    for name in (
        *("calibration", "contract", "gradient", "naive", "scripts", "smoother", "speed", "tight"),
        *("tuning", "tuning_statistics"),
    )
}
"""Files that take minutes. They are begun first, so that neither process waits for the other at the end."""

RUN_LONG = {"test_starts.py", "test_tuning.py", "test_tuning_statistics.py"}
"""Files whose descents take longer to run than to compile."""


def pytest_configure(config):
    # Or pytest-xdist begins with the files of most tests.
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.name not in LONGEST)


REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """Drop the programs of each file at its end: every one holds memory maps, of which a process may
    have only so many, and the compiler crashes when they run out. What the compiler freed goes back to
    the system, which takes half of a process's memory."""
    yield
    jax.clear_caches()
    gc.collect()  # a file left open is found here, in the file that left it
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="module", autouse=True)
def _compile_descents_well(request):
    """Descents of many iterations are compiled as users have them."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.name in RUN_LONG:
            options = {"static_argnums": (0, 1, 2), "compiler_options": compilation.FAST}
            for name in ("_value", "_value_and_gradient", "_values_and_gradients"):
                function = getattr(evaluation, name).__wrapped__
                patch.setattr(evaluation, name, jaxekf.jit(function, **options))
        yield


@pytest.fixture(scope="session", autouse=True)
def _accounts_close():
    """In every test that makes an estimate: rows read = used + masked + gated + dropped, exactly."""
    made = Estimate.__init__

    @functools.wraps(made)
    def checked(self, *given, **named):
        made(self, *given, **named)
        for name, account in self.account.items():
            rest = sum(account.values()) - account["read"]
            assert account["read"] == rest, f"the account of {name} does not close: {account}"

    Estimate.__init__ = checked
    yield
    Estimate.__init__ = made


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recorded data: ``$JAXEKF_DATA``, or ``../shared/data`` by the repository."""
    folder = Path(os.environ.get("JAXEKF_DATA", REPOSITORY / ".." / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(
            f"There is no recorded data in {folder}; set JAXEKF_DATA to the folder that holds it."
        )
    return folder
