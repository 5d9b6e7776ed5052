"""Public names of a package that are imported when they are first used (PEP 562).

Importing all modules takes seconds, also for a user who needs only the version or one function.
"""

import ast
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from jaxekf._support.deprecations import MOVED, moved, warn_renamed

Names = Mapping[str, tuple[str, str]]
"""Public names, each with its module and its name there."""


def type_checked(file: str) -> dict[str, tuple[str, str]]:
    """The names that the package `file` imports under ``if TYPE_CHECKING``, which type checkers see."""
    tree = ast.parse(Path(file).read_text("utf-8"))
    guarded = next(node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.asname or alias.name: (node.module, alias.name)
        for node in guarded.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


def names_of(module: str, *names: str) -> dict[str, tuple[str, str]]:
    """Public names that have the same name in a module."""
    return {name: (module, name) for name in names}


def attributes(
    package: str, public: Names, old_names: Mapping[str, str] | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of `package`.

    `old_names` are the public names by their deprecated ones. A submodule of `package` is found by its own
    name without being listed; one that has moved is warned of.
    """

    def __getattr__(name: str) -> Any:
        if name in public:
            module, own = public[name]
            value = getattr(import_module(module), own)
        elif f"{package}.{name}" in MOVED:
            value = moved(f"{package}.{name}", stacklevel=2)
        elif old_names and name in old_names:
            warn_renamed(f"{package}.{name}", f"{package}.{old_names[name]}")
            return __getattr__(old_names[name])
        elif not name.startswith("_") and find_spec(f"{package}.{name}") is not None:
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module '{package}' has no attribute '{name}'", name=name)
        # Python does not call `__getattr__` for this name again.
        setattr(sys.modules[package], name, value)
        return value

    def __dir__() -> list[str]:
        own = vars(sys.modules[package])
        return sorted({*own, *own.get("__all__", ()), *public})

    return __getattr__, __dir__
