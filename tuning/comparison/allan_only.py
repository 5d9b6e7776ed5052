"""Noise by Allan deviation alone: sensor noise from static intervals or a static log, without tuning."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxekf._support.errors import RecordingError, TuningError
from jaxekf.calibration.static_noise import StaticNoise, start_for, static_noise
from jaxekf.estimation.parameters import as_arrays
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Floats, Recording


class AllanOnly(NamedTuple):
    """Parameters without tuning."""

    params: Parameters
    """The start with the noise that was found, for each axis."""
    taken: tuple[str, ...]
    """Names of the noise that was found."""


def allan_only(
    model: Model, start: Parameters, runs: Sequence[Recording], log: Recording | None = None
) -> AllanOnly:
    """The start with the sensor noise of the runs' initial static intervals, weighted by their duration.

    Bias walks come from a static log if there is one, else from the longest interval alone, for a short one
    shows walks that are not there. A log replaces the runs for all noise that it has. A full matrix of the
    start becomes diagonal if its noise is replaced. Raises `TuningError` if no run begins at rest.
    """
    own = replace(model, parameters=start)
    heads = [noise for noise in map(_head, runs) if noise is not None]
    if log is None and not heads:
        raise TuningError(
            f"got none of {[run.name for run in runs]} that rests at its start, expected one or more to"
            " take noise by Allan deviation from; add runs that begin with some seconds of rest, give a"
            " static log, or leave out allan"
        )
    found = _pooled(own, heads)
    if log is not None:
        found = {name: value for name, value in found.items() if "walk" not in name}
        found |= _pooled(own, [static_noise(log)])
    noise = as_arrays(start).noise
    changes = {name: _like(value, getattr(noise, name)) for name, value in found.items()}
    return AllanOnly(
        as_arrays(start._replace(noise=noise._replace(**changes))), tuple(sorted(found))
    )


def _head(run: Recording) -> StaticNoise | None:
    """Noise of a run's initial static interval; None if it has none."""
    try:
        return static_noise(run)
    except RecordingError:
        return None


def _pooled(model: Model, rests: Sequence[StaticNoise]) -> dict[str, Floats]:
    """Deviations (3,) by name: mean squares by duration, walks of the longest interval."""
    by_duration = sorted(
        ((rest.imu.duration_s, start_for(model, rest)) for rest in rests), key=lambda one: -one[0]
    )
    found: dict[str, Floats] = {}
    for name in dict.fromkeys(name for _, start in by_duration for name in start.taken):
        able = by_duration[:1] if "walk" in name else by_duration
        having = [(s, start) for s, start in able if name in start.taken]
        if having:
            values = np.array([getattr(start.params.noise, name) for _, start in having])
            square = np.average(values**2, axis=0, weights=[s for s, _ in having])
            found[name] = np.sqrt(square)
    return found


def _like(value: Floats, before: Any) -> Any:
    """Deviations, as a diagonal factor if the start has a full one."""
    return jnp.diag(jnp.asarray(value)) if jnp.ndim(before) == 2 else jnp.asarray(value)
