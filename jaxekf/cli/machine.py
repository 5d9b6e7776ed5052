"""How the commands use the machine: all cores, and compiled programs kept from one call to the next."""

import os
from contextlib import suppress
from pathlib import Path

import jax


def prepare() -> None:
    """Make every core a device, and keep compiled programs in the user's cache folder.

    ``JAXEKF_CACHE`` names another folder; empty, it keeps nothing. Where JAX is in use already its
    devices stay as they are.
    """
    with suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    folder = cache_folder()
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def cache_folder() -> Path | None:
    """Where compiled programs are kept; None where they are not."""
    chosen = os.environ.get("JAXEKF_CACHE")
    if chosen is not None:
        return Path(chosen) if chosen else None
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "jaxekf"
