"""An identity with a reverse derivative only; a forward derivative through it raises an error."""

from typing import Any

import jax
from jax import Array
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxekf._support.errors import ModelError


def _refuse(*args: Any, **params: Any) -> Any:
    raise ModelError(
        "got a forward-mode derivative (jvp, jacfwd, linearize) of a filter with the closed-form"
        " adjoint, expected a reverse one (grad, vjp, jacrev); pass adjoint=False to run_filter for"
        " JAX's own derivatives in both modes"
    )


# Tangents pass through this primitive. In reverse mode it is transposed, to the identity, before it
# is ever evaluated; evaluating it means that a forward derivative is wanted.
_tangent_p = Primitive("jaxekf_reverse_only")
_tangent_p.def_impl(_refuse)
_tangent_p.def_abstract_eval(lambda aval: aval)
ad.deflinear2(_tangent_p, lambda cotangent, _: (cotangent,))
batching.defvectorized(_tangent_p)
mlir.register_lowering(_tangent_p, _refuse)


@jax.custom_jvp
def _identity(x: Array) -> Array:
    return x


@_identity.defjvp
def _(primals: Any, tangents: Any) -> Any:
    return primals[0], _tangent_p.bind(tangents[0])


def reverse_only(tree: Any) -> Any:
    """The same tree; a forward derivative through it raises `ModelError`."""
    return jax.tree.map(
        lambda a: _identity(a) if jax.numpy.issubdtype(a.dtype, jax.numpy.inexact) else a, tree
    )
