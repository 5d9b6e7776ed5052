"""Settings and fixtures shared by all tests."""

import os
from pathlib import Path

import jax
import pytest
from hypothesis import settings

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

settings.register_profile("jaxekf", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("jaxekf")

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """Drop the programs of each file at its end: every one holds memory maps, of which a process may
    have only so many, and the compiler crashes when they run out."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recorded data: ``$JAXEKF_DATA``, or ``../shared/data`` by the repository."""
    folder = Path(os.environ.get("JAXEKF_DATA", REPOSITORY / ".." / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(
            f"There is no recorded data in {folder}; set JAXEKF_DATA to the folder that holds it."
        )
    return folder
