"""A model with another treatment of outliers: gates, robust weights, or none."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, get_args

from jaxekf._support.deprecations import renamed_arguments
from jaxekf._support.errors import ModelError
from jaxekf.filtering.model import Model, Sensor
from jaxekf.filtering.model_origin import remembered
from jaxekf.models import get_model
from jaxekf.recordings.types import Recording

OutlierMethod = Literal["gate", "huber", "student", "none"]
OUTLIER_METHODS: tuple[str, ...] = get_args(OutlierMethod)
_GATE = 0.999


@renamed_arguments(means="outlier_method")
def robust(model: str | Model, outlier_method: OutlierMethod, probability: float = _GATE) -> Model:
    """The model with one outlier method for all of its sensors.

    Parameters
    ----------
    model
        The model or its name.
    outlier_method
        ``gate`` rejects samples outside a chi-square bound. ``huber`` and ``student`` reject nothing but
        give samples less weight the larger their innovation is, so that none moves the estimate far.
        With each of these the belief is reset if all samples contradict it for
        `Model.gate_reset_after_s`. ``none`` gives every sample full weight.
    probability
        Probability with which a Gaussian sample passes the gate.

    Returns
    -------
    The same object for the same arguments.

    Raises
    ------
    ModelError
        For an unknown method, or a probability that is not between 0 and 1.

    Examples
    --------
    >>> import jaxekf
    >>> model = jaxekf.robust("loose", "huber")
    >>> [(sensor.name, sensor.weighting) for sensor in model.sensors]
    [('optical', 'huber')]
    """
    if outlier_method not in OUTLIER_METHODS or not 0.0 < probability < 1.0:
        raise ModelError(
            f"got '{outlier_method}' with a probability of {probability}, expected one of"
            f" {', '.join(OUTLIER_METHODS)} with one between 0 and 1; choose an outlier method"
        )
    return _robust(get_model(model), outlier_method, probability)


def outlier_method(sensor: Sensor) -> str:
    """The outlier method of a sensor, one of `OUTLIER_METHODS`."""
    one = sensor.single_group or sensor
    return str(one.weighting or sensor.weighting or ("gate" if one.gate or sensor.gate else "none"))


@remembered
def _robust(model: Model, outlier_method: OutlierMethod, probability: float) -> Model:
    is_weight = outlier_method in ("huber", "student")
    changes: dict[str, Any] = {
        "gate": probability if outlier_method == "gate" else None,
        "weighting": outlier_method if is_weight else None,
    }
    sensors = tuple(_changed(sensor, changes) for sensor in model.sensors)
    adapt = model.adapt
    if adapt is not None:
        adapt = partial(_adapted, adapt, outlier_method, probability)
    return replace(model, sensors=sensors, adapt=adapt)


def _changed(sensor: Sensor, changes: dict[str, Any]) -> Sensor:
    single_group = None if sensor.single_group is None else replace(sensor.single_group, **changes)
    return replace(sensor, single_group=single_group, **changes)


def _adapted(
    adapt: Any, outlier_method: OutlierMethod, probability: float, recordings: Sequence[Recording]
) -> Model:
    return _robust(adapt(recordings), outlier_method, probability)
