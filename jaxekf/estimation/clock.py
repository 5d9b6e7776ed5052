"""The clock of an estimate's times: the IMU's, the tracker's, or the one that all streams share."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from jaxekf._support.errors import ModelError
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import NANOSECONDS, Recording, Times

ClockName = Literal["imu", "tracker"]
RECORDING = "recording"
"""Name of the clock of a model without an offset between two clocks."""


@dataclass(frozen=True)
class Clock:
    """The clock of an estimate's times, and how the IMU's clock differs from the tracker's.

    Times of the tracker are those at which its samples were taken, without the stream's stated `latency`.

    Examples
    --------
    The tracker's stamps are 0.2 s late, so that the IMU's clock reads 0.2 s less at the same instant:

    >>> import numpy as np
    >>> import jaxekf
    >>> clock = jaxekf.Clock("imu", offset_s=-0.2)
    >>> clock.from_tracker(np.array([1_000_000_000]))
    array([800000000])
    >>> clock.from_imu(np.array([800_000_000]))
    array([800000000])
    """

    name: str = RECORDING
    """``imu``, ``tracker``, or ``recording`` for a model without an offset between two clocks."""
    offset_s: float = 0.0
    """IMU's clock minus the tracker's at `start_ns`, s."""
    drift: float = 0.0
    """Growth of the offset, s per s of the tracker's clock."""
    start_ns: int = 0
    """Start of the estimate on the tracker's clock, ns."""

    def imu_from_tracker(self, time_ns: Times) -> Times:
        """Times (N,) of the tracker's clock on the IMU's, ns."""
        return self._shifted(time_ns, self.offset_s, self.drift, self.start_ns)

    def tracker_from_imu(self, time_ns: Times) -> Times:
        """Times (N,) of the IMU's clock on the tracker's, ns."""
        drift = self.drift / (1.0 + self.drift)
        start = self.start_ns + round(self.offset_s * NANOSECONDS)
        return self._shifted(time_ns, -self.offset_s, -drift, start)

    def from_tracker(self, time_ns: Times) -> Times:
        """Times (N,) of the tracker's clock on that of the estimate, ns."""
        return self.imu_from_tracker(time_ns) if self.name == "imu" else time_ns

    def from_imu(self, time_ns: Times) -> Times:
        """Times (N,) of the IMU's clock on that of the estimate, ns."""
        return self.tracker_from_imu(time_ns) if self.name == "tracker" else time_ns

    def to_imu(self, time_ns: Times) -> Times:
        """Times (N,) of the estimate on the IMU's clock, ns."""
        return self.imu_from_tracker(time_ns) if self.name == "tracker" else time_ns

    def to_encoder(self, time_ns: Times, recording: Recording) -> Times:
        """Times (N,) of the estimate on the clock of the recording's encoder, ns.

        That is the IMU's, or the tracker's for ``clock = "tracker"`` in the encoder's section.
        """
        if recording.info.get("encoder_about", {}).get("clock", "imu") == "imu":
            return self.to_imu(time_ns)
        return self.tracker_from_imu(time_ns) if self.name == "imu" else time_ns

    def starting_with(self, imu_ns: int) -> "Clock":
        """The same clock for an estimate that starts at a time of the IMU's clock."""
        return replace(self, start_ns=imu_ns - round(self.offset_s * NANOSECONDS))

    @property
    def label(self) -> str:
        """Words for the axis of a figure; empty for a recording with one clock."""
        owner = {"imu": "IMU", "tracker": "tracker"}.get(self.name)
        return "" if owner is None else f" on the {owner}'s clock"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "name": self.name,
            "offset_s": self.offset_s,
            "drift": self.drift,
            "start_ns": self.start_ns,
        }

    @staticmethod
    def _shifted(time_ns: Times, offset_s: float, drift: float, start_ns: int) -> Times:
        if offset_s == 0.0 and drift == 0.0:
            return time_ns
        grown = drift * (np.asarray(time_ns) - start_ns)
        return time_ns + np.round(offset_s * NANOSECONDS + grown).astype(np.int64)


def clock_of(model: Model, params: Parameters, name: str) -> Clock:
    """The clock of a model's estimates, whose start is not known yet.

    Raises
    ------
    ModelError
        The name is not that of a clock, or the drift makes time run backwards.
    """
    if name not in ("imu", "tracker"):
        raise ModelError(
            f"got the clock {name!r}, expected 'imu' or 'tracker'; leave it out for 'imu'"
        )
    offset, drift = 0.0, 0.0
    if model.input is None or not (model.input.clock_offset or model.input.clock_drift):
        return Clock()
    if model.input.clock_offset is not None:
        offset = float(model.input.clock_offset(params))
    if model.input.clock_drift is not None:
        drift = float(model.input.clock_drift(params))
    if not (np.isfinite(offset) and abs(drift) < 0.5):
        raise ModelError(
            f"model '{model.name}' got a clock offset of {offset} s and a drift of {drift} s/s, expected a"
            " finite offset and a drift of less than 0.5; look at calibration.toml"
        )
    return Clock(name, offset, drift)
