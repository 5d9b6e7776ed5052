"""Optional packages, which an extra of jaxekf installs: imported when needed."""

from importlib import import_module
from types import ModuleType

from jaxekf._support.errors import MissingPackageError


def need(module: str, extra: str) -> ModuleType:
    """Import a module of an optional package.

    Parameters
    ----------
    module
        Name of the module.
    extra
        The extra of jaxekf that installs its package.

    Raises
    ------
    MissingPackageError
        The package is not installed, or its import fails.
    """
    command = f'pip install "jaxekf[{extra}]"'
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"got no package '{error.name or module}', expected it to be installed; install it: {command}"
        ) from error
    except ImportError as error:
        raise MissingPackageError(
            f"got a package '{module}' that does not load ({error}), expected one that does; install it"
            f" again: {command}"
        ) from error
