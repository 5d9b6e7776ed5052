"""What the images of a camera say of its lens, its landmarks and the IMU: poses of single images, compared.

An image's own pose fits badly, or not at all, where the lens or the names or places of landmarks are wrong;
where it fits, its turns and distances are those of the IMU, or not.
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
    fault,
    path_unit,
    rates_unit,
)
from jaxekf.checks.sensor_agreement import ALIKE, Evidence, evidence
from jaxekf.pose_solvers import pnp
from jaxekf.recordings.types import Camera, Flags, Recording

_MOST_IMAGES, _TRIED = 1500, 60
"""Images that are solved for, in the middle of a run, and of a camera whose images fit no pose, since that
takes long to see."""
_FEW_FIT = 0.5
_PIXELS, _TIMES = 3.0, 2.0
"""Points off by so much, and by so many of their reported deviations, are not found badly but placed."""
_RATE_OFF, _LENGTH_OFF = 0.05, 0.2
_EXPLAINED = 0.5


class CameraEvidence(NamedTuple):
    """What was measured of the images in the middle of a run, 1,500 at most."""

    images: int
    """Those with six landmarks or more."""
    posed: int
    """Of them, those that a pose fits."""
    error_px: float
    """Median of the robust deviations of points about their image's pose; NaN where none has one."""
    sigma_px: float
    """Median reported deviation of points; 0 where none was reported."""
    imu: Evidence
    """Of the poses as a tracker's, and the IMU."""
    match: AttitudeMatch | None
    """Clock and frame of the poses against the IMU; None where these do not tell."""

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
    """What the images say; None without a camera, or where no image has landmarks enough for a pose."""
    camera = recording.camera
    if camera is None:
        return None
    camera = _middle(camera)
    enough = camera.usable.sum(axis=1) >= pnp.FEWEST
    if not enough.any():
        return None
    some = np.flatnonzero(enough)[:: max(1, -(-int(enough.sum()) // _TRIED))]
    tried = np.isin(np.arange(len(enough)), some)
    if not pnp.poses(_only(camera, tried)).valid.any():
        return CameraEvidence(len(some), 0, np.nan, 0.0, Evidence(), None)
    usable = _only(camera, enough)
    found = pnp.poses(usable)
    posed = found.valid
    error = float(np.median(found.error[posed])) if posed.any() else np.nan
    sigma = 0.0
    if camera.sigma is not None:
        reported = camera.sigma[camera.usable & np.isfinite(camera.sigma)]
        sigma = float(np.median(reported)) if reported.size else 0.0
    told, matched, imu = Evidence(), None, recording.imu
    if imu is not None and posed.any():
        optical = pnp.as_optical(usable)
        told = evidence(Recording(recording.name, optical=optical, imu=imu))
        try:
            matched = align(optical, imu, recording.path or recording.name)
        except RecordingError:
            matched = None
    return CameraEvidence(int(enough.sum()), int(posed.sum()), error, sigma, told, matched)


def _only(camera: Camera, images: Flags) -> Camera:
    """With nothing seen in all other images."""
    return replace(camera, visible=camera.visible & images[:, None])


def _middle(camera: Camera) -> Camera:
    """Not more images than can be solved for in seconds, without gaps, as turns need neighbours."""
    begin = max(0, (len(camera.time_ns) - _MOST_IMAGES) // 2)
    part = slice(begin, begin + _MOST_IMAGES)
    sigma = None if camera.sigma is None else camera.sigma[part]
    return replace(
        camera,
        time_ns=camera.time_ns[part],
        pixel=camera.pixel[part],
        visible=camera.visible[part],
        sigma=sigma,
    )


def check_camera(recording: Recording, found: CameraEvidence) -> None:
    """Raise `RecordingError` where images or IMU plainly contradict what is said of the camera: no pose
    fits any image, or lengths or the gyroscope are in another unit."""
    if found.posed == 0:
        raise pnp.no_pose_error(recording.path or recording.name, found.images)
    imu = found.imu
    unit = rates_unit(imu)
    if unit is not None:
        raise fault(
            recording,
            "imu.unit",
            f"a gyroscope that turns {imu.rate_ratio:.4g} times as fast as the camera (correlation"
            f" {imu.rate_correlation:.2f})",
            "the same rate",
            f'[imu] unit = "{unit}, m/s^2", the accelerometer\'s as it is',
        )
    check_gravity(recording, imu)
    unit = path_unit(imu)
    if unit is not None:
        raise fault(
            recording,
            "camera.unit",
            f"a camera that moves {imu.length_ratio:.4g} times as far as the accelerometer (correlation"
            f" {imu.length_correlation:.2f})",
            "the same way",
            f'[camera] unit = "{unit}, px", that of the landmarks\' places',
        )


def camera_warnings(found: CameraEvidence) -> list[str]:
    """What is not as it should be, though no unit explains it."""
    warnings, imu = [], found.imu
    if found.posed < _FEW_FIT * found.images:
        warnings.append(
            f"{found.images - found.posed} of {found.images} images of {pnp.FEWEST} landmarks or"
            " more fit no pose: look at the landmarks' names and places, and at the lens"
        )
    if found.error_px > max(_PIXELS, _TIMES * found.sigma_px):
        warnings.append(
            f"image points lie {found.error_px:.1f} pixels off where the pose of their image puts them: are"
            " focal, centre and radial those of images of this size, and landmarks where they are said"
            " to be?"
        )
    alike = imu.rate_correlation > ALIKE
    if alike and abs(imu.rate_ratio - 1.0) > _RATE_OFF:
        warnings.append(
            f"the gyroscope turns {imu.rate_ratio:.3f} times as fast as the camera: look at the focal"
            " lengths, and at the gyroscope's scale"
        )
    if not alike and imu.rate > LEAST_RATE and imu.explained < _EXPLAINED:
        warnings.append(
            f"the gyroscope explains {100.0 * imu.explained:.0f} % of the camera's turning: are both of"
            " one run and on one clock, and focal, centre and landmarks as they are said to be?"
        )
    if imu.length_correlation > ALIKE and abs(imu.length_ratio - 1.0) > _LENGTH_OFF:
        warnings.append(
            f"the camera moves {imu.length_ratio:.3g} times as far as the accelerometer: are the landmarks'"
            " places to scale?"
        )
    if imu.farthest > FARTHEST_M:
        warnings.append(
            f"the camera is up to {imu.farthest:.3g} m from the scene's origin: are the landmarks' places"
            " in metres?"
        )
    return warnings + ([] if found.match is None else _of_match(found.match))


def _of_match(made: AttitudeMatch) -> list[str]:
    warnings = []
    if has_latency(made):
        warnings.append(
            f"the images are {1e3 * made.latency_s:.1f} ± {1e3 * made.latency_sigma_s:.1f} ms older than"
            " stamped, by the IMU's clock: state [camera] latency, or tune calibration.latency"
        )
    if (turned := misalignment_deg(made)) is not None:
        warnings.append(
            f"the camera is turned by {turned[0]:.1f} ± {turned[1]:.1f} deg against where"
            " q_body_camera says: correct it, or tune calibration.alignment"
        )
    return warnings
