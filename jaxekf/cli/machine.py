"""How the commands use the machine: all cores, and compiled programs kept from one call to the next."""

import os
from contextlib import suppress

import click
import jax

from jaxekf._support.errors import CacheError
from jaxekf._support.program_cache import keep_programs


def prepare() -> None:
    """Make every core a device, and keep compiled programs in the user's cache folder.

    ``JAXEKF_CACHE`` names another folder; empty, it keeps nothing. Where JAX is in use already its
    devices stay as they are.
    """
    with suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    chosen = os.environ.get("JAXEKF_CACHE")
    if chosen == "":
        return
    try:
        keep_programs(chosen)
    except CacheError as error:
        # A command works without; only who named a folder expects that it is used.
        if chosen is not None:
            click.echo(f"compiled programs are not kept: {error}", err=True)
