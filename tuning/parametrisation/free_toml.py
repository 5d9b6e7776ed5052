"""Free parameters from a TOML file."""

import tomllib
from pathlib import Path
from typing import Any

from jaxekf._support.errors import TuningError
from tuning.parametrisation.free_vector import Free

_KEYS = {
    "name": (str, "the name of a parameter"),
    "each_run": (bool, "true or false"),
    "prior": (int | float, "a standard deviation"),
    "bounds": (list, "two numbers in brackets"),
}


def read_free(path: Path | str) -> list[Free]:
    """The ``[[free]]`` tables of a file: ``name`` and optional ``each_run``, ``prior`` and ``bounds``.

    Parameters
    ----------
    path
        A TOML file.

    Raises
    ------
    TuningError
        For a file that has anything else.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import tuning
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "free.toml"  # the same as a table [[free]] with two lines
    ...     _ = file.write_text('free = [{name = "calibration.clock_offset", bounds = [-0.1, 0.1]}]')
    ...     [entry] = tuning.read_free(file)
    >>> entry.name, entry.bounds
    ('calibration.clock_offset', (-0.1, 0.1))
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
        kind, words = _KEYS[key]
        if isinstance(value, bool) != (kind is bool) or not isinstance(value, kind):
            raise TuningError(
                f"{place}: got {key} = {value!r}, expected {words}; correct the value"
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
