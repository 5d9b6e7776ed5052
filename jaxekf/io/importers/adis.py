"""Importer of static logs of MEMS IMUs as the R package `imudata` publishes them (Guerrier, Molinari).

A NumPy file with an array ``data`` (N, 6): gyroscope about x, y, z in deg/s, then accelerometer in g.
"""

import zipfile
from pathlib import Path

import numpy as np

from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf._support.errors import RecordingError
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Place
from jaxekf.recordings.types import NANOSECONDS, Recording


def load(path: Path | str, sampling_hz: float = 100.0) -> Recording:
    """Read a log as a run of an IMU alone; `jaxekf allan` reads the folder that `jaxekf.save` writes of it.

    Parameters
    ----------
    path : path
        The NumPy file.
    sampling_hz : float
        Rate of the samples in Hz, which are evenly spaced.

    Returns
    -------
    Recording
        Times in ns; gyroscope (N, 3) in rad/s and accelerometer (N, 3) in m/s^2, in the IMU's frame.

    Raises
    ------
    RecordingError
        If the file is not such a log.
    """
    file = Path(path)
    try:
        with np.load(file) as content:
            data = np.asarray(content["data"], float)
    except (OSError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise RecordingError(
            file, f"no log ({error})", "an .npz file with an array 'data'", "another path"
        ) from error
    if data.ndim != 2 or data.shape[1] != 6 or not np.all(np.isfinite(data)):
        expected = "six finite columns: gyroscope in deg/s, accelerometer in g"
        raise RecordingError(file, f"an array of shape {data.shape}", expected, "another file")
    time_ns = np.round(np.arange(len(data)) * (NANOSECONDS / sampling_hz)).astype(np.int64)
    imu, account = screening.imu(
        Place(file), time_ns, np.deg2rad(data[:, :3]), STANDARD_GRAVITY * data[:, 3:]
    )
    info = {
        "sampling_rate_hz": sampling_hz,
        "assumptions": [
            "Columns are the gyroscope about x, y, z in deg/s and the accelerometer along x, y, z in g"
            f" ({STANDARD_GRAVITY} m/s^2), in the IMU's frame.",
            f"Samples are evenly spaced at {sampling_hz:g} Hz: the file has no times.",
        ],
    }
    return Recording(file.stem, imu=imu, info=info, path=file, intake={"imu": account})
