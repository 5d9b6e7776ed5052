"""Importer of BROAD trials (Laidig, Caruso, Cereatti, Seel 2021, doi 10.3390/data6070072).

MATLAB v5 files with the IMU and optical motion capture on one clock at 285.71 Hz. The optical
orientation (noise below 0.01 deg) serves as encoder-grade truth.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Place
from jaxekf.recordings.types import NANOSECONDS, Optical, Recording, from_scipy, to_scipy

_NEEDED = ("imu_gyr", "imu_acc", "opt_quat", "movement", "sampling_rate")
_LISTED = 12
_ASSUMPTIONS = (
    "The body is the frame of the IMU; the markers' frame is assumed the same (off by 0.1 to 0.5 deg).",
    "opt_quat is a unit quaternion w, x, y, z (Hamilton) that turns the body's coordinates into the"
    " reference's, which is east, north, up.",
    "The encoder is the optical attitude again: truth for a tracker made of it (broad.degrade),"
    " not for itself.",
    "Samples are evenly spaced at sampling_rate; IMU and motion capture share one clock.",
    "Units are rad/s, m/s^2, µT and m.",
    "gravity_ref is not set: it is found from the accelerometer.",
)


def find(folder: Path | str, trial: int | str) -> Path:
    """Find the file of a trial by its number, in a folder of BROAD ``.mat`` files or below it."""
    folder, number = Path(folder), int(trial)
    matches = sorted(folder.rglob(f"{number:02d}_*.mat"))
    if not matches:
        got, hint = f"no file {number:02d}_*.mat", "another folder or trial"
        raise RecordingError(folder, got, "one MATLAB file a trial", hint)
    return matches[0]


def load(path: Path | str) -> Recording:
    """Read one trial: IMU, optical attitude and position, and the optical attitude again as truth.

    Parameters
    ----------
    path : path
        The trial's MATLAB file.

    Returns
    -------
    Recording
        Times in ns, evenly spaced; attitude w, x, y, z, body to east, north, up; position in metres;
        gyroscope in rad/s, accelerometer in m/s^2, magnetometer in µT. Truth is valid for samples with an
        `opt_quat`, and scored for those with `movement`. `intake` accounts for every stream by sample.

    Raises
    ------
    RecordingError
        If the file is not a trial, or a folder, whose trials it lists.
    """
    path = Path(path)
    data = _read(path)
    hertz = float(np.squeeze(data["sampling_rate"]))
    count = len(data["imu_gyr"])
    time_ns = np.round(np.arange(count) * (NANOSECONDS / hertz)).astype(np.int64)
    place, quaternion = Place(path), np.asarray(data["opt_quat"], float)
    movement = np.asarray(data["movement"]).reshape(-1).astype(bool)
    position, magnetometer = (
        np.asarray(data[name], float) if name in data else None for name in ("opt_pos", "imu_mag")
    )
    optical, seen = screening.optical(place, time_ns, quaternion, position)
    rate, force = (np.asarray(data[name], float) for name in ("imu_gyr", "imu_acc"))
    imu, felt = screening.imu(place, time_ns, rate, force, magnetometer)
    encoder, true = screening.encoder(place, time_ns, quaternion, scored=movement)
    return Recording(
        name=path.stem,
        optical=optical,
        imu=imu,
        encoder=encoder,
        info={
            "dataset": "BROAD",
            "sampling_rate_hz": hertz,
            "assumptions": list(_ASSUMPTIONS),
            "encoder_about": {"clock": "tracker"},
        },
        path=path,
        intake={"optical": seen, "imu": felt, "encoder": true},
    )


def _read(path: Path) -> Mapping[str, Any]:
    if path.is_dir():
        names = sorted(file.name for file in path.rglob("*.mat"))
        more = ", ..." if len(names) > _LISTED else ""
        got = f"a folder that holds {len(names)} trials ({', '.join(names[:_LISTED])}{more})"
        raise RecordingError(path, got, "one BROAD .mat file", "naming it")
    if not path.is_file():
        raise RecordingError(path, "no such file", "a BROAD .mat file", "another path")
    try:
        data = loadmat(path)
    except (ValueError, NotImplementedError, OSError) as error:
        raise RecordingError(
            path, f"a file that cannot be read ({error})", "a MATLAB v5 file", "fetching it again"
        ) from error
    missing = [name for name in _NEEDED if name not in data]
    if missing:
        expected = f"the variables {list(_NEEDED)}"
        raise RecordingError(path, f"a file without {missing}", expected, "a BROAD trial")
    return data


def degrade(
    recording: Recording,
    *,
    seed: int,
    trial: int,
    keep_every: int = 5,
    noise_deg: float = 0.3,
    gap_s: tuple[float, float] = (0.2, 2.0),
    mean_interval_s: float = 6.0,
    lead_s: float = 5.0,
) -> Recording:
    """Make an optical tracker from a trial: decimated, noisy, with occlusions.

    Parameters
    ----------
    recording : Recording
        A trial as `load` reads it.
    seed, trial : int
        Random numbers are from ``numpy.random.default_rng([seed, trial])``.
    keep_every : int
        Every `keep_every`-th sample is kept; the first one is visible.
    noise_deg : float
        White noise per axis, deg, whose ``exp`` multiplies the attitude from the right.
    gap_s : (float, float)
        Bounds of the uniform duration of an occlusion, s.
    mean_interval_s : float
        Mean of the exponential time from the end of an occlusion to the next, s.
    lead_s : float
        Time before the first scored sample at which the recording begins, s.

    Returns
    -------
    Recording
        The trial with this tracker, and the IMU from its first sample on.
    """
    rng = np.random.default_rng([seed, trial])
    encoder, optical, imu = recording.need_encoder(), recording.need_optical(), recording.need_imu()
    moving = np.flatnonzero(encoder.scored)
    first_move = encoder.time_ns[moving[0]] if moving.size else encoder.time_ns[0]
    begin = int(np.searchsorted(encoder.time_ns, first_move - int(lead_s * NANOSECONDS)))
    rows = np.arange(begin, len(optical.time_ns), keep_every)
    seen = np.flatnonzero(optical.valid[rows])
    rows = rows[seen[0] :] if seen.size else rows
    time_ns = optical.time_ns[rows]
    noise = np.deg2rad(noise_deg) * rng.standard_normal((len(rows), 3))
    clean = to_scipy(optical.q_ref_body[rows])
    q = from_scipy(clean * Rotation.from_rotvec(noise))
    visible = optical.valid[rows] & ~_gaps(rng, time_ns, gap_s, mean_interval_s)
    position = None if optical.position is None else optical.position[rows]
    return recording.replace(
        optical=Optical(time_ns, q, visible, position),
        imu=imu.take(imu.time_ns >= time_ns[0]),
        info={**recording.info, "degraded_seed": seed, "optical_noise_deg": noise_deg},
    )


def _gaps(
    rng: np.random.Generator, time_ns: Any, gap_s: tuple[float, float], mean_interval_s: float
) -> Any:
    """A mask (N,) of the samples within an occlusion."""
    elapsed = (time_ns - time_ns[0]) / NANOSECONDS
    hidden = np.zeros(len(elapsed), bool)
    start = rng.exponential(mean_interval_s)
    while start < elapsed[-1]:
        end = start + rng.uniform(*gap_s)
        hidden |= (elapsed >= start) & (elapsed < end)
        start = end + rng.exponential(mean_interval_s)
    hidden[0] = False
    return hidden
