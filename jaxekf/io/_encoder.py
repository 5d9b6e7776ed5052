"""Truth from a robot's joints on disk.

``encoder.csv``  time,angle[,scored]  or  time,qw,qx,qy,qz[,x,y,z][,scored]

The section ``[encoder]`` of `recording.toml` says where a joint's axis lies, and how the encoder's frame
lies in the tracker's (`q_optical_encoder`, `p_optical_encoder`).
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.io import _stream_options as stream_options
from jaxekf.io import description
from jaxekf.io.csv_table import (
    POSITION,
    QUATERNION,
    Sheet,
    Table,
    flags,
    need_columns,
    numbers,
    stamps,
    whole_or_blank,
)
from jaxekf.recordings import facts, screening
from jaxekf.recordings.accounts import Intake
from jaxekf.recordings.types import Encoder, Floats, from_scipy, to_scipy

DESCRIBED = {"quaternion": facts.BODY_TO_REFERENCE}
LAYOUTS = ("time,angle[,scored]", "time,qw,qx,qy,qz[,x,y,z][,scored]")


def read(table: Table, source: description.Source) -> tuple[Encoder, Intake]:
    """Attitude of the tool from a joint angle or a quaternion, in the tracker's frame.

    With an angle: ``q = q_zero exp(axis angle)`` where the axis is fixed in the body
    (``acts_on = "body"``), ``exp(axis angle) q_zero`` where it is fixed in the reference.
    ``q_optical_encoder`` turns the encoder's frame into the tracker's, and ``p_optical_encoder`` is
    its origin there, in metres. A blank position is NaN.
    """
    need_columns(table, *LAYOUTS)
    about, place = source.about, source.place
    scored, position = flags(table, "scored"), None
    frame = _fixed_rotation(about, "q_optical_encoder", place)
    if "angle" in table.columns:
        (scale,) = stream_options.factors("joint", about, place)
        length = 1.0
        angle = scale * numbers(table, ("angle",), blank=True)[:, 0]
        known = np.isfinite(angle)
        q = joint_attitude(np.where(known, angle, 0.0), about, place)
        q[~known] = np.nan
    else:
        _, length = stream_options.factors("encoder", about, place)
        turning = stream_options.turning("encoder", about, place)
        q = turning.standard(numbers(table, turning.columns(table.columns), blank=True))
    if set(POSITION) <= set(table.columns):
        origin = about.get("p_optical_encoder", [0.0, 0.0, 0.0])
        origin = facts.finite_vector(origin, 3, place, "encoder.p_optical_encoder")
        position = frame.apply(length * whole_or_blank(table, POSITION)) + origin
    stream, account = screening.encoder(
        table.place, stamps(table), q, position, scored=scored, sort=source.sort
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


def write(stream: Encoder, about: dict[str, Any]) -> tuple[Sheet, dict[str, Any]]:
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
        about |= {"kind": "attitude", "unit": unit} | DESCRIBED
    if not stream.scored.all():
        columns, values = [*columns, "scored"], np.c_[values, stream.scored.astype(float)]
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
