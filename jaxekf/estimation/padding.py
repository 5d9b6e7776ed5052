"""Runs of different lengths stacked, with inert padding to a few lengths: few programs are compiled."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxekf._support.errors import ModelError
from jaxekf.estimation.timeline import Timeline
from jaxekf.filtering.steps import Knots, Rows, Steps


def stack(timelines: Sequence[Timeline], epochs: int = 0, knots: int = 0) -> Steps:
    """The steps of several runs on a new leading axis, the shorter ones padded with inert steps.

    Parameters
    ----------
    timelines
        The runs.
    epochs, knots
        Least number of epochs and of knots of the input after padding.

    Returns
    -------
    Steps
        With leading axes (runs, epochs, substeps).

    Raises
    ------
    ModelError
        There is no run.
    """
    if not timelines:
        raise ModelError("got no run to stack, expected at least one; name some recordings")
    all_steps = [timeline.steps for timeline in timelines]
    epochs = max(epochs, *(steps.dt.shape[0] for steps in all_steps))
    substeps = max(steps.dt.shape[1] for steps in all_steps)
    knots = max(knots, *(_knot_count(steps) for steps in all_steps))
    padded = [pad(steps, epochs, substeps, knots) for steps in all_steps]
    added = [steps.excess.shape[-1] for steps in padded if steps.excess is not None]
    if added:
        padded = [_with_excess(steps, added[0]) for steps in padded]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *padded)


def bucketed(timelines: Sequence[Timeline]) -> Steps:
    """As `stack`, padded to one of the lengths of `bucket`, so that few programs are compiled."""
    if not timelines:
        return stack(timelines)
    epochs = max(line.steps.dt.shape[0] for line in timelines)
    knots = max(_knot_count(line.steps) for line in timelines)
    return stack(timelines, bucket(epochs), bucket(knots))


def groups(timelines: Sequence[Timeline]) -> list[list[int]]:
    """Indices of the runs that are padded to the same length, for each length, the shortest first."""
    by_length: dict[tuple[int, int], list[int]] = {}
    for i, line in enumerate(timelines):
        epochs, substeps = line.steps.dt.shape
        by_length.setdefault((bucket(epochs), substeps), []).append(i)
    return [by_length[key] for key in sorted(by_length)]


def _knot_count(steps: Steps) -> int:
    return 0 if steps.knots is None else len(steps.knots.time)


def bucket(count: int) -> int:
    """The smallest size of at least `count` out of 1, 1.25, 1.5 and 1.75 times powers of two."""
    if count <= 4:
        return count
    power = 1 << (count.bit_length() - 1)
    return next(size for size in range(power, 2 * power + 1, power // 4) if size >= count)


def pad(steps: Steps, epochs: int, substeps: int, knots: int | None = None) -> Steps:
    """Pad the steps of one run with inert ones, which do not change its estimate.

    Parameters
    ----------
    steps
        Steps with leading axes (K, S).
    epochs
        Number of epochs; inert ones are added at the end.
    substeps
        Number of substeps of each epoch; inert ones are added in front.
    knots
        Number of knots of the input; None leaves them as they are.
    """
    more_epochs = epochs - steps.dt.shape[0]
    more_substeps = substeps - steps.dt.shape[1]

    def widen(array: Any, fill: Any, axes: int) -> Any:
        array = np.asarray(array)
        widths = [(0, more_epochs), (more_substeps, 0)][:axes] + [(0, 0)] * (array.ndim - axes)
        if fill is None:
            return np.pad(array, widths, mode="edge")
        return np.pad(array, widths, constant_values=fill)

    def rows(sensor: Rows, axes: int) -> Rows:
        return Rows(
            jax.tree.map(lambda a: widen(a, None, axes), sensor.value),
            jax.tree.map(lambda a: widen(a, None, axes), sensor.aux),
            widen(sensor.mask, False, axes),
            widen(sensor.dt, None, axes),
        )

    return Steps(
        widen(steps.time, None, 2),
        widen(steps.dt, 0.0, 2),
        widen(steps.valid, False, 2),
        _pad_knots(steps.knots, knots or 0),
        {name: rows(sensor, 2) for name, sensor in steps.fast.items()},
        {name: rows(sensor, 1) for name, sensor in steps.slow.items()},
        None if steps.excess is None else widen(steps.excess, 0.0, 2),
    )


def _with_excess(steps: Steps, size: int) -> Steps:
    """Steps that add a variance to each of `size` errors, 0 where they added none."""
    return (
        steps
        if steps.excess is not None
        else steps._replace(excess=np.zeros((*steps.dt.shape, size)))
    )


def _pad_knots(knots: Knots | None, count: int) -> Knots | None:
    """Add knots up to `count` that hold the last value, at the period of the last two, so that the input
    and its noise bandwidth at the last knot do not change."""
    if knots is None or len(knots.time) >= count:
        return knots
    apart = knots.time[-1] - knots.time[-2] if len(knots.time) > 1 else 1.0
    more = apart * np.arange(1.0, count - len(knots.time) + 1.0)
    value = np.repeat(knots.value[-1:], len(more), axis=0)
    return Knots(
        np.concatenate([knots.time, knots.time[-1] + more]),
        np.concatenate([knots.value, value]),
        np.concatenate([knots.integral, knots.integral[-1] + more[:, None] * value]),
    )
