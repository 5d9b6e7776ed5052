"""Rotation of a gyroscope over time: the ordered product of its small rotations, no sum of rates."""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxekf.geometry.host_rotation import running_product
from jaxekf.recordings.types import Floats, from_scipy, to_scipy


class RotationsAt(NamedTuple):
    """Integral of the gyroscope's rate at some times."""

    q: Rotation
    """IMU frame to a fixed frame that may be any."""
    rate: Floats
    """(N, 3) rad/s."""
    q_integral: Floats
    """(N, 3, 3) s: integral over time of `q` as a matrix, the derivative by a bias."""


class GyroscopeIntegral:
    """Integral of rates that are linear between samples; each step rotates by their mean.

    Parameters
    ----------
    known
        (N,) sample times, s, two or more.
    rate
        (N, 3) rad/s.
    """

    def __init__(self, known: Floats, rate: Floats) -> None:
        self.known, self.rate = known, rate
        step = np.diff(known)
        steps = Rotation.from_rotvec(0.5 * (rate[1:] + rate[:-1]) * step[:, None])
        self.q = to_scipy(running_product(from_scipy(steps)))
        self.matrix = self.q.as_matrix()
        slabs = 0.5 * (self.matrix[1:] + self.matrix[:-1]) * step[:, None, None]
        self.q_integral = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(slabs, axis=0)])

    def at(self, time: Floats) -> RotationsAt:
        """Attitude, rate and integral of the attitude at times (N,), s."""
        q, low, since, rate = self._between(time)
        half = 0.5 * (self.matrix[low] + q.as_matrix()) * since[:, :, None]
        return RotationsAt(q, rate, self.q_integral[low] + half)

    def rotation(self, begin: Floats, end: Floats) -> Rotation:
        """Rotations between times `begin` and `end` (N,), s, in the IMU frame."""
        return self._between(begin)[0].inv() * self._between(end)[0]

    def _between(self, time: Floats) -> tuple[Rotation, Any, Floats, Floats]:
        known, rate = self.known, self.rate
        low: Any = np.clip(np.searchsorted(known, time, side="right") - 1, 0, len(known) - 2)
        since = (time - known[low])[:, None]
        slope = (rate[low + 1] - rate[low]) / (known[low + 1] - known[low])[:, None]
        q = self.q[low] * Rotation.from_rotvec((rate[low] + 0.5 * slope * since) * since)
        return q, low, since, rate[low] + slope * since
