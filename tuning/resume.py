"""A tuning that was stopped goes on: the state of its loop in one file, written whole after each step."""

import hashlib
import io
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxekf.errors import TuningError
from jaxekf.files import whole_file
from tuning.descent import Descent
from tuning.starts import Race

_KIND = "jaxekf tuning, version 2"


def attach(race: Race, path: Path, asked: str) -> None:
    """Keep the state of searches in a file, and go on from there if it is the same searches'.

    `asked` is what else makes it the same. Raises `TuningError` for a file that is not, or no such file.
    """
    mark = _mark(race.searches[0], asked)
    if path.exists():
        race.restore(_read(path, mark))

    def keep(state: dict[str, Any]) -> None:
        with whole_file(path, overwrite=True) as file:
            buffer = io.BytesIO()
            np.savez(buffer, allow_pickle=False, kind=_KIND, mark=mark, **state)
            file.write_bytes(buffer.getvalue())

    race.keep = keep


def _mark(search: Descent, asked: str) -> str:
    """A digest of all that a search depends on."""
    told = hashlib.sha256(asked.encode())
    told.update(repr((search.model.name, search.layout, search.objective)).encode())
    for leaf in jax.tree.leaves((search.base, search.training, search.validation)):
        told.update(np.ascontiguousarray(leaf).tobytes())
    return told.hexdigest()


def _read(path: Path, mark: str) -> dict[str, Any]:
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
