"""Packages that only an extra brings: imported when they are needed, named when they are missing."""

from importlib import import_module
from types import ModuleType

from jaxekf._support.errors import MissingPackageError


def need(module: str, extra: str) -> ModuleType:
    """The module of that name, imported; `extra` is the extra of jaxekf that installs it.

    Raises `MissingPackageError`, which names the command that installs it, where it is not there, and one
    that says what went wrong where it is there and does not work.
    """
    command = f'pip install "jaxekf[{extra}]"'
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"got no package '{error.name or module}', expected it for this; install it: {command}"
        ) from error
    except ImportError as error:
        raise MissingPackageError(
            f"got a package '{module}' that does not load ({error}), expected one that does; install it"
            f" again: {command}"
        ) from error
