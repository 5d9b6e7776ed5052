"""Accuracy against ground truth: RMSE of attitude, rate and position, and NEES."""

from typing import Any, NamedTuple

import numpy as np

from jaxekf._support import arrays
from jaxekf.estimation.result import Estimated
from jaxekf.recordings.truth import encoder_at, encoder_rate_at, encoder_velocity_at
from jaxekf.recordings.types import Floats, Optical, Recording, Times, to_scipy


class Score(NamedTuple):
    """Accuracy of one estimate on the scored samples of its encoder.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> found = jaxekf.score(jaxekf.estimate(run), run)
    >>> print(f"attitude {found.attitude_rmse_deg:.2f} deg, rate {found.rate_rmse_deg_s:.2f} deg/s")
    attitude 0.09 deg, rate 0.98 deg/s
    >>> print(f"NEES {found.attitude_nees:.2f} over {found.samples} samples")
    NEES 0.99 over 3001 samples
    >>> found.position_rmse_mm  # the model has no position
    nan
    """

    attitude_rmse_deg: float
    """Root mean square of the angle of the attitude error, deg."""
    rate_rmse_deg_s: float
    """Root mean square of the length of the rate's error, deg/s."""
    attitude_nees: float
    """Mean normalised estimation error squared per degree of freedom: 1 for a consistent filter, above 1
    for an overconfident one."""
    position_rmse_mm: float
    """Root mean square of the distance to the encoder's position, mm; NaN if either has no position."""
    position_nees: float
    """NEES of the position, as `attitude_nees`."""
    samples: int
    """Number of instants of the estimate that count."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return self._asdict()


def attitude_error(q: Floats, truth: Floats) -> Floats:
    """Rotation vectors (N, 3), rad, from `q` to `truth`, in the body frame of `q`.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.evaluation import metrics
    >>> identity, quarter_turn_about_z = np.eye(4)[:1], np.sqrt([[0.5, 0.0, 0.0, 0.5]])
    >>> np.rad2deg(metrics.attitude_error(identity, quarter_turn_about_z)).round(6).tolist()
    [[0.0, 0.0, 90.0]]
    """
    return (to_scipy(q).inv() * to_scipy(truth)).as_rotvec()


class OrientationError(NamedTuple):
    """Root mean square of the angle between estimate and truth, and of its two parts, degrees."""

    total_deg: float
    heading_deg: float
    """Rotation about the vertical."""
    inclination_deg: float
    """The remaining smallest rotation, which aligns the vertical."""


def orientation_error(
    q: Floats, truth: Floats, up: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> OrientationError:
    """Orientation errors as defined by the BROAD data set (Laidig et al. 2021), without heading alignment.

    Parameters
    ----------
    q, truth
        (N, 4) quaternions, body to reference.
    up
        Vertical in the reference frame.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.evaluation import metrics
    >>> identity, quarter_turn_about_z = np.eye(4)[:1], np.sqrt([[0.5, 0.0, 0.0, 0.5]])
    >>> [round(angle, 6) for angle in metrics.orientation_error(quarter_turn_about_z, identity)]
    [90.0, 90.0, 0.0]
    """
    off = (to_scipy(q) * to_scipy(truth).inv()).as_quat()
    vertical = np.asarray(up) / np.linalg.norm(up)
    about, scalar = np.abs(off[:, :3] @ vertical), np.abs(off[:, 3])
    total = 2.0 * np.arccos(np.clip(scalar, 0.0, 1.0))
    heading = 2.0 * np.arctan2(about, scalar)
    inclination = 2.0 * np.arccos(np.clip(np.hypot(about, scalar), 0.0, 1.0))
    return OrientationError(
        *(float(np.rad2deg(np.sqrt(np.mean(a**2)))) for a in (total, heading, inclination))
    )


def rms(values: Floats) -> float:
    """Root mean square of the lengths of vectors (N, d); NaN rows are ignored.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.evaluation import metrics
    >>> metrics.rms(np.array([[3.0, 4.0, 0.0], [np.nan, 0.0, 0.0]]))
    5.0
    """
    squared = np.sum(np.asarray(values) ** 2, axis=-1)
    squared = squared[np.isfinite(squared)]
    return float(np.sqrt(np.mean(squared))) if squared.size else float("nan")


def normalised_square(error: Floats, cov: Floats) -> Floats:
    """``e' inv(P) e`` (N,) of errors (N, d) and covariances (N, d, d).

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.evaluation import metrics
    >>> error, cov = np.array([[2.0, 6.0]]), np.diag([4.0, 9.0])[None]
    >>> metrics.normalised_square(error, cov).tolist()  # 1^2 + 2^2
    [5.0]
    """
    return np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0])


def mean_nees(error: Floats, cov: Floats) -> float:
    """Mean of ``e' inv(P) e / d`` over errors (N, d) and covariances (N, d, d); NaN for none.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxekf.evaluation import metrics
    >>> error, cov = np.array([[0.1, -0.1, 0.1]]), 0.01 * np.eye(3)[None]
    >>> round(metrics.mean_nees(error, cov), 6)  # errors as large as their deviations
    1.0
    """
    squared = normalised_square(error, cov)
    return float(np.mean(squared) / error.shape[1]) if squared.size else float("nan")


def scored_errors(estimate: Estimated, recording: Recording) -> dict[str, Floats]:
    """Errors (N, 3) of the outputs attitude, rate, position and velocity against the encoder.

    Attitude errors are rotation vectors in the body frame, all in SI units. Instants whose nearest encoder
    sample is not scored or not known are NaN.

    Raises
    ------
    RecordingError
        If the run has no encoder.
    """
    encoder, outputs = recording.need_encoder(), estimate.outputs
    truth = encoder_at(encoder, estimate.time_ns)
    errors: dict[str, Floats] = {}
    if "attitude" in outputs:
        errors["attitude"] = attitude_error(outputs["attitude"].value, truth.q_ref_body)
    if "rate" in outputs:
        errors["rate"] = outputs["rate"].value - encoder_rate_at(encoder, estimate.time_ns)
    if "position" in outputs and truth.position is not None:
        errors["position"] = outputs["position"].value - truth.position
    if "velocity" in outputs and truth.position is not None:
        velocity = encoder_velocity_at(encoder, estimate.time_ns)
        errors["velocity"] = outputs["velocity"].value - velocity
    return {name: np.where(truth.scored[:, None], e, np.nan) for name, e in errors.items()}


def score(estimate: Estimated, recording: Recording, burn_in_s: float = 0.0) -> Score:
    """RMSE of attitude, rate and position, and NEES of attitude and position.

    Errors count at instants of the estimate whose nearest encoder sample is scored, from `burn_in_s`
    on. A quantity that the model or the encoder does not provide is NaN. Positions are those of the
    body's origin in the reference frame.

    Parameters
    ----------
    estimate
        The estimate.
    recording
        Its recording, with an encoder.
    burn_in_s
        Seconds at the start that do not count.

    Returns
    -------
    Score
        RMSE in deg, deg/s and mm; NEES divided by its degrees of freedom.

    Raises
    ------
    RecordingError
        If the run has no encoder.

    Examples
    --------
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> found = jaxekf.score(jaxekf.estimate(run), run)
    >>> print(f"{found.attitude_rmse_deg:.3f} deg, NEES {found.attitude_nees:.2f}")
    0.094 deg, NEES 0.99
    """
    arrays.need(recording, Recording, "recording", "jaxekf.load(path)")
    if not hasattr(estimate, "outputs"):
        got = f"a value of type {type(estimate).__name__}"
        raise arrays.argument("estimate")(got, "an estimate", "the result of jaxekf.estimate")
    burn_in_s = arrays.number(burn_in_s, arrays.argument("burn_in_s"))
    judged = encoder_at(recording.need_encoder(), estimate.time_ns).scored
    judged = judged & (estimate.time >= burn_in_s)
    errors = scored_errors(estimate, recording)

    def rmse(name: str) -> float:
        return rms(errors[name][judged]) if name in errors else float("nan")

    def nees(name: str) -> float:
        if name not in errors:
            return float("nan")
        # A blank position of the encoder is ignored.
        known = judged & np.isfinite(errors[name]).all(axis=1)
        return mean_nees(errors[name][known], estimate.outputs[name].cov[known])

    attitude, rate = (float(np.rad2deg(rmse(name))) for name in ("attitude", "rate"))
    position = 1e3 * rmse("position"), nees("position")
    return Score(attitude, rate, nees("attitude"), *position, int(judged.sum()))


def hold_last(optical: Optical, time_ns: Times) -> Floats:
    """The last visible attitude (N, 4) of the tracker at each time: the baseline without a filter."""
    rows = np.flatnonzero(optical.valid)
    at = np.searchsorted(optical.time_ns[rows], time_ns, side="right") - 1
    return optical.q_ref_body[rows[np.maximum(at, 0)]]


def score_hold_last(recording: Recording, time_ns: Times) -> float:
    """Attitude RMSE, degrees, of the baseline `hold_last` on the encoder's scored samples.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.evaluation import metrics
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> round(metrics.score_hold_last(run, run.need_imu().time_ns), 1)  # deg, mostly of occlusions
    12.4
    """
    truth = encoder_at(recording.need_encoder(), time_ns)
    held = hold_last(recording.need_optical(), time_ns)
    error = attitude_error(held[truth.scored], truth.q_ref_body[truth.scored])
    return float(np.rad2deg(rms(error)))


def score_raw_rate(recording: Recording) -> float:
    """Rate RMSE, deg/s, of the gyroscope's samples, bias and noise included."""
    imu = recording.need_imu()
    scored = encoder_at(recording.need_encoder(), imu.time_ns).scored
    error = imu.gyroscope - encoder_rate_at(recording.need_encoder(), imu.time_ns)
    return float(np.rad2deg(rms(error[scored])))
