"""What is done to the samples of one stream before they are laid out in time: chosen, counted, held."""

from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxekf.recording import Samples, Times, period_ns


def visible(samples: Samples) -> NDArray[np.bool_]:
    """(N,) samples of which some row is visible."""
    return np.asarray(samples.mask.reshape(len(samples.mask), -1).any(axis=1))


def first_visible(samples: Samples) -> Any:
    """The value of the first sample of which some row is visible; None where there is none."""
    at = np.flatnonzero(visible(samples))
    if at.size == 0:
        return None
    return jax.tree.map(lambda a: np.asarray(a)[at[0]], samples.value)


def count(samples: Samples, start: int, end: int) -> dict[str, int]:
    """The account of a stream in a run from `start` to `end`, ns."""
    inside = (samples.time_ns >= start) & (samples.time_ns <= end)
    shown = visible(samples)
    return {
        "read": len(samples.time_ns),
        "fed": int((inside & shown).sum()),
        "masked": int((inside & ~shown).sum()),
        "dropped_outside_run": int((~inside).sum()),
    }


def take(samples: Samples, chosen: NDArray[Any]) -> Samples:
    """The chosen samples, by index or mask."""

    def pick(tree: Any) -> Any:
        return jax.tree.map(lambda a: np.asarray(a)[chosen], tree)

    return Samples(
        samples.time_ns[chosen],
        pick(samples.value),
        samples.mask[chosen],
        pick(samples.aux),
        samples.latency_ns,
    )


def cut(samples: Samples, start: int, end: int) -> Samples:
    """The samples from `start` to `end`, ns, both included."""
    return take(samples, (samples.time_ns >= start) & (samples.time_ns <= end))


def hold(
    samples: dict[str, Samples], leader: str, account: dict[str, dict[str, int]]
) -> dict[str, Samples]:
    """Every stream held (zero order) on the leader's sampling instants; gaps of the leader are
    filled at its nominal period, with its own rows masked there."""
    led = samples[leader]
    grid = fill_gaps(led.time_ns)
    position = np.searchsorted(led.time_ns, grid, side="right") - 1
    present = led.time_ns[position] == grid
    held = {leader: take(led, position)}
    held[leader] = Samples(
        grid, held[leader].value, held[leader].mask & present[:, None], held[leader].aux
    )
    for name, stream in samples.items():
        if name == leader:
            continue
        last = np.searchsorted(stream.time_ns, grid, side="right") - 1
        taken = take(stream, np.maximum(last, 0))
        # A stream that has stopped is not held for ever, but for a period and a half of the slower.
        oldest = 1.5 * max(period_ns(grid), period_ns(stream.time_ns))
        fresh = (last >= 0) & (grid - taken.time_ns <= oldest)
        held[name] = Samples(grid, taken.value, taken.mask & fresh[:, None], taken.aux)
        used = len(np.unique(last[visible(held[name])]))
        account[name]["dropped_by_holding"] = account[name]["fed"] - used
        account[name]["fed"] = used
    return held


def fill_gaps(time_ns: Times) -> Times:
    """Times with every gap longer than 1.5 nominal periods filled at the nominal period."""
    period = period_ns(time_ns)
    if period == 0:
        return time_ns
    pieces = [time_ns]
    steps = np.diff(time_ns)
    for i in np.flatnonzero(steps > 1.5 * period):
        missing = round(steps[i] / period)
        pieces.append(time_ns[i] + period * np.arange(1, missing, dtype=np.int64))
    return np.unique(np.concatenate(pieces))
