"""Free parameters from a TOML file."""

import tomllib
from pathlib import Path
from typing import Any

from jaxekf._support.errors import TuningError
from tuning.parametrisation.free_vector import Free

_KEYS = {"name": str, "each_run": bool, "prior": (int, float), "bounds": list}


def read_free(path: Path | str) -> list[Free]:
    """The ``[[free]]`` tables of a file, each with ``name`` and maybe ``each_run``, ``prior``, ``bounds``.

    Raises `TuningError` for a file that is not so.
    """
    try:
        document = tomllib.loads(Path(path).read_text("utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise TuningError(
            f"{path}: got no TOML ({error}), expected [[free]] tables; check the path and the text"
        ) from error
    tables = document.get("free")
    if set(document) != {"free"} or not isinstance(tables, list) or not tables:
        raise TuningError(
            f"{path}: got {sorted(document)}, expected nothing but [[free]] tables; write one for each"
            " parameter that may change"
        )
    return [_entry(path, i + 1, table) for i, table in enumerate(tables)]


def _entry(path: Path | str, number: int, table: Any) -> Free:
    place = f"{path}: table {number} of [[free]]"
    if not isinstance(table, dict) or "name" not in table or set(table) - set(_KEYS):
        raise TuningError(
            f"{place}: got {table!r}, expected name and some of {[k for k in _KEYS if k != 'name']};"
            " correct the keys"
        )
    for key, value in table.items():
        wrong = isinstance(value, bool) != (_KEYS[key] is bool)
        if wrong or not isinstance(value, _KEYS[key]):
            raise TuningError(
                f"{place}: got {key} = {value!r}, expected {_describe(key)}; correct the value"
            )
    bounds = table.get("bounds")
    if bounds is not None:
        if len(bounds) != 2 or not all(
            isinstance(b, int | float) and not isinstance(b, bool) for b in bounds
        ):
            raise TuningError(
                f"{place}: got bounds = {bounds!r}, expected two numbers; correct the value"
            )
        bounds = (float(bounds[0]), float(bounds[1]))
    return Free(table["name"], table.get("each_run", False), table.get("prior"), bounds)


def _describe(key: str) -> str:
    return {
        "name": "the name of a parameter",
        "each_run": "true or false",
        "prior": "a standard deviation",
        "bounds": "two numbers in brackets",
    }[key]
