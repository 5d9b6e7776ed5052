"""Checkpoint of a search: its state in one file, written atomically after each step."""

import hashlib
import io
import zipfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxekf._support.errors import TuningError
from jaxekf.io.atomic import whole_file
from tuning.search.evaluation import Evaluation
from tuning.search.multistart import MultiStart

_KIND = "jaxekf tuning, version 4"


def attach(starts: MultiStart, path: Path, options: str) -> None:
    """Write the state of searches to a file after each step, and go on from the file if it exists.

    Raises `TuningError` for a file of another search or of other `options`, and for any other file.
    """
    first = starts.searches[0]
    mark = digest(first, options, first.validation)
    if path.exists():
        starts.restore(read(path, mark))
    starts.keep = partial(write, path, mark)


def digest(problem: Evaluation, options: str, more: Any = None) -> str:
    """SHA-256 of all that a search depends on: problem, options, and more arrays."""
    found = hashlib.sha256(options.encode())
    found.update(repr((problem.model.name, problem.layout, problem.objective)).encode())
    for leaf in jax.tree.leaves((problem.base, problem.training, more)):
        found.update(np.ascontiguousarray(leaf).tobytes())
    return found.hexdigest()


def write(path: Path, mark: str, state: Mapping[str, Any]) -> None:
    """Write arrays by name as one file, atomically."""
    with whole_file(path, overwrite=True) as file:
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, kind=_KIND, mark=mark, **state)
        file.write_bytes(buffer.getvalue())


def read(path: Path, mark: str) -> dict[str, Any]:
    """Arrays that `write` wrote with the same mark. Raises `TuningError` for any other file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            state = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise TuningError(
            f"{path}: got a file that is no state of a tuning ({error}), expected one to go on from, or"
            " none; name another"
        ) from error
    if str(state.get("kind")) != _KIND or str(state.get("mark")) != mark:
        raise TuningError(
            f"{path}: got the state of another tuning, expected one of the same runs, parameters and"
            " options; remove it, or name another file"
        )
    return state
