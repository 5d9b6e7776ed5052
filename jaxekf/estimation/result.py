"""The estimate of a run on the host: its data, exports and result folder."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxekf.estimation import result_folder
from jaxekf.estimation._estimate_data import (
    Estimated,
    EstimateData,
    OutputEstimate,
    SensorRecord,
    trackers,
)
from jaxekf.io import export
from jaxekf.io.atomic import whole_file

__all__ = ["Estimate", "Estimated", "OutputEstimate", "SensorRecord", "trackers"]


@dataclass(frozen=True)
class Estimate(EstimateData):
    """The estimate of one run, at every instant of its timeline.

    Attributes
    ----------
    time_ns
        (N,) int64 nanoseconds on `clock`; `time` is in seconds since the first instant.
    clock
        `Clock` of all times: the IMU's unless ``clock="tracker"`` was asked for.
    state
        The model's state with a leading axis (N,).
    cov
        (N, n, n) covariance of the error vector, whose rows are named by `error_labels`.
    outputs
        `OutputEstimate` by name, such as ``attitude`` and ``rate``.
    sensors
        `SensorRecord` with the innovations of each sensor, by name.
    requested
        The estimate at the times of ``estimate(at=...)``; None without them.
    account
        Number of rows of each stream that were read, used, masked, gated and dropped.
    params
        The parameters that were used.
    notes
        Remarks on how the run was read and initialised.

    Examples
    --------
    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5")
    >>> print(f"{len(estimate.time)} instants over {estimate.time[-1]:.0f} s")
    3001 instants over 24 s
    >>> print(np.rad2deg(estimate.attitude.sigma[-1]).round(2))  # deg
    [0.04 0.04 0.04]
    >>> account = estimate.account["optical"]
    >>> print(f"{account['used']} of {account['read']} samples of the tracker, {account['masked']} hidden")
    1272 of 1501 samples of the tracker, 229 hidden
    """

    def export(self, path: Path | str, *, overwrite: bool = False) -> Path:
        """Write one file, atomically, in the format of its suffix.

        ``.csv`` is `estimate.csv` of the result folder: state, outputs, standard deviations, rounded to 12
        digits. ``.npz`` and ``.h5`` or ``.hdf5`` hold everything to the last bit, see
        `jaxekf.read_export`. ``.tum`` is the trajectory in the TUM format, ``timestamp tx ty tz qx qy qz
        qw``: the time on `clock` in seconds, exact to the nanosecond, the position (zero for a model
        without one) and the attitude, body to reference, scalar last.

        Parameters
        ----------
        path
            File to write.
        overwrite
            Replace an existing file.

        Returns
        -------
        The path.

        Raises
        ------
        RecordingError
            For another suffix and, without `overwrite`, for a file that exists.
        ModelError
            For a trajectory of a model without attitude.
        """
        form = export.format_of(path)
        with whole_file(path, overwrite=overwrite) as file:
            result_folder.write_file(self, form, file)
        return Path(path)

    def save(
        self,
        path: Path | str,
        *,
        overwrite: bool = False,
        exports: Iterable[str] = (),
        diagnosis: Mapping[str, Any] | None = None,
        score: Mapping[str, Any] | None = None,
    ) -> Path:
        """Write the result folder, atomically.

        ``estimate.csv`` state, outputs and standard deviations; ``covariance.npz`` full matrices;
        ``innovations_SENSOR.csv``, and all innovations to the last bit in ``innovations.npz``;
        ``noise.toml``, ``calibration.toml``; ``result.json`` summary, account, parameters and provenance
        with the hashes of the input files. After an estimate at requested times there is
        ``requested.csv`` with the columns of `estimate.csv` at those times, and the exports hold only them.

        Parameters
        ----------
        path
            Folder to write.
        overwrite
            Replace an existing result folder.
        exports
            Further files as by `export`: ``npz`` `estimate.npz`, ``hdf5`` `estimate.h5`, ``tum``
            `trajectory.tum`.
        diagnosis
            `Diagnosis.as_dict`, with its curves, for `jaxekf report`.
        score
            `Score.as_dict`, for `jaxekf report`.

        Returns
        -------
        The path.

        Raises
        ------
        RecordingError
            For an output that exists, and for an excerpt.
        """
        result_folder.write(
            self, path, overwrite=overwrite, exports=exports, diagnosis=diagnosis, score=score
        )
        return Path(path)
