"""The ``sensor.yaml`` of a stream in the ASL layout: extrinsics and noise."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.recordings.types import Floats

_NOISE = (
    "gyroscope_noise_density",
    "gyroscope_random_walk",
    "accelerometer_noise_density",
    "accelerometer_random_walk",
)
_ROTATION_TOLERANCE = 1e-3  # EuRoC writes its matrices with five digits


class Transform(NamedTuple):
    """The pose of frame b in frame a; maps coordinates of b to a."""

    rotation: Rotation
    translation: Floats

    def inverse(self) -> "Transform":
        back = self.rotation.inv()
        return Transform(back, -back.apply(self.translation))

    def then(self, other: "Transform") -> "Transform":
        """``T_a_b.then(T_b_c)`` is ``T_a_c``."""
        return Transform(
            self.rotation * other.rotation,
            self.rotation.apply(other.translation) + self.translation,
        )


IDENTITY = Transform(Rotation.identity(), np.zeros(3))


def read_description(file: Path) -> Mapping[str, Any]:
    """Keys and values of a sensor.yaml; raises `RecordingError` if it is not YAML."""
    try:
        text = file.read_text("utf-8-sig")
        # OpenCV's "%YAML:1.0" and matrix tags are not YAML; the lines stay, so that they count.
        description = yaml.safe_load(re.sub(r"^%.*$|!!opencv-matrix", "", text, flags=re.MULTILINE))
    except (yaml.YAMLError, ValueError, OSError) as error:  # ValueError: text, dates
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or error
        got = f"text that is not YAML ({reason})"
        raise RecordingError(
            file, got, "YAML", "correcting it", line=None if mark is None else mark.line + 1
        ) from error
    if not isinstance(description, dict):
        raise RecordingError(file, f"{description!r}", "keys and values", "correcting it")
    return description


def extrinsics(file: Path, description: Mapping[str, Any]) -> Transform:
    """``T_BS``, the sensor's pose in the data set's body frame; the identity by default."""
    if "T_BS" not in description:
        return IDENTITY
    value = description["T_BS"]
    try:
        # YAML 1.1 takes 1e-3, without a point, for text: NumPy makes it a number again.
        data = np.asarray(value["data"] if isinstance(value, dict) else value, float)
        matrix = data.reshape(4, 4)
    except (KeyError, TypeError, ValueError):
        raise _bad_extrinsics(file, f"{value!r}", "16 numbers, row by row, under data") from None
    turn = matrix[:3, :3]
    if not np.isfinite(matrix).all():
        raise _bad_extrinsics(file, "numbers that are not finite", "a rigid motion")
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise _bad_extrinsics(file, f"the last row {matrix[3].tolist()}", "0, 0, 0, 1")
    off = float(np.max(np.abs(turn.T @ turn - np.eye(3))))
    if off > _ROTATION_TOLERANCE or np.linalg.det(turn) < 0:
        fault = "a reflection" if off <= _ROTATION_TOLERANCE else f"columns {off:.2g} from it"
        raise _bad_extrinsics(file, fault, "a rotation: orthonormal columns, determinant +1")
    return Transform(Rotation.from_matrix(turn), matrix[:3, 3].copy())


def _bad_extrinsics(file: Path, got: str, expected: str) -> RecordingError:
    return RecordingError(file, got, expected, "correcting the calibration", column="T_BS")


def imu_noise(file: Path, description: Mapping[str, Any]) -> dict[str, float]:
    """Spectral densities of the IMU's noise and bias random walks, SI/√Hz, that are given."""
    noise = {}
    for key in _NOISE:
        if key not in description:
            continue
        try:
            noise[key] = float(description[key])
        except (TypeError, ValueError):
            noise[key] = np.nan
        if not 0.0 <= noise[key] < np.inf:
            got = f"{description[key]!r}"
            raise RecordingError(file, got, "a density of 0 or more", "correcting it", column=key)
    return noise
