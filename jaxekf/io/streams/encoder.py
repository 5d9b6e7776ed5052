"""Truth from a robot's joints: one joint's angle, or poses."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.io import _section_entries as section_entries
from jaxekf.io import description, units
from jaxekf.io.csv_table import (
    POSITION,
    QUATERNION,
    Sheet,
    Table,
    flags,
    numbers,
    stamps,
    whole_or_blank,
)
from jaxekf.io.schema import FLAG, Field, Option, StreamSchema, attitude, latency, validity
from jaxekf.recordings import facts, screening
from jaxekf.recordings.accounts import Intake, Place
from jaxekf.recordings.types import Encoder, Floats, from_scipy, to_scipy


def _read(table: Table, source: description.Source) -> tuple[Encoder, Intake]:
    """Attitude of the tool from a joint angle or a quaternion, in the tracker's frame.

    With an angle: ``q = q_zero exp(axis angle)`` where the axis is fixed in the body
    (``acts_on = "body"``), ``exp(axis angle) q_zero`` where it is fixed in the reference.
    ``q_optical_encoder`` turns the encoder's frame into the tracker's, and ``p_optical_encoder`` is
    its origin there, in metres. A blank position is NaN.
    """
    about, place = source.about, source.place
    if about.get("clock", "imu") not in ("imu", "tracker"):
        raise facts.wrong_entry(place, "encoder.clock", about["clock"], "'imu' or 'tracker'")
    scored, position = flags(table, "scored"), None
    frame = _fixed_rotation(about, "q_optical_encoder", place)
    if "angle" in table.columns:
        (scale,) = units.factors("encoder", ("rad",), about, place)
        length = 1.0
        angle = scale * numbers(table, ("angle",), blank=True)[:, 0]
        known = np.isfinite(angle)
        q = joint_attitude(np.where(known, angle, 0.0), about, place)
        q[~known] = np.nan
    else:
        _, length = units.factors("encoder", ("1", "m"), about, place)
        turning = section_entries.turning("encoder", about, place)
        q = turning.standard(numbers(table, turning.columns(table.columns), blank=True))
    if set(POSITION) <= set(table.columns):
        origin = about.get("p_optical_encoder", [0.0, 0.0, 0.0])
        origin = facts.finite_vector(origin, 3, place, "encoder.p_optical_encoder")
        position = frame.apply(length * whole_or_blank(table, POSITION)) + origin
    stream, account = screening.encoder(
        table.place,
        stamps(table),
        q,
        position,
        scored=scored,
        sort=source.sort,
        latency_ns=description.latency_ns(about, "encoder", place),
    )
    if "q_optical_encoder" not in about:
        # Not even turned by nothing, which would round it.
        return stream, account
    q = from_scipy(frame * to_scipy(stream.q_ref_body))
    return replace(stream, q_ref_body=q), account


def joint_attitude(angle: Floats, about: Mapping[str, Any], place: Path | str) -> Floats:
    """Quaternions (N, 4) of a joint's angles (N,) in radians, in the encoder's frame: see `read`."""
    if "axis" not in about:
        raise RecordingError(
            place, "a joint angle without an axis", "axis = [x, y, z]", "adding it under [encoder]"
        )
    axis = facts.unit_vector(about["axis"], 3, place, "encoder.axis")
    turn = Rotation.from_rotvec(angle[:, None] * axis)
    zero = _fixed_rotation(about, "q_zero", place)
    side = about.get("acts_on", "reference")
    if side not in ("reference", "body"):
        raise RecordingError(
            place, f"acts_on = '{side}'", "'reference' or 'body'", "correcting recording.toml"
        )
    return from_scipy(turn * zero if side == "reference" else zero * turn)


def _write(stream: Encoder, about: dict[str, Any]) -> tuple[Sheet, dict[str, Any]]:
    """A joint angle again where the description is of a joint, else quaternions.

    A joint angle has no place for a position or for samples that are missing: those are kept, as
    quaternions.
    """
    if "axis" in about and stream.position is None and stream.valid.all():
        columns, values = ["angle"], _joint_angle(stream, about)[:, None]
        about |= {"kind": "joint", "unit": "rad"}
    else:
        columns, values = list(QUATERNION), stream.q_ref_body
        if stream.position is not None:
            columns += POSITION
            known = np.isfinite(stream.position).all(axis=1, keepdims=True)
            values = np.c_[values, np.where(known, stream.position, np.nan)]
        values = np.where(~stream.valid[:, None], np.nan, values)
        for key in ("axis", "acts_on", "q_zero", "q_optical_encoder", "p_optical_encoder"):
            about.pop(key, None)
        unit = "1" if stream.position is None else "1, m"
        about |= {"kind": "attitude", "unit": unit} | dict(SCHEMA.described)
    if not stream.scored.all():
        columns, values = [*columns, "scored"], np.c_[values, stream.scored.astype(float)]
    about |= description.latency_entry(stream.latency_ns)
    return Sheet(columns, stream.time_ns, values), about


def _joint_angle(stream: Encoder, about: Mapping[str, Any]) -> Floats:
    """Angles (N,) about the joint's axis, without jumps of a turn."""
    frame = _fixed_rotation(about, "q_optical_encoder", facts.FILE)
    zero = _fixed_rotation(about, "q_zero", facts.FILE)
    q = frame.inv() * to_scipy(stream.q_ref_body)
    on_reference = about.get("acts_on", "reference") == "reference"
    turn = q * zero.inv() if on_reference else zero.inv() * q
    axis = facts.unit_vector(about["axis"], 3, facts.FILE, "encoder.axis")
    return np.unwrap(turn.as_rotvec() @ axis)


def _fixed_rotation(about: Mapping[str, Any], key: str, place: Path | str) -> Rotation:
    value = about.get(key, [1.0, 0.0, 0.0, 0.0])
    return to_scipy(facts.unit_vector(value, 4, place, f"encoder.{key}"))


def _screen(place: Place, arrays: Mapping[str, Any], sort: bool) -> tuple[Encoder, Intake]:
    return screening.encoder(
        place,
        arrays["time_ns"],
        arrays["q_ref_body"],
        arrays.get("position"),
        scored=arrays.get("scored"),
        hidden=~arrays["valid"] if "valid" in arrays else None,
        sort=sort,
        latency_ns=int(arrays.get("latency_ns", 0)),
    )


SCHEMA = StreamSchema(
    "encoder",
    "Truth from a robot's joints: attitude, and maybe position, in the tracker's reference frame.",
    {
        "q_ref_body": attitude(
            "attitude, in the encoder's frame; or the column `angle` of one joint, rad"
        ),
        "valid": validity(),
        "scored": Field(
            FLAG,
            unit="1",
            columns=("scored",),
            about="whether estimates are compared here (0 or 1)",
        ),
        "position": Field(
            shape=("N", 3),
            unit="m",
            frame="reference",
            columns=POSITION,
            about="position of the body's origin, in the encoder's frame",
        ),
        "latency_ns": latency(),
    },
    options={
        "clock": Option(
            '"imu" or "tracker"',
            'clock of the stamps, for scores of estimates whose clock offset is not 0 (default "imu")',
            held=False,
        ),
        "axis": Option("[x, y, z]", "axis of the joint, for the column `angle`", held=False),
        "acts_on": Option(
            '"reference" or "body"',
            'frame in which the axis is fixed (default "reference")',
            held=False,
        ),
        "q_zero": Option("[w, x, y, z]", "attitude at angle 0 (default: identity)", held=False),
        "q_optical_encoder": Option(
            "[w, x, y, z]", "rotation from encoder to tracker frame (default: identity)", held=False
        ),
        "p_optical_encoder": Option(
            "[x, y, z], m",
            "origin of the encoder frame in the tracker frame (default 0)",
            held=False,
        ),
    },
    described={"quaternion": facts.BODY_TO_REFERENCE},
    layouts=("time,angle[,scored]", "time,qw,qx,qy,qz[,x,y,z][,scored]"),
    read=_read,
    write=_write,
    screen=_screen,
)
