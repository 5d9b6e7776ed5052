"""Errors of too little memory as one sentence with the runs."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from jaxekf._support.errors import ResourceError

_XLA = "RESOURCE_EXHAUSTED"
"""Part of the message of the RuntimeError that XLA raises for too little memory."""


@contextmanager
def for_runs(names: Sequence[str]) -> Iterator[None]:
    """Raise `ResourceError` with the names of the runs if the block runs out of memory."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and _XLA not in str(error):
            raise
        reason = str(error).splitlines()[0] if str(error) else "out of memory"
        subject = (
            f"run '{names[0]}'" if len(names) == 1 else f"{len(names)} runs from '{names[0]}' on"
        )
        hint = "cut it into shorter ones" if len(names) == 1 else "pass fewer at once"
        raise ResourceError(
            f"{subject}: got too little memory ({reason}), expected enough for"
            f" {'it' if len(names) == 1 else 'them'}; {hint}, or use a machine with more"
        ) from error
