"""Versions and precision with which results were made."""

from importlib.metadata import version
from typing import Any

import jax


def provenance() -> dict[str, Any]:
    """Versions of the packages, precision and backend of an estimate."""
    names = ("jaxekf", "jax", "jaxlib", "numpy", "optax")
    return {
        "versions": {name: version(name) for name in names},
        "dtype": "float64",
        "backend": jax.default_backend(),
    }
