"""How good an estimate is: error against truth, and whether its uncertainty is honest."""

from typing import Any, NamedTuple

import numpy as np

from jaxekf.recording import (
    Floats,
    Optical,
    Recording,
    Times,
    to_scipy,
)
from jaxekf.result import Estimate
from jaxekf.truth import encoder_at, encoder_rate_at


class Score(NamedTuple):
    """Agreement of one estimate with its encoder on the scored samples."""

    attitude_rmse_deg: float
    rate_rmse_deg_s: float
    attitude_nees: float
    """Mean normalised estimation error squared by degree of freedom: 1 where honest, above 1 where
    overconfident."""
    samples: int

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return self._asdict()


def attitude_error(q: Floats, truth: Floats) -> Floats:
    """Rotation vectors (N, 3) in radians from `q` to `truth`, in the body frame of `q`."""
    return (to_scipy(q).inv() * to_scipy(truth)).as_rotvec()


def rms(values: Floats) -> float:
    """Root of the mean square of the lengths of vectors (N, d); NaN rows do not count."""
    squared = np.sum(np.asarray(values) ** 2, axis=-1)
    squared = squared[np.isfinite(squared)]
    return float(np.sqrt(np.mean(squared))) if squared.size else float("nan")


def normalised_square(error: Floats, cov: Floats) -> Floats:
    """``e' inv(P) e`` for each of (N, d), (N, d, d)."""
    return np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0])


def score(estimate: Estimate, recording: Recording, burn_in_s: float = 0.0) -> Score:
    """Attitude and rate error, and attitude NEES, at those instants of the estimate whose nearest
    encoder sample is scored; NaN for what the model does not put out."""
    truth = encoder_at(recording.need_encoder(), estimate.time_ns)
    judged = truth.scored & (estimate.time >= burn_in_s)
    attitude = rate = nees = float("nan")
    if "attitude" in estimate.outputs:
        error = attitude_error(estimate.attitude.value[judged], truth.q_ref_body[judged])
        attitude = float(np.rad2deg(rms(error)))
        squared = normalised_square(error, estimate.attitude.cov[judged])
        nees = float(np.mean(squared) / 3.0) if squared.size else nees
    if "rate" in estimate.outputs:
        true_rate = encoder_rate_at(recording.need_encoder(), estimate.time_ns)[judged]
        rate = float(np.rad2deg(rms(estimate.rate.value[judged] - true_rate)))
    return Score(attitude, rate, nees, int(judged.sum()))


def hold_last(optical: Optical, time_ns: Times) -> Floats:
    """The last visible tracker attitude (N, 4) at each time: what there is without a filter."""
    seen = np.flatnonzero(optical.valid)
    at = np.searchsorted(optical.time_ns[seen], time_ns, side="right") - 1
    return optical.q_ref_body[seen[np.maximum(at, 0)]]


def score_hold_last(recording: Recording, time_ns: Times) -> float:
    """Attitude RMSE in degrees of holding the tracker, on the encoder's scored samples."""
    truth = encoder_at(recording.need_encoder(), time_ns)
    held = hold_last(recording.need_optical(), time_ns)
    error = attitude_error(held[truth.scored], truth.q_ref_body[truth.scored])
    return float(np.rad2deg(rms(error)))


def score_raw_rate(recording: Recording) -> float:
    """Rate RMSE in deg/s of the gyroscope as it is, bias and noise included."""
    imu = recording.need_imu()
    scored = encoder_at(recording.need_encoder(), imu.time_ns).scored
    error = imu.gyroscope - encoder_rate_at(recording.need_encoder(), imu.time_ns)
    return float(np.rad2deg(rms(error[scored])))
