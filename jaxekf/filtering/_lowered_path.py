"""A model made ready for steps that are linearised about a path that is given, exactly.

The filter linearises at its own estimates, in charts where it stands; whoever minimises over a whole run
linearises everything about one path, and needs the derivatives of the residuals themselves.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import jax
from jax import Array

from jaxekf.filtering import _linearisation as linearisation
from jaxekf.filtering._lowered_model import (
    Measurement,
    Piece,
    Transition,
    both_jacobians,
    measurement,
    noise_of,
    patterns_of,
    specified,
)
from jaxekf.filtering.model import Model
from jaxekf.geometry import manifold


@dataclass(frozen=True, eq=False)
class AboutSystem:
    """A model made ready for steps that are linearised about a given path instead of the filter's own."""

    model: Model
    transition: Transition
    """Its piece is ``(params, x, after, w, u, dt)`` to how far ``after`` is missed, and the unknown bands
    of F and G."""
    measurements: dict[str, Measurement]
    start: Piece
    """``(params, first, x)`` to the error of ``x`` counted from ``first``, and the derivative of one
    counted from ``x`` by it."""
    move: Piece
    """``(params, x, delta)`` to ``x`` moved and the reset Jacobian."""

    def prepare(self, params: Any) -> dict[str, tuple[Array, ...]]:
        """What the steps need of the parameters, for one run."""
        found = {f"sensor {name}": m.piece.prepare(params) for name, m in self.measurements.items()}
        found["transition"] = self.transition.piece.prepare(params)
        found["process noise"] = self.transition.sigma.prepare(params)
        found["start"] = self.start.prepare(params)
        found["move"] = self.move.prepare(params)
        return found


def build(model: Model, params: Any, x: Any, u: Any, rows: dict[str, Any]) -> AboutSystem:
    """As `system.build`."""
    return _build(model, *specified(params, x, u, rows))


@lru_cache(maxsize=64)
def _build(model: Model, leaves: Any, tree: Any) -> AboutSystem:
    spec = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*leaf) for leaf in leaves])
    params, x, u, rows = spec
    dtype = manifold.dtype_of(x)
    delta = jax.ShapeDtypeStruct((model.error_dim,), dtype)

    def start(params: Any, first: Any, x: Any) -> Any:
        away = manifold.local(model.space, first, x)
        return away, manifold.reset_jacobian(model.space, away)

    def move(params: Any, x: Any, delta: Array) -> Any:
        moved = manifold.retract(model.space, x, delta)
        if model.project is not None:
            moved = model.project(moved)
        return moved, manifold.reset_jacobian(model.space, delta)

    return AboutSystem(
        model,
        _transition(model, params, x, u),
        {
            name: measurement(
                model, model.sensor(name), params, x, u, sample, linearisation.residual_blocks
            )
            for name, sample in rows.items()
        },
        Piece(start, params, x, x),
        Piece(move, params, x, delta),
    )


def _transition(model: Model, params: Any, x: Any, u: Any) -> Transition:
    dt = jax.ShapeDtypeStruct((), manifold.dtype_of(x))
    sigma, diagonal = noise_of(model.process_noise, params, dt)
    w = jax.ShapeDtypeStruct(jax.eval_shape(model.process_noise, params, dt).shape[:1], dt.dtype)
    linearised = partial(linearisation.between_blocks, model)
    spec = (params, x, x, w, u, dt)
    state, noise = patterns_of(lambda *args: both_jacobians(linearised(*args)), *spec)

    def step(*args: Any) -> Any:
        found = linearised(*args)
        return found.missed, found.f.bands(state), found.g.bands(noise)

    density = Piece(lambda *args: [sigma(*args)], params, dt)
    return Transition(Piece(step, *spec), density, state, noise, diagonal)
