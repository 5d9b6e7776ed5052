"""How a model came about, so that it can be pickled although its functions may not.

A model is compared by identity, and compiled programs belong to it: an unpickled one is the same object as
the one that its process has.
"""

import pickle
import sys
from collections.abc import Callable
from dataclasses import fields
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

from jaxekf._support.errors import ModelError

P = ParamSpec("P")
T = TypeVar("T")
_ORIGIN = "_origin"


def remember(
    model: Any, function: Callable[..., Any], *args: Any, replace_known: bool = False
) -> None:
    """Note that ``function(*args)`` gives this model, unless an origin is known."""
    if replace_known or _ORIGIN not in vars(model):
        object.__setattr__(model, _ORIGIN, (function, args))


def remembered(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator of a function that makes models: the same one for the same arguments, with its origin."""
    cached: Any = lru_cache(maxsize=64)(function)

    @wraps(function)
    def made(*args: P.args, **named: P.kwargs) -> T:
        model = cached(*args, **named)
        if not named:
            remember(model, made, *args)
        return model

    return made


def reduced(model: Any) -> tuple[Any, ...]:
    """The value of `Model.__reduce__`.

    Raises
    ------
    ModelError
        Some of its functions cannot be pickled, and no module holds the model.
    """
    if _ORIGIN in vars(model):
        return vars(model)[_ORIGIN]
    for name, module in list(sys.modules.items()):
        for attribute, value in list(getattr(module, "__dict__", {}).items()):
            if value is model:
                return _held, (name, attribute)
    values = tuple(getattr(model, field.name) for field in fields(model))
    for field, value in zip(fields(model), values, strict=True):
        try:
            pickle.dumps(value)
        except Exception as error:  # a user's object may raise anything
            raise ModelError(
                f"model '{model.name}': got a {field.name} that cannot be pickled ({error}), expected"
                " functions of a module; assign the model to a name of a module that can be imported, or"
                " write functions with def outside of functions"
            ) from error
    return type(model), values


def _held(module: str, attribute: str) -> Any:
    """The model that a module holds."""
    __import__(module)
    return getattr(sys.modules[module], attribute)
