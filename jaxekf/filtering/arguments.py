"""Arguments of the filter with float64 leaves: converted, or refused in a sentence."""

from typing import Any

import jax
import numpy as np

from jaxekf._support import arrays
from jaxekf._support.compilation import require_float64
from jaxekf._support.errors import ArgumentError
from jaxekf.filtering.model import Belief, Model, Parameters
from jaxekf.filtering.steps import Steps

_SECTIONS = ("noise", "calibration", "initial")


def for_filter(
    model: Model, params: Parameters, belief: Belief, steps: Steps
) -> tuple[Parameters, Belief, Steps]:
    """Arguments of a filter with float64 leaves; flags and whole numbers stay what they are.

    Raises
    ------
    ArgumentError
        A leaf is not an array of numbers.
    PrecisionError
        JAX is not set to float64.
    """
    require_float64()
    arrays.need(belief, Belief, "belief", "jaxekf.initial_belief")
    arrays.need(steps, Steps, "steps", "jaxekf.timeline.build(...).steps")
    params = parameters(model, params, check_shapes=False)
    return params, float_leaves("belief", belief), float_leaves("steps", steps)


def float_leaves(name: str, tree: Any) -> Any:
    """A pytree, concrete or traced, with float64 leaves; flags and whole numbers stay what they are."""

    def leaf(path: Any, value: Any) -> Any:
        kept = (
            isinstance(value, bool | int) or getattr(value, "dtype", np.dtype(float)).kind in "biu"
        )
        return value if kept else _as_float(f"{name}{jax.tree_util.keystr(path)}", value)

    return jax.tree_util.tree_map_with_path(leaf, tree, is_leaf=lambda node: isinstance(node, list))


def parameters(model: Model, params: Parameters, *, check_shapes: bool = True) -> Parameters:
    """Parameters of a model with float64 leaves; a leaf may be a list.

    Parameters
    ----------
    model
        The model; its own parameters give the names.
    params
        The parameters, concrete or traced.
    check_shapes
        Whether a leaf of the noise must have the shape (), (d,) or (d, d) for its d axes, and one of the
        calibration that of the model.

    Raises
    ------
    ArgumentError
        They are those of another model, or a leaf is not an array of numbers of a possible shape.
    """
    arrays.need(params, Parameters, "params", "model.parameters._replace(noise=...)")
    changes: dict[str, Any] = {}
    for section in _SECTIONS:
        default, given = getattr(model.parameters, section), getattr(params, section)

        def leaf(path: Any, _: Any, value: Any, section: str = section) -> Any:
            return _as_float(f"params.{section}{jax.tree_util.keystr(path)}", value)

        try:
            changes[section] = jax.tree_util.tree_map_with_path(leaf, default, given)
        except ArgumentError:
            raise
        except (TypeError, ValueError) as error:
            raise _other_model(model, section, given) from error
    for section in ("setup", "truth"):
        changes[section] = jax.tree.map(
            lambda a, section=section: _as_float(f"params.{section}", a), getattr(params, section)
        )
    if check_shapes:
        _check_shapes(model, changes)
    return Parameters(**changes)


def _other_model(model: Model, section: str, given: Any) -> ArgumentError:
    default = getattr(model.parameters, section)
    got = f"{section} of type {type(given).__name__}"
    fields = ", ".join(getattr(default, "_fields", ())) or "no entries"
    return ArgumentError(
        f"params: got {got}, expected {type(default).__name__} of model '{model.name}' ({fields}); try"
        f" model.parameters.{section}._replace(...)"
    )


def _check_shapes(model: Model, sections: dict[str, Any]) -> None:
    """Raise `ArgumentError` for noise or calibration of an impossible shape."""
    for section in ("noise", "calibration"):
        leaves = jax.tree_util.tree_flatten_with_path(sections[section])[0]
        defaults = jax.tree.leaves(getattr(model.parameters, section))
        dims = jax.tree.leaves(model.noise_dims) if section == "noise" else [None] * len(leaves)
        for (path, value), default, d in zip(leaves, defaults, dims, strict=True):
            known = {np.shape(default)} | (set() if d is None else {(), (d,), (d, d)})
            if value.shape not in known:
                expected = " or ".join(str(shape) for shape in sorted(known, key=len))
                raise ArgumentError(
                    f"params: got {section}{jax.tree_util.keystr(path)} of shape {value.shape}, expected"
                    f" {expected}; try one of these shapes"
                )


def _as_float(name: str, value: Any) -> Any:
    """A leaf as float64; a traced one stays traced."""
    refuse = arrays.argument(name)
    if not isinstance(value, jax.Array):
        return arrays.floats(value, refuse)
    if value.dtype.kind not in "fiu":
        raise refuse(f"values of type {value.dtype}", "real numbers", "converting them")
    return value if value.dtype == np.float64 else value.astype(np.float64)
