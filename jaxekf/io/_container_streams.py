"""Arrays of a file as streams of a recording, their rows judged as those of any source are."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jaxekf.io import _camera as camera_storage
from jaxekf.io._frame_rows import NAMES, bad_name
from jaxekf.recordings import facts, screening
from jaxekf.recordings.accounts import Indices, Intake, Part, Place
from jaxekf.recordings.types import Camera, Encoder, Imu, Markers, Optical, Times


def optical(place: Place, group: Mapping[str, Any], sort: bool) -> tuple[Optical, Intake]:
    arm = group.get("p_body_tool")
    if arm is not None:
        arm = facts.finite_vector(arm, 3, place.path, "p_body_tool")
    return screening.optical(
        place,
        group["time_ns"],
        group["q_ref_body"],
        group.get("position"),
        error=_reported(place, group, "error", least=0.0),
        hidden=~group["valid"] if "valid" in group else None,
        sort=sort,
        p_body_tool=arm,
        latency_ns=int(group.get("latency_ns", 0)),
    )


def imu(place: Place, group: Mapping[str, Any], sort: bool) -> tuple[Imu, Intake]:
    streams = [group.get(key) for key in ("accelerometer", "magnetometer")]
    return screening.imu(place, group["time_ns"], group["gyroscope"], *streams, sort=sort)


def encoder(place: Place, group: Mapping[str, Any], sort: bool) -> tuple[Encoder, Intake]:
    return screening.encoder(
        place,
        group["time_ns"],
        group["q_ref_body"],
        group.get("position"),
        scored=group.get("scored"),
        hidden=~group["valid"] if "valid" in group else None,
        sort=sort,
    )


def markers(place: Place, group: Mapping[str, Any], sort: bool) -> tuple[Markers, Intake]:
    """The frames; of the account each marker in each frame is a row, by the number of its frame."""
    position, names = group["position"], group["names"]
    _check_names(place, names)
    for i, point in enumerate(group["p_body_marker"]):
        facts.finite_vector(point, 3, place.path, f"p_body_marker[{i}]")
    said = group.get("visible", np.ones(position.shape[:2], bool))
    rows = [position, said] + [group[key] for key in ("quality", "error") if key in group]
    time, order, account = _frames(place, group["time_ns"], rows, names, sort)
    each, count = np.repeat(np.arange(len(order)), len(names)), len(names)
    seen, account = screening.judge_markers(
        place.take(order).take(each),
        time[each],
        position[order].reshape(-1, 3),
        np.tile(np.arange(count), len(order)),
        account,
        seen=said[order].reshape(-1) if "visible" in group else None,
    )
    reported = {
        key: values if values is None else values[order]
        for key, values in (
            ("quality", _reported(place, group, "quality")),
            ("error", _reported(place, group, "error", least=0.0)),
        )
    }
    return Markers(
        time,
        position[order],
        seen.reshape(len(order), count),
        names,
        group["p_body_marker"],
        quality_min=facts.finite_number(
            float(group.get("quality_min", 0.0)), place.path, "quality_min"
        ),
        latency_ns=int(group.get("latency_ns", 0)),
        **reported,
    ), account


def camera(place: Place, group: Mapping[str, Any], sort: bool) -> tuple[Camera, Intake]:
    """The images; of the account each landmark in each image is a row, by the number of its image."""
    pixel, names, sigma = group["pixel"], group["names"], group.get("sigma")
    camera_storage.check_names(place, names)
    camera_storage.check_places(place, group["p_ref_landmark"])
    camera_storage.check_sigma(place, sigma)
    said = camera_storage.optics(group, place.path)
    shown = group.get("visible", np.ones(pixel.shape[:2], bool))
    rows = [pixel, shown] if sigma is None else [pixel, shown, sigma]
    slowest = screening.SLOWEST_TRACKER_S
    time, order, account = _frames(place, group["time_ns"], rows, names, sort, slowest)
    each = np.repeat(np.arange(len(order)), len(names))
    found, account = screening.judge_points(
        place.take(order).take(each),
        time[each],
        pixel[order].reshape(-1, 2),
        account,
        seen=shown[order].reshape(-1) if "visible" in group else None,
    )
    return Camera(
        time,
        pixel[order],
        found.reshape(len(order), len(names)),
        names,
        group["p_ref_landmark"],
        sigma=None if sigma is None else sigma[order],
        latency_ns=int(group.get("latency_ns", 0)),
        **said,
    ), account


def _frames(
    place: Place,
    time: Times,
    rows: Sequence[Any],
    names: tuple[str, ...],
    sort: bool,
    slowest_s: float = screening.SLOWEST_S,
) -> tuple[Times, Indices, Intake]:
    """Of frames that hold every part: their times and which they are, in order, and the account in which
    each part of each frame is a row."""
    order, account = screening.in_order(place, time, rows, sort=sort)
    screening.check_rate(place, time[order], slowest_s)
    count = len(names)
    repeated = {
        reason: replace(r, numbers=np.repeat(r.numbers, count), time_ns=np.repeat(r.time_ns, count))
        for reason, r in account.dropped.items()
    }
    again = [r.time_ns for r in account.dropped.values()]
    parts = {name: Part(len(time), np.concatenate([*again, time[:0]]), time[:0]) for name in names}
    account = replace(account, rows=len(time) * count, dropped=repeated, parts=parts)
    return time[order], order, account


def _check_names(place: Place, names: tuple[str, ...]) -> None:
    """Each marker has a name of its own, such as a CSV file can hold."""
    bad = bad_name(names)
    if bad is not None:
        raise place.error(bad, "names", repr(names[bad]), NAMES, "renaming the marker")
    if not names:
        raise place.error(None, None, "no marker", "at least one", "naming them in names")


def _reported(place: Place, group: Mapping[str, Any], key: str, least: float = -np.inf) -> Any:
    """A tracker's own figures: finite and not below `least`, or NaN where it reported none."""
    values = group.get(key)
    if values is not None and (bad := np.argwhere(np.isinf(values) | (values < least))).size:
        at = tuple(bad[0])
        expected = "a finite number" if np.isinf(least) else f"a finite number, {least:g} or more"
        hint = "writing NaN, which means that none was reported"
        raise place.error(int(at[0]), key, f"{values[at]}", expected, hint)
    return values


def as_stored(stream: Any, group: Mapping[str, Any]) -> Any:
    """With the numbers that `save` wrote, where reading has scaled them or put others in hidden rows.

    A pose that was judged when the run was first read is not judged again: its last bits are kept.
    """
    if len(stream.time_ns) != len(group["time_ns"]):
        return stream
    kept: dict[str, Any] = {}
    if "q_ref_body" in group:
        stored = group["q_ref_body"]
        with np.errstate(invalid="ignore", over="ignore"):
            near = np.abs(np.linalg.norm(stored, axis=1) - 1.0) <= screening.NORM_ROUNDED
        as_it_is = near | ~group["valid"] if "valid" in group else near
        kept["q_ref_body"] = np.where(as_it_is[:, None], stored, stream.q_ref_body)
    if "q_body_camera" in group:
        stored = group["q_body_camera"]
        if abs(np.linalg.norm(stored) - 1.0) <= screening.NORM_ROUNDED:
            kept["q_body_camera"] = stored
    if "scored" in group:
        kept["scored"] = group["scored"]
    return replace(stream, **kept)


MAKERS = {
    "optical": optical,
    "markers": markers,
    "camera": camera,
    "imu": imu,
    "encoder": encoder,
}
"""Of a place, arrays by name and whether to sort: a stream, and what became of its rows."""
