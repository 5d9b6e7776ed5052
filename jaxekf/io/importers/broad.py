"""Importer of BROAD trials (Laidig, Caruso, Cereatti, Seel 2021, doi 10.3390/data6070072).

MATLAB v5 files with the IMU and optical motion capture on one clock at 285.71 Hz. The optical
orientation (noise below 0.01 deg) serves as encoder-grade truth.
"""

from collections.abc import Mapping
from dataclasses import replace
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
_ASSUMPTIONS = (
    "The body is the frame of the IMU; the markers' frame is taken to be the same (off by 0.1 to 0.5 deg).",
    "opt_quat is a unit quaternion w, x, y, z (Hamilton) that turns the body's coordinates into the"
    " reference's, which is east, north, up.",
    "The encoder is the optical attitude again: truth for a tracker made of it (broad.degrade),"
    " not for itself.",
    "Samples are evenly spaced at sampling_rate; IMU and motion capture share one clock.",
    "Units are rad/s, m/s^2, µT and m.",
    "gravity_ref is not set: it is found from the accelerometer.",
)


def find(folder: Path | str, trial: int | str) -> Path:
    """The file of a trial by its number, in a folder of BROAD ``.mat`` files (searched below it too)."""
    folder, number = Path(folder), int(trial)
    matches = sorted(folder.rglob(f"{number:02d}_*.mat"))
    if not matches:
        raise RecordingError(
            folder,
            f"no file {number:02d}_*.mat",
            "one MATLAB file a trial",
            "another folder or trial",
        )
    return matches[0]


def load(path: Path | str) -> Recording:
    """One trial: IMU, optical attitude and position, and the optical attitude again as truth.

    Truth is valid where `opt_quat` is not NaN and scored where `movement` is set. `intake` holds the
    account of every stream, by samples.
    """
    path = Path(path)
    data = _read(path)
    rate = float(np.squeeze(data["sampling_rate"]))
    count = len(data["imu_gyr"])
    time_ns = np.round(np.arange(count) * (NANOSECONDS / rate)).astype(np.int64)
    place, quaternion = Place(path), np.asarray(data["opt_quat"], float)
    movement = np.asarray(data["movement"]).reshape(-1).astype(bool)
    position, magnetometer = (
        np.asarray(data[name], float) if name in data else None for name in ("opt_pos", "imu_mag")
    )
    optical, seen = screening.optical(place, time_ns, quaternion, position)
    imu, felt = screening.imu(
        place,
        time_ns,
        np.asarray(data["imu_gyr"], float),
        np.asarray(data["imu_acc"], float),
        magnetometer,
    )
    encoder, true = screening.encoder(place, time_ns, quaternion, scored=movement)
    return Recording(
        name=path.stem,
        optical=optical,
        imu=imu,
        encoder=encoder,
        info={
            "dataset": "BROAD",
            "sampling_rate_hz": rate,
            "assumptions": list(_ASSUMPTIONS),
        },
        path=path,
        intake={"optical": seen, "imu": felt, "encoder": true},
    )


def _read(path: Path) -> Mapping[str, Any]:
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
        raise RecordingError(
            path, f"a file without {missing}", f"the variables {list(_NEEDED)}", "a BROAD trial"
        )
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
    """The optical tracker made from a trial: decimated, noisy, and hidden now and then.

    Starts `lead_s` before the first scored sample; keeps every `keep_every`-th sample;
    right-multiplies by ``exp`` of white noise of `noise_deg` per axis; hides the tracker for a uniform
    time in `gap_s` at exponential intervals of `mean_interval_s`, counted from the end of the gap
    before. The first sample is visible. Random numbers from ``numpy.random.default_rng([seed, trial])``.
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
    cut = imu.time_ns >= time_ns[0]
    return recording.replace(
        optical=Optical(time_ns, q, visible, position),
        imu=replace(
            imu,
            time_ns=imu.time_ns[cut],
            gyroscope=imu.gyroscope[cut],
            accelerometer=None if imu.accelerometer is None else imu.accelerometer[cut],
            magnetometer=None if imu.magnetometer is None else imu.magnetometer[cut],
        ),
        info={**recording.info, "degraded_seed": seed, "optical_noise_deg": noise_deg},
    )


def _gaps(
    rng: np.random.Generator, time_ns: Any, gap_s: tuple[float, float], mean_interval_s: float
) -> Any:
    """Which samples fall into a gap."""
    elapsed = (time_ns - time_ns[0]) / NANOSECONDS
    hidden = np.zeros(len(elapsed), bool)
    start = rng.exponential(mean_interval_s)
    while start < elapsed[-1]:
        end = start + rng.uniform(*gap_s)
        hidden |= (elapsed >= start) & (elapsed < end)
        start = end + rng.exponential(mean_interval_s)
    hidden[0] = False
    return hidden
