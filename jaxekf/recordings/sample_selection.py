"""Selection, counting and holding of one stream's samples before they are laid out in time."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxekf.recordings.accounts import Intake
from jaxekf.recordings.types import Samples, Times, period_ns


def visible(samples: Samples) -> NDArray[np.bool_]:
    """(N,) samples of which some row is visible."""
    mask = samples.mask
    return np.asarray(mask.any(axis=tuple(range(1, mask.ndim))))


def first_visible(samples: Samples) -> Any:
    """The value of the first sample of which some row is visible; None where there is none."""
    at = np.flatnonzero(visible(samples))
    if at.size == 0:
        return None
    return jax.tree.map(lambda a: np.asarray(a)[at[0]], samples.value)


def count(samples: Samples, start: int, end: int) -> dict[str, int]:
    """The account of a stream in a run from `start` to `end`, ns."""
    inside = (samples.time_ns >= start) & (samples.time_ns <= end)
    if samples.points is not None:
        rows = samples.mask.shape[1] // samples.copies
        groups = samples.mask.reshape(len(samples.mask), samples.copies, rows).any(axis=2)
        seen, there = groups.sum(axis=1), samples.points
        return {
            "read": int(there.sum()),
            "fed": int(seen[inside].sum()),
            "masked": int((there - seen)[inside].sum()),
            "dropped_outside_run": int(there[~inside].sum()),
        }
    shown = visible(samples)
    account = {
        "read": len(samples.time_ns) + samples.thinned,
        "fed": int((inside & shown).sum()),
        "masked": int((inside & ~shown).sum()),
        "dropped_outside_run": int((~inside).sum()),
    }
    return account | ({"dropped_thinned": samples.thinned} if samples.thinned else {})


def of_rows(
    account: dict[str, int], samples: Samples, intake: Mapping[str, Intake], start: int, end: int
) -> dict[str, int]:
    """The account of a stream in rows of the source that it was read from, where that is known.

    Rows that are no samples come on top: those dropped while reading, and those masked that the stream
    leaves out. A marker that has no row in a frame does not count there.
    """
    stream = intake.get(samples.origin[0]) if samples.origin else None
    if stream is None:
        return account
    account = dict(account)
    if len(samples.origin) > 1:
        part = stream.parts.get(samples.origin[1])
        if part is None:
            return account | {"read": 0, "masked": 0, "dropped_outside_run": 0}
        taken = part.absent - samples.latency_ns
        inside = int(((taken >= start) & (taken <= end)).sum())
        account["masked"] -= inside
        account["dropped_outside_run"] -= len(taken) - inside
        dropped = {"repeated": len(part.dropped)} if len(part.dropped) else {}
        rows = part.rows
    else:
        dropped = {name: reason.count for name, reason in stream.dropped.items()}
        rows = stream.rows
        # Masked rows that an input, which cannot be masked, leaves out.
        account["masked"] += rows - sum(dropped.values()) - account["read"]
    for name, number in dropped.items():
        account[f"dropped_{name}"] = number
    return account | {"read": rows}


def take(samples: Samples, chosen: NDArray[Any]) -> Samples:
    """The chosen samples, by index or mask."""

    def pick(tree: Any) -> Any:
        return jax.tree.map(lambda a: np.asarray(a)[chosen], tree)

    return replace(
        samples,
        time_ns=samples.time_ns[chosen],
        value=pick(samples.value),
        mask=samples.mask[chosen],
        aux=pick(samples.aux),
        points=pick(samples.points),
        at_limit=pick(samples.at_limit),
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
