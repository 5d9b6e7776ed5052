"""Recordings of other programs, read as `Recording`.

Each public module has a `load`. A new format is a module here and an entry in `formats.FORMATS`, which
declares the options of `jaxekf import`. CSV exports are read by `_exports`.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
