"""A model with other means against samples that do not fit."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, Literal, get_args

from jaxekf._support.errors import ModelError
from jaxekf.filtering.model import Model, Sensor
from jaxekf.models import get_model
from jaxekf.recordings.types import Recording

Means = Literal["gate", "huber", "student", "none"]
MEANS: tuple[str, ...] = get_args(Means)
_GATE = 0.999


def robust(model: str | Model, means: Means, probability: float = _GATE) -> Model:
    """The model with the same means against outliers in all of its sensors.

    ``gate`` refuses a sample outside the chi-square bound that an honest one passes with this
    `probability`; where gates have refused everything for `Model.patience_s`, the belief is widened and
    they open once. ``huber`` and ``student`` refuse nothing: a sample counts less the farther it is off, so
    that none moves the estimate far. ``none`` takes every sample in full.

    The same object for the same arguments. Raises `ModelError` for other means, or a probability that
    is not between 0 and 1.

    Examples
    --------
    >>> import jaxekf
    >>> model = jaxekf.robust("loose", "huber")
    >>> [(sensor.name, sensor.weighting) for sensor in model.sensors]
    [('optical', 'huber')]
    """
    if means not in MEANS or not 0.0 < probability < 1.0:
        raise ModelError(
            f"got '{means}' with a probability of {probability}, expected one of {', '.join(MEANS)} with"
            " one between 0 and 1; choose how outliers are met"
        )
    return _robust(get_model(model), means, probability)


@lru_cache(maxsize=64)
def _robust(model: Model, means: Means, probability: float) -> Model:
    changes: dict[str, Any] = {
        "gate": probability if means == "gate" else None,
        "weighting": means if means in ("huber", "student") else None,
    }
    sensors = tuple(_changed(sensor, changes) for sensor in model.sensors)
    adapt = None if model.adapt is None else partial(_adapted, model, means, probability)
    return replace(model, sensors=sensors, adapt=adapt)


def _changed(sensor: Sensor, changes: dict[str, Any]) -> Sensor:
    alike = None if sensor.alike is None else replace(sensor.alike, **changes)
    return replace(sensor, alike=alike, **changes)


def _adapted(
    model: Model, means: Means, probability: float, recordings: Sequence[Recording]
) -> Model:
    assert model.adapt is not None
    return _robust(model.adapt(recordings), means, probability)
