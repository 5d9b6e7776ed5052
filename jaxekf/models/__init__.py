"""The models that come with the package, by name.

Choose `loose` for a tracker that reports attitudes, `loose_pose` for one that reports poses, `tight`
for single markers, `visual` for landmarks in images, and `marg` without a tracker; each module begins
with its states, sensors, parameters and source. `inertial` is what the pose models share. A new model
is a file here: every `Model` of a public module is found.
"""

import importlib
import os
import sys
from collections.abc import Sequence
from pkgutil import iter_modules

from jaxekf._support.errors import ModelError
from jaxekf.filtering.model import Model
from jaxekf.filtering.model_origin import remember
from jaxekf.recordings.types import Recording


def adapted(model: Model, recordings: Sequence[Recording]) -> Model:
    """The model as these recordings need it, with a sensor for each marker for instance."""
    return model if model.adapt is None else model.adapt(recordings)


def get_model(model: str | Model) -> Model:
    """A model by name.

    Parameters
    ----------
    model
        Name of a model here, ``module:attribute`` of a model elsewhere (imported as from the current
        directory), or a `Model`.

    Raises
    ------
    ModelError
        If there is no such model.

    Examples
    --------
    >>> import jaxekf
    >>> model = jaxekf.get_model("loose")
    >>> model.name, model.error_dim, [sensor.name for sensor in model.sensors]
    ('loose', 6, ['optical'])
    """
    if isinstance(model, Model):
        return model
    if not isinstance(model, str):
        raise ModelError(
            f"got a model of type {type(model).__name__}, expected a jaxekf.Model or a name; choose one of"
            f" {sorted(REGISTRY)}"
        )
    if model in REGISTRY:
        return REGISTRY[model]
    if ":" not in model:
        raise ModelError(
            f"got the model '{model}', expected one of {sorted(REGISTRY)} or module:attribute;"
            " check the spelling"
        )
    module_name, attribute = model.split(":", 1)
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        found = getattr(importlib.import_module(module_name), attribute)
    except Exception as error:  # a user's module may raise anything while it is imported
        raise ModelError(
            f"got the model '{model}', expected an importable module with that attribute"
            f" ({type(error).__name__}: {error}); check the name, the current directory, and the module"
        ) from error
    if not isinstance(found, Model):
        raise ModelError(
            f"got '{model}' of type {type(found).__name__}, expected a jaxekf.Model;"
            " name the attribute that holds the model"
        )
    remember(found, get_model, model)
    return found


def _all_models() -> dict[str, Model]:
    names = (module.name for module in iter_modules(__path__) if not module.name.startswith("_"))
    modules = [importlib.import_module(f"{__name__}.{name}") for name in names]
    found = [one for module in modules for one in vars(module).values() if isinstance(one, Model)]
    for model in found:
        remember(model, get_model, model.name, replace_known=True)
    return {model.name: model for model in sorted(found, key=lambda model: model.name)}


REGISTRY = _all_models()
"""Models by name."""
