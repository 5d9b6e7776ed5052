"""Rotations, state spaces, the pinhole camera, attitude from vectors, and small linear algebra, in JAX.

All modules are public. A new manifold is a subclass of `manifold.Manifold`, in that file or in one
beside it; a new closed-form solver is a file of its own.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
