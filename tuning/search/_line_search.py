"""Line search along the direction of an optimiser, one evaluation at a time."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
import optax

from jaxekf.recordings.types import Floats

_MOST_REJECTIONS = 10
_SMALL_GAIN = 1e-5
_LONGEST_STEP = 1.0
_FIRST_STEP = 0.1
_WORTH = 30.0
"""Gain that the next step must promise after small ones, as a multiple of `LineSearch.least`."""
_MOST_SMALL_GAINS = 6
_LBFGS = optax.chain(optax.scale_by_lbfgs(), optax.scale(-1.0))
# Not compiled as a whole it is some eighty programs, two of which are compiled anew at each step.
_lbfgs_begin, _lbfgs_step = jax.jit(_LBFGS.init), jax.jit(_LBFGS.update)
_STATE = ("candidate", "accepted", "value", "gradient", "change", "rejections", "small_gains")


class LineSearch:
    """The last accepted point of a search, and the next candidate.

    The default is L-BFGS with backtracking: optax gives the direction, a step is halved until the
    objective falls, and no number moves by more than `_LONGEST_STEP` (an e-fold for a logarithm). The
    steps of another optax optimiser are taken as they are, unless they are not finite. A `direction`, a
    function of the accepted point and its gradient, replaces that of L-BFGS. Two gains in a row of less
    than `least`, by default a small part of the value, end the search unless the next step promises more.

    Only the optimiser's own arithmetic is compiled: the rest, of a few numbers, is done on the host.
    """

    def __init__(
        self,
        free: Floats,
        optimiser: optax.GradientTransformation | None,
        least: float | None = None,
        direction: Callable[[Floats, Floats], Floats] | None = None,
    ) -> None:
        self.least, self.direction = least, direction
        self.monotone = optimiser is None
        begin, self._step = (
            (_lbfgs_begin, _lbfgs_step) if optimiser is None else (optimiser.init, optimiser.update)
        )
        free = np.asarray(free)
        self.state = begin(jax.device_put(free))
        self.candidate = self.accepted = free
        self.value = float("inf")
        self.gradient = self.change = np.zeros_like(free)
        self.rejections = self.small_gains = 0

    def move(self, value: float, gradient: Floats, finite: bool) -> str:
        """Accept or reject the candidate and choose the next; return a reason to stop or ''."""
        if not finite or (self.monotone and not self._falls(value)):
            self.rejections += 1
            if self.rejections >= _MOST_REJECTIONS:
                return (
                    "no step along the gradient lowers the objective any more"
                    if finite
                    else f"{_MOST_REJECTIONS} steps in a row failed"
                )
            self.change = (0.5 if finite else 0.25) * self.change
            self.candidate = self.accepted + self.change
            return ""
        relative = _SMALL_GAIN * max(abs(value), _SMALL_GAIN)
        small = self.value - value < (relative if self.least is None else self.least)
        self.small_gains = self.small_gains + 1 if small and self.monotone else 0
        self.rejections = 0
        first = not np.isfinite(self.value)
        self.accepted, self.value, self.gradient = self.candidate, value, gradient
        if self.direction is None:
            given = jax.device_put((gradient, self.state, self.accepted))
            update, self.state = self._step(*given)
            self.change = np.asarray(update)
        else:
            self.change = self.direction(self.accepted, gradient)
        if self.monotone:
            if float(self.change @ gradient) >= 0.0:
                self.change = -gradient
            longest = float(np.max(np.abs(self.change)))
            if longest == 0.0 or self._at_the_end(gradient):
                return "converged"
            # The first direction of L-BFGS has the size of the gradient, which has no scale.
            shortest = _FIRST_STEP if self.direction is None and first else 0.0
            self.change = self.change * (min(max(longest, shortest), _LONGEST_STEP) / longest)
        self.candidate = self.accepted + self.change
        return ""

    def _at_the_end(self, gradient: Floats) -> bool:
        """Whether two steps gained little and the next, scaled by the curvature, would not gain much."""
        if self.small_gains < 2:
            return False
        expected = -0.5 * float(self.change @ gradient)
        worth = np.inf if self.least is None else _WORTH * self.least
        return expected < worth or self.small_gains >= _MOST_SMALL_GAINS

    def state_dict(self) -> dict[str, Any]:
        """State as arrays by name."""
        found: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in _STATE}
        return found | arrays_of(self.state, "state_")

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from the state that `state_dict` returned."""
        for name in _STATE:
            value = state[name]
            plain = {"value": float, "rejections": int, "small_gains": int}
            setattr(self, name, plain[name](value) if name in plain else np.asarray(value))
        self.state = tree_of(state, "state_", self.state)

    def _falls(self, value: float) -> bool:
        """Armijo's condition of sufficient decrease."""
        if not np.isfinite(self.value):
            return True
        return value <= self.value + 1e-4 * float(self.change @ self.gradient)


def arrays_of(tree: Any, prefix: str) -> dict[str, Any]:
    """Leaves of a pytree as arrays by name: the prefix and a number."""
    return {f"{prefix}{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}


def tree_of(arrays: Mapping[str, Any], prefix: str, like: Any) -> Any:
    """The pytree that `arrays_of` was given, in the structure and types of another."""
    leaves, structure = jax.tree.flatten(like)
    types = [np.asarray(leaf).dtype for leaf in leaves]
    again = [np.asarray(arrays[f"{prefix}{i}"], kind) for i, kind in enumerate(types)]
    return jax.tree.unflatten(structure, again)
