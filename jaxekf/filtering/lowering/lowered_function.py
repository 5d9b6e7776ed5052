"""A model's function, written for one run, compiled to arithmetic on the batch axis.

`jaxekf.filtering._lowered_model` makes one `LoweredFunction` of each function of a model.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf.filtering.lowering import lanes, scalar_graph, sparsity
from jaxekf.filtering.lowering.scalar_graph import Program


class LoweredFunction:
    """A function of one run in two parts: one depends on the parameters only, one is evaluated each step.

    Parameters
    ----------
    function
        ``function(params, *rest)`` of one run, no batch axis.
    params, *rest
        Shapes and types of its arguments (`jax.ShapeDtypeStruct`).
    """

    def __init__(self, function: Callable[..., Any], params: Any, *rest: Any) -> None:
        program = sparsity.simplify(scalar_graph.trace(function, params, *rest))
        count = len(jax.tree.leaves(params))
        self._parameter_program, self._step_program = scalar_graph.split_by_inputs(program, count)
        self.unsupported = lanes.unsupported(self._step_program)
        """Names of the operations of a step that have no rule on the batch axis."""
        self._evaluate = partial(_evaluate, self._step_program)
        self._vjp_program: Program | None = None
        self._evaluate_with_vjp = jax.custom_vjp(self._evaluate)
        self._evaluate_with_vjp.defvjp(
            lambda *values: (self._evaluate(*values), values), self._pullback
        )

    def prepare(self, params: Any) -> tuple[Array, ...]:
        """Evaluate the part that depends on the parameters only, for one run; JAX differentiates it."""
        return tuple(self._parameter_program.evaluate(jax.tree.leaves(params)))

    def __call__(self, prepared: Any, *rest: Any, adjoint: bool) -> Any:
        """Evaluate the function on the batch axis.

        Parameters
        ----------
        prepared
            The result of `prepare`, runs on the last axis.
        *rest
            The function's other arguments, runs on the last axis.
        adjoint
            Whether the reverse derivative is a program on the batch axis, simplified like the function.
            Without it every derivative, forward or reverse, is JAX's own.
        """
        values = (*prepared, *jax.tree.leaves(rest))
        found = (self._evaluate_with_vjp if adjoint else self._evaluate)(*values)
        return jax.tree.unflatten(self._step_program.tree, found)

    def _pullback(self, values: tuple[Any, ...], cotangents: Any) -> tuple[Any, ...]:
        inexact = [jnp.issubdtype(spec.dtype, jnp.inexact) for spec in self._step_program.inputs]
        if self._vjp_program is None:
            self._vjp_program = _vjp_program(self._step_program, inexact)
        found = iter(lanes.materialise(lanes.evaluate(self._vjp_program, [*values, *cotangents])))
        return tuple(
            next(found) if flag else np.zeros(value.shape, jax.dtypes.float0)
            for flag, value in zip(inexact, values, strict=True)
        )


def _evaluate(program: Program, *values: Array) -> list[Any]:
    return lanes.materialise(jax.tree.leaves(lanes.evaluate(program, values)))


def _vjp_program(program: Program, inexact: list[bool]) -> Program:
    """The program from inputs and cotangents of outputs to cotangents of the inexact inputs."""
    count = len(program.inputs)

    def pullback(*args: Any) -> list[Any]:
        values, cotangents = args[:count], args[count:]

        def function(*moving: Any) -> list[Any]:
            moved = iter(moving)
            full = [next(moved) if f else v for f, v in zip(inexact, values, strict=True)]
            return jax.tree.leaves(program.evaluate(full))

        moving = [v for f, v in zip(inexact, values, strict=True) if f]
        return list(jax.vjp(function, *moving)[1](list(cotangents)))

    outputs = jax.eval_shape(lambda *v: jax.tree.leaves(program.evaluate(v)), *program.inputs)
    return sparsity.simplify(scalar_graph.trace(pullback, *program.inputs, *outputs))
