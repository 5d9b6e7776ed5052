"""Agreement of a camera's images with its lens, its landmarks and the IMU, by single-image poses.

The pose of an image fits badly, or not at all, if lens parameters, landmark names or landmark positions are
wrong. Where it fits, its rotations and distances are compared with the IMU's.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.calibration.alignment import align, has_latency, misalignment_deg
from jaxekf.calibration.attitude_alignment import AttitudeMatch
from jaxekf.checks.plausibility import (
    FARTHEST_M,
    LEAST_RATE,
    check_gravity,
    length_fault,
    path_unit,
    rate_fault,
    rates_unit,
)
from jaxekf.checks.sensor_agreement import ALIKE, Evidence, evidence
from jaxekf.pose_solvers import pnp
from jaxekf.recordings.types import Camera, Flags, Recording

_MOST_IMAGES, _TRIED = 1500, 60
"""Images that are solved, from the middle of a run, and images that are tried first: a camera without any
valid pose is slow."""
_FEW_FIT = 0.5
_PIXELS, _TIMES = 3.0, 2.0
"""Bounds on the reprojection error, pixels and multiples of the reported deviation; a larger error means
wrong geometry, not detection noise."""
_RATE_OFF, _LENGTH_OFF = 0.05, 0.2
_EXPLAINED = 0.5


class CameraEvidence(NamedTuple):
    """Measurements on the images in the middle of a run, 1,500 at most."""

    images: int
    """Images with six landmarks or more."""
    posed: int
    """Images with a valid pose."""
    error_px: float
    """Median over images of the robust reprojection error, pixels; NaN without poses."""
    sigma_px: float
    """Median reported deviation of points, pixels; 0 if none was reported."""
    imu: Evidence
    """Agreement of the camera's poses, taken as a tracker's, with the IMU."""
    match: AttitudeMatch | None
    """Clock and rotation of the poses relative to the IMU; None if they could not be estimated."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "images_with_enough_landmarks": self.images,
            "images_with_a_pose": self.posed,
            "error_px": self.error_px,
            "reported_sigma_px": self.sigma_px,
            "evidence": self.imu.as_dict(),
        }


def camera_evidence(recording: Recording) -> CameraEvidence | None:
    """Measure the agreement of a camera; None without a camera or without an image of six landmarks."""
    camera = recording.camera
    if camera is None:
        return None
    camera = _middle_images(camera)
    enough = camera.usable.sum(axis=1) >= pnp.FEWEST
    if not enough.any():
        return None
    some = np.flatnonzero(enough)[:: max(1, -(-int(enough.sum()) // _TRIED))]
    tried = np.isin(np.arange(len(enough)), some)
    if not pnp.poses(_select_images(camera, tried)).valid.any():
        return CameraEvidence(len(some), 0, np.nan, 0.0, Evidence(), None)
    usable = _select_images(camera, enough)
    found = pnp.poses(usable)
    posed = found.valid
    error = float(np.median(found.error[posed])) if posed.any() else np.nan
    sigma = 0.0
    if camera.sigma is not None:
        reported = camera.sigma[camera.usable & np.isfinite(camera.sigma)]
        sigma = float(np.median(reported)) if reported.size else 0.0
    agreement, matched, imu = Evidence(), None, recording.imu
    if imu is not None and posed.any():
        optical = pnp.as_optical(usable)
        agreement = evidence(Recording(recording.name, optical=optical, imu=imu))
        try:
            matched = align(optical, imu, recording.path or recording.name)
        except RecordingError:
            matched = None
    return CameraEvidence(int(enough.sum()), int(posed.sum()), error, sigma, agreement, matched)


def _select_images(camera: Camera, images: Flags) -> Camera:
    """The camera with all points of the other images hidden."""
    return replace(camera, visible=camera.visible & images[:, None])


def _middle_images(camera: Camera) -> Camera:
    """Consecutive images from the middle of the run, few enough to be solved in seconds."""
    begin = max(0, (len(camera.time_ns) - _MOST_IMAGES) // 2)
    return camera.take(slice(begin, begin + _MOST_IMAGES))


def check_camera(recording: Recording, found: CameraEvidence) -> None:
    """Raise `RecordingError` if the images clearly contradict the description.

    Faults are a camera without any valid pose, and a wrong unit of gyroscope or lengths.
    """
    if found.posed == 0:
        raise pnp.no_pose_error(recording.path or recording.name, found.images)
    imu = found.imu
    unit = rates_unit(imu)
    if unit is not None:
        raise rate_fault(
            recording, imu, "camera", f'"{unit}, m/s^2", the accelerometer\'s as it is'
        )
    check_gravity(recording, imu)
    unit = path_unit(imu)
    if unit is not None:
        hint = f'"{unit}, px", that of the landmarks\' positions'
        raise length_fault(recording, imu, "camera", hint)


def camera_warnings(found: CameraEvidence) -> list[str]:
    """Warnings on a camera that no wrong unit explains."""
    warnings, imu = [], found.imu
    if found.posed < _FEW_FIT * found.images:
        warnings.append(
            f"{found.images - found.posed} of {found.images} images of {pnp.FEWEST} landmarks or"
            " more fit no pose: check the landmarks' names and positions, and the lens"
        )
    if found.error_px > max(_PIXELS, _TIMES * found.sigma_px):
        warnings.append(
            f"the median reprojection error is {found.error_px:.1f} pixels: are focal, centre and radial"
            " those of images of this size, and the landmarks at their stated positions?"
        )
    alike = imu.rate_correlation > ALIKE
    if alike and abs(imu.rate_ratio - 1.0) > _RATE_OFF:
        warnings.append(
            f"the gyroscope rotates {imu.rate_ratio:.3f} times as fast as the camera: check the focal"
            " lengths and the gyroscope's scale"
        )
    if not alike and imu.rate > LEAST_RATE and imu.explained < _EXPLAINED:
        warnings.append(
            f"the gyroscope explains {100.0 * imu.explained:.0f} % of the camera's rotation: are both of"
            " one run and on one clock, and focal, centre and landmarks as stated?"
        )
    if imu.length_correlation > ALIKE and abs(imu.length_ratio - 1.0) > _LENGTH_OFF:
        warnings.append(
            f"the camera moves {imu.length_ratio:.3g} times as far as the accelerometer: are the landmarks'"
            " positions to scale?"
        )
    if imu.farthest > FARTHEST_M:
        warnings.append(
            f"the camera is up to {imu.farthest:.3g} m from the scene's origin: are the landmarks'"
            " positions in metres?"
        )
    return warnings + ([] if found.match is None else _alignment_warnings(found.match))


def _alignment_warnings(match: AttitudeMatch) -> list[str]:
    warnings = []
    if has_latency(match):
        warnings.append(
            f"the images are {1e3 * match.latency_s:.1f} ± {1e3 * match.latency_sigma_s:.1f} ms older than"
            " stamped, by the IMU's clock: state [camera] latency, or tune calibration.latency"
        )
    if (misaligned := misalignment_deg(match)) is not None:
        warnings.append(
            f"the camera is rotated by {misaligned[0]:.1f} ± {misaligned[1]:.1f} deg relative to"
            " the stated q_body_camera: correct it, or tune calibration.alignment"
        )
    return warnings
