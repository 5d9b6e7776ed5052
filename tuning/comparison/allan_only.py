"""Noise by Allan deviation alone: a start with what the rest of runs or a static log tells, untuned."""

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
    """Parameters that nothing was tuned for."""

    params: Parameters
    """The start with the noise that was found, of each axis."""
    taken: tuple[str, ...]
    """Names of the noise that was found."""


def allan_only(
    model: Model, start: Parameters, runs: Sequence[Recording], log: Recording | None = None
) -> AllanOnly:
    """The start with the noise that the static heads of runs tell, each weighted by how long it rests.

    Of bias walks the run that rests longest alone decides, or a static log where there is one, for a short
    rest makes them up. What else a log tells is taken from there, and the rest from the runs. A full matrix
    of the start becomes a diagonal one where its noise is told. Raises `TuningError` where nothing rests.
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
    """Noise of a run's rest at its start; None where it does not rest."""
    try:
        return static_noise(run)
    except RecordingError:
        return None


def _pooled(model: Model, rests: Sequence[StaticNoise]) -> dict[str, Floats]:
    """Deviations (3,) by name: mean squares by the length of the rest, walks of the longest."""
    told = sorted(
        ((rest.imu.duration_s, start_for(model, rest)) for rest in rests), key=lambda one: -one[0]
    )
    found: dict[str, Floats] = {}
    for name in dict.fromkeys(name for _, start in told for name in start.taken):
        able = told[:1] if "walk" in name else told
        having = [(s, start) for s, start in able if name in start.taken]
        if having:
            values = np.array([getattr(start.params.noise, name) for _, start in having])
            square = np.average(values**2, axis=0, weights=[s for s, _ in having])
            found[name] = np.sqrt(square)
    return found


def _like(value: Floats, before: Any) -> Any:
    """Deviations as a diagonal factor where the start has a full one."""
    return jnp.diag(jnp.asarray(value)) if jnp.ndim(before) == 2 else jnp.asarray(value)
