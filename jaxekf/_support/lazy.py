"""Public names of a package that are imported when they are first used (PEP 562).

Importing all modules takes seconds, also for a user who needs only the version or one function.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from jaxekf._support.deprecations import MOVED, moved, warn_renamed


def attributes(
    package: str,
    places: Mapping[str, Sequence[str]],
    renamed: Mapping[str, str] | None = None,
    old_names: Mapping[str, str] | None = None,
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of `package`.

    `places` names for each module the public names that are in it, `renamed` the name in the module
    where it differs from the public one, `old_names` the public names by their deprecated ones. A
    submodule of `package` is found by its own name without being listed; one that has moved is warned of.
    """
    modules = {name: module for module, names in places.items() for name in names}
    renamed = renamed or {}

    def __getattr__(name: str) -> Any:
        if name in modules:
            value = getattr(import_module(modules[name]), renamed.get(name, name))
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
        return sorted({*own, *own.get("__all__", ()), *modules})

    return __getattr__, __dir__
