"""Clock offsets, extrinsic rotations and sensor noise from data, before any filter runs.

All modules are public. A new calibration is a file here and, where it has a command, one in `jaxekf.cli`.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
