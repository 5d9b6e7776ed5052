"""A tuning that was stopped goes on: the state of its loop in one file, written whole after each step."""

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
from tuning.search.descent import Descent
from tuning.search.multistart import Race

_KIND = "jaxekf tuning, version 3"


def attach(race: Race, path: Path, asked: str) -> None:
    """Keep the state of searches in a file, and go on from there if it is the same searches'.

    `asked` is what else makes it the same. Raises `TuningError` for a file that is not, or no such file.
    """
    mark = digest(race.searches[0], asked, race.searches[0].validation)
    if path.exists():
        race.restore(read(path, mark))
    race.keep = partial(write, path, mark)


def digest(search: Descent, asked: str, more: Any = None) -> str:
    """Of all that a search depends on, and of more arrays."""
    told = hashlib.sha256(asked.encode())
    told.update(repr((search.model.name, search.layout, search.objective)).encode())
    for leaf in jax.tree.leaves((search.base, search.training, more)):
        told.update(np.ascontiguousarray(leaf).tobytes())
    return told.hexdigest()


def write(path: Path, mark: str, state: Mapping[str, Any]) -> None:
    """Write arrays by name as one file, whole or not at all."""
    with whole_file(path, overwrite=True) as file:
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, kind=_KIND, mark=mark, **state)
        file.write_bytes(buffer.getvalue())


def read(path: Path, mark: str) -> dict[str, Any]:
    """What `write` wrote under the same mark. Raises `TuningError` for any other file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            kept = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise TuningError(
            f"{path}: got a file that is no state of a tuning ({error}), expected one to go on from, or"
            " none; name another"
        ) from error
    if str(kept.get("kind")) != _KIND or str(kept.get("mark")) != mark:
        raise TuningError(
            f"{path}: got the state of another tuning, expected one of the same runs, parameters and"
            " options; remove it, or name another file"
        )
    return kept
