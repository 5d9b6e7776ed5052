"""Rotations, state spaces, the pinhole camera, attitude from vectors, and small linear algebra.

The modules are written in JAX and differentiable, but for `host_rotation`, which is NumPy. All are public.
A new manifold is a subclass of `manifold.Manifold`, in that file or in one beside it; a new closed-form
solver is a file of its own.
"""

from jaxekf._support.lazy import attributes

# Modules are imported when they are first used.
__getattr__, __dir__ = attributes(__name__, {})
