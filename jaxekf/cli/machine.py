"""Settings of JAX for the commands: all CPU cores, and a cache of compiled programs on disk."""

import os
from contextlib import suppress

import click
import jax

from jaxekf._support.errors import CacheError
from jaxekf._support.program_cache import keep_programs


def prepare() -> None:
    """Make each CPU core a JAX device, and keep compiled programs in the user's cache folder.

    The environment variable ``JAXEKF_CACHE`` names another folder; if it is empty, nothing is kept. If JAX
    is in use already, its devices stay as they are.
    """
    with suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    chosen = os.environ.get("JAXEKF_CACHE")
    if chosen == "":
        return
    try:
        keep_programs(chosen)
    except CacheError as error:
        # A command works without a cache; only a user who named a folder needs to know.
        if chosen is not None:
            click.echo(f"compiled programs are not kept: {error}", err=True)
