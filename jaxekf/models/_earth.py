"""The Earth's gravity and magnetic field as attitude references, shared by `triad` and `marg`.

Up and magnetic north are those that a recording states: ``gravity_ref`` (by default along -z) and
``field_ref``, of which only the horizontal direction is used (by default y: x is east, y north, z up). In
the world of Ang, Khosla and Riviere, which is north, west, up, it is ``[1, 0, 0]``. Dip and strength of the
field are estimated from each recording.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from jaxekf._support.compilation import require_float64
from jaxekf._support.constants import GRAVITY_REF
from jaxekf._support.errors import RecordingError
from jaxekf.geometry import triad
from jaxekf.pose_solvers import tilt
from jaxekf.recordings import facts
from jaxekf.recordings.accounts import Indices
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Imu, Recording

FIELD_REF = (0.0, 1.0, 0.0)
_FEWEST = 2
MOST_HZ = 100.0
"""Largest number of magnetometer samples per second that are used, since errors of the field last
longer."""
_PAUSE_NS = 500_000_000
"""A longer step is a pause, not a sampling period."""


class Setup(NamedTuple):
    """Constants of a recording."""

    gravity_ref: Any
    """(3,) gravity vector in the reference frame, m/s^2."""
    field_ref: Any
    """(3,) unit vector along the magnetic field in the reference frame."""


def dipping(up: Floats, north: Floats, dip: float) -> Floats:
    """(3,) unit vector `dip` radians below the horizontal unit vector `north`."""
    return np.cos(dip) * north - np.sin(dip) * up


SETUP = Setup(
    np.array(GRAVITY_REF), dipping(np.array([0.0, 0.0, 1.0]), np.array(FIELD_REF), np.deg2rad(60.0))
)


def require_marg_imu(recording: Recording) -> Imu:
    """The IMU's samples with finite rate and specific force; its magnetometer may be slower.

    Raises
    ------
    RecordingError
        If accelerometer or magnetometer is missing or reads only zeros, or if too few samples are finite.
    """
    imu = recording.need_imu()
    finite = np.isfinite(imu.gyroscope).all(axis=1)
    if imu.accelerometer is not None:
        finite &= np.isfinite(imu.accelerometer).all(axis=1)
    for name, columns in (("accelerometer", "ax,ay,az"), ("magnetometer", "mx,my,mz")):
        values = getattr(imu, name)
        if values is None or not (np.isfinite(values).all(axis=1) & values.any(axis=1)).any():
            raise RecordingError(
                recording.path or recording.name,
                f"an IMU without {name}",
                "gyroscope, accelerometer and magnetometer for this model",
                f"adding {columns} to imu.csv, or the model loose where there is a tracker",
            )
    assert imu.magnetometer is not None
    measured = np.isfinite(imu.magnetometer).all(axis=1) & imu.magnetometer.any(axis=1)
    if finite.sum() < _FEWEST or not (measured & finite).any():
        raise RecordingError(
            recording.path or recording.name,
            f"{int(finite.sum())} samples of finite rate and specific force,"
            f" {int((measured & finite).sum())} of them with a magnetic field",
            f"{_FEWEST} or more, and a field in one of them",
            "a run whose sensors were read at the same times",
        )
    if finite.all():
        return imu
    left = {key: getattr(imu, key)[finite] for key in imu.per_sample}
    return replace(imu, time_ns=imu.time_ns[finite], **left)


def setup(recording: Recording) -> Setup:
    """Up and north as stated by a recording, and the field's dip as measured in the run.

    Raises
    ------
    RecordingError
        If the stated field is vertical, or a stated value is no vector, and as `require_marg_imu`.
    """
    known = facts.known_entries(recording.info, recording.path or recording.name)
    gravity = np.array(known.get("gravity_ref", GRAVITY_REF))
    stated = np.array(known.get("field_ref", FIELD_REF))
    up = -gravity / np.linalg.norm(gravity)
    level = stated - up * (up @ stated)
    if np.linalg.norm(level) < 1e-6 * np.linalg.norm(stated):
        raise RecordingError(
            recording.path or recording.name,
            f"field_ref = {stated.tolist()}, along gravity_ref",
            "a field with a horizontal part, which points to magnetic north",
            "stating another field_ref or gravity_ref in recording.toml",
            column="field_ref",
        )
    dip = float(np.nanmedian(tilt.magnetic_field(require_marg_imu(recording)).dip))
    return Setup(gravity, dipping(up, level / np.linalg.norm(level), dip))


def thinned(imu: Imu, good: Flags) -> Indices:
    """Every n-th good row (N,) of an IMU, so that about `MOST_HZ` per second remain."""
    rows = np.flatnonzero(good)
    steps = np.diff(imu.time_ns[rows])
    # The mean, since time stamps may come in bursts.
    steps = steps[steps < _PAUSE_NS]
    if not steps.size:
        return rows
    return rows[:: max(1, round(NANOSECONDS / (float(steps.mean()) * MOST_HZ)))]


def attitudes(
    force: Floats, field: Floats, about: Setup, least_sine: float = 1e-6
) -> triad.Attitude:
    """Attitudes (N, 4) from specific forces and fields (N, 3).

    They are valid if the sine of the angle between the two is not below `least_sine`.
    """
    require_float64()
    return _attitudes(force, field, -about.gravity_ref, about.field_ref, least_sine)


@jax.jit
def _attitudes(
    force: Array, field: Array, up: Array, field_ref: Array, least_sine: Array
) -> triad.Attitude:
    def one(a: Array, b: Array) -> triad.Attitude:
        return triad.triad(a, b, up, field_ref, least_sine=least_sine)

    return jax.vmap(one)(force, field)
