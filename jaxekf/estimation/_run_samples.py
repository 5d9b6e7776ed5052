"""Samples of one run's sensors and input, checked before they are laid out in time."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.filtering.model import Sensor
from jaxekf.recordings.gaps import LONGEST_INPUT_GAP_S, longest_ns
from jaxekf.recordings.sample_selection import take, visible
from jaxekf.recordings.types import NANOSECONDS, Recording, Samples

_EXTRAPOLATED_S = 0.5
"""A note names longer intervals without any sample."""


def read_sensor(sensor: Sensor, recording: Recording) -> Samples:
    """The samples of a sensor, with a mask of rows and finite auxiliary data."""
    if sensor.source is None:
        raise ModelError(
            f"sensor '{sensor.name}' got a recording, expected arrays because it names no source;"
            " give it a source"
        )
    samples = sensor.source(recording)
    mask = np.asarray(samples.mask)
    if samples.at_limit is not None:
        mask = mask & ~samples.at_limit.reshape(-1, *[1] * (mask.ndim - 1))
    if mask.ndim == 1:
        mask = np.repeat(mask[:, None], sensor.rows, axis=1)
    aux = jax.tree.map(lambda a: _inert_aux(sensor.name, a, mask, recording), samples.aux)
    return replace(samples, mask=mask, aux=aux)


def _inert_aux(name: str, values: Any, mask: NDArray[np.bool_], recording: Recording) -> Any:
    """Auxiliary data, with a finite value in place of NaN in masked samples.

    The model's functions are evaluated at masked samples too, where a NaN would spoil the gradient.
    """
    values = np.array(values)
    known = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    shown = mask.any(axis=1)
    bad = np.flatnonzero(shown & ~known)
    if bad.size:
        raise RecordingError(
            recording.path or recording.name,
            f"auxiliary data of {name} that is not finite at sample {int(bad[0])}",
            "finite data for every visible sample",
            "masking the sample",
        )
    values[~known] = values[np.argmax(known)] if known.any() else 1.0
    return values


def check_input(driver: Samples, recording: Recording, name: str) -> Samples:
    """The valid samples of the input. It cannot be masked, so that a long gap is an error."""
    driver = take(driver, np.asarray(driver.mask))
    place = recording.path or recording.name
    count = len(driver.time_ns)
    if count < 2:
        raise RecordingError(
            place, f"{count} samples of {name}", "at least two", "a longer recording"
        )
    steps = np.diff(driver.time_ns)
    longest = int(np.argmax(steps))
    if steps[longest] > longest_ns(driver.time_ns):
        begin = driver.time_ns[longest] / NANOSECONDS
        raise RecordingError(
            place,
            f"a gap of {steps[longest] / NANOSECONDS:.3f} s in {name} at {begin:.6f} s",
            f"none longer than {LONGEST_INPUT_GAP_S} s",
            "cutting the run there (jaxekf.split_at_gaps), or a model that measures it (loose_rate)",
        )
    return driver


def extrapolation_notes(samples: dict[str, Samples], start: int) -> tuple[str, ...]:
    """A note on long intervals without a sample of any sensor."""
    seen = [stream.time_ns[visible(stream)] for stream in samples.values()]
    times = np.unique(np.concatenate(seen))
    steps = np.diff(times) / NANOSECONDS
    long = np.flatnonzero(steps > _EXTRAPOLATED_S)
    if not long.size:
        return ()
    at = ", ".join(f"{(times[i] - start) / NANOSECONDS:.3f}" for i in long[:5])
    return (
        f"at {at} s{' and later' if long.size > 5 else ''} there is no sample of any sensor for up to"
        f" {steps[long].max():.3f} s: there the estimate is extrapolated",
    )
