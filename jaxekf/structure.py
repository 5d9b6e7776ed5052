"""Which numbers of a matrix are the same whatever the state, found from the operations that make it.

A Jacobian is mostly zeros and ones: parts of a state that only walk, sensors that read one part of it.
Its operations are followed number by number: zero times anything is zero, and what an operation is not
understood to leave constant counts as unknown. So what is called known here is known for every state,
input and parameter; nothing is sampled and nothing needs to be declared.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from jaxekf import scalars
from jaxekf.graph import Numbers, is_constant
from jaxekf.programs import Program


class Known(NamedTuple):
    """What is known of an array: `value` where `known`, anything elsewhere."""

    value: NDArray[Any]
    known: NDArray[np.bool_]

    def is_zero(self) -> NDArray[np.bool_]:
        """Where the array is zero, whatever it was computed from."""
        return self.known & (self.value == 0)


def find(program: Program) -> Any:
    """The tree of outputs of `program`, each as `Known`."""
    return jax.tree.unflatten(program.tree, map(_known, scalars.numbers_of(program)[0]))


def _known(numbers: Numbers) -> Known:
    flat = list(numbers.ravel())
    known = np.array([is_constant(n) for n in flat], bool)
    value = np.zeros(len(flat), flat[0].dtype if flat else float)
    value[known] = [n for n in flat if is_constant(n)]
    return Known(value.reshape(numbers.shape), known.reshape(numbers.shape))
