"""Too little memory is said in one sentence that names what it was for."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from jaxekf._support.errors import ResourceError

_XLA = "RESOURCE_EXHAUSTED"
"""How the compiler's own error, a RuntimeError, begins."""


@contextmanager
def for_runs(names: Sequence[str]) -> Iterator[None]:
    """Raise `ResourceError` with the names of runs where the block runs out of memory."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and _XLA not in str(error):
            raise
        said = str(error).splitlines()[0] if str(error) else "out of memory"
        told = f"run '{names[0]}'" if len(names) == 1 else f"{len(names)} runs from '{names[0]}' on"
        hint = "cut it into shorter ones" if len(names) == 1 else "name fewer at once"
        raise ResourceError(
            f"{told}: got too little memory ({said}), expected enough for"
            f" {'it' if len(names) == 1 else 'them'}; {hint}, or take a machine with more"
        ) from error
