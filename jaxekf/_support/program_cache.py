"""A cache of compiled programs on disk, so that a later process does not compile them again."""

import hashlib
import os
import platform
import re
import tempfile
from importlib.metadata import version
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

from jaxekf._support.errors import CacheError

_CPU_INFO = Path("/proc/cpuinfo")
_DESCRIBING = ("model name", "flags", "Features", "CPU implementer", "CPU part")
"""Lines of /proc/cpuinfo with the instruction set of a processor, on x86 and on ARM."""


def keep_programs(folder: Path | str | None = None) -> Path:
    """Keep the programs that JAX compiles from now on in a folder, and use those that are there.

    Call it once, before the first estimate; it applies to the whole process. Programs of any size are kept,
    because even the smallest takes ten times longer to compile than to read; programs that call back into
    Python are not. Nothing is ever removed; the folder can be deleted at any time.

    Parameters
    ----------
    folder
        Folder of the cache; by default ``jaxekf`` in the user's cache folder (`default_folder`), as in the
        command line.

    Returns
    -------
    Path
        The sub-folder that is used. Its name has the version of jaxlib and the processor, since a program
        that was compiled for one does not run, or is slow, on another.

    Raises
    ------
    CacheError
        The folder cannot be written; JAX's settings are then unchanged.

    Examples
    --------
    >>> import tempfile
    >>> import jax
    >>> from jax.experimental.compilation_cache import compilation_cache
    >>> import jaxekf
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     place = jaxekf.keep_programs(folder)
    ...     result = jaxekf.jit(lambda x: 2.0 * x)(1.0)
    ...     kept = list(place.iterdir())
    ...     jax.config.update("jax_compilation_cache_dir", None)  # keep no more
    ...     compilation_cache.reset_cache()
    >>> len(kept) > 0
    True
    """
    place = Path(default_folder() if folder is None else folder).expanduser().absolute()
    place = place / f"jaxlib-{version('jaxlib')}-{processor()}"
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        raise CacheError(
            f"{place}: got '{error.strerror or error}', expected a folder that can be written, to keep"
            " compiled programs; pass another folder"
        ) from error
    if jax.config.values["jax_compilation_cache_dir"] not in (None, str(place)):
        # JAX uses its first folder until the cache is reset.
        compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return place


def default_folder() -> Path:
    """``jaxekf`` in the user's cache folder: ``XDG_CACHE_HOME``, or ``~/.cache``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "jaxekf"


def processor() -> str:
    """A short name of this processor, with a hash of its model and of the instructions it has."""
    found = [platform.system(), platform.machine(), platform.processor()]
    try:
        text = _CPU_INFO.read_text("utf-8", "replace")
    except OSError:
        text = ""
    # The first core is enough, and the order of its flags has no meaning.
    lines = dict(
        re.split(r"\s*:\s*", line, maxsplit=1)
        for line in text.split("\n\n")[0].splitlines()
        if ":" in line
    )
    found += [" ".join(sorted(lines.get(key, "").split())) for key in _DESCRIBING]
    name = re.sub(r"[^A-Za-z0-9_]+", "-", platform.machine()) or "unknown"
    return f"{name}-{hashlib.sha256('|'.join(found).encode()).hexdigest()[:12]}"
