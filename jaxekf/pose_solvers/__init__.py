"""Poses, tilt and rate of one instant by themselves, on the host: no filter and no history.

All modules are public. A new solver is a file here; a model uses it in its `find_start` or as a
pseudo-measurement.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
