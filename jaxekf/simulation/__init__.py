"""Simulated runs with their truth, and the demo runs that come with the package.

All modules are public. A new rig is a file here that returns a `Recording` and knows the truth.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
