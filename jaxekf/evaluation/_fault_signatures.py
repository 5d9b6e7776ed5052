"""Signatures of faults in the innovations of a tracked attitude, and their estimated sizes.

A tracker with latency ``t`` has the measurement error ``-t w``; a gyroscope with a constant bias ``b`` or a
wrong matrix ``I + E`` rotates the prediction wrongly by ``-b`` or ``E w`` per second. The filter's gains
determine the part that remains in the innovations: to first order the innovations are linear in the fault,
and least squares estimates its size and uncertainty. A consistent filter has white innovations, in which no
fault is significant.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import uniform_filter1d

from jaxekf.estimation.result import Estimate
from jaxekf.evaluation.consistency import inflation, on_grid, whiten
from jaxekf.geometry import manifold
from jaxekf.geometry.manifold import SO3
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Times, to_scipy

LATENCY, BIAS, MATRIX = slice(0, 1), slice(1, 4), slice(4, 13)
_WIDE = np.array([10.0] + [10.0] * 3 + [10.0] * 9)
"""Prior standard deviations (s, rad/s, 1) of the faults: keep unobservable faults near zero."""
_SMOOTH_S = 0.1


@dataclass(frozen=True)
class Faults:
    """Sizes of the faults that explain the innovations of one attitude sensor best."""

    size: Floats
    """(13,): latency in s, bias in rad/s (3), gyroscope matrix minus identity (9, by rows)."""
    cov: Floats
    """(13, 13), with the autocorrelation of the residuals."""
    rows: int
    """Number of innovation rows used."""
    information: Floats
    """(13, 13) inverse covariance for white residuals of variance 1."""
    time_ns: Times
    left: Floats
    """(N, 3) whitened innovations without the faults; NaN for unused samples."""
    memory_s: float
    """Time constant of the filter's attitude under this sensor, s."""
    judged: tuple[slice, ...]
    """The faults that were estimated."""

    def sigma(self, part: slice) -> Floats:
        """Standard deviations of a part of the sizes."""
        return np.sqrt(np.diagonal(self.cov)[part])

    def wald(self, part: slice) -> float:
        """Chi-square of the hypothesis that a part of the sizes is zero."""
        size = self.size[part]
        return float(size @ np.linalg.solve(self.cov[part, part], size))

    def effect(self, part: slice) -> float:
        """Root mean square contribution of a part to the whitened innovations, relative to their noise."""
        size = self.size[part]
        square = size @ self.information[part, part] @ size / max(self.rows, 1)
        return float(np.sqrt(square / max(float(np.nanmean(self.left**2)), 1.0)))


def attitude_rows(estimate: Estimate, sensor: str) -> slice | None:
    """Rows of a sensor that measure an attitude of the body; None if there are none."""
    spaces = (estimate.model.sensor(sensor).space, estimate.model.space)
    found = [
        [part.error for part in manifold.parts(space) if isinstance(part.manifold, SO3)]
        for space in spaces
    ]
    known = {"attitude", "rate"} <= estimate.outputs.keys()
    return found[0][0] if known and found[0] and found[1] else None


def find_faults(estimate: Estimate, sensor: str) -> Faults | None:
    """Latency of a tracker, and bias and matrix errors of the gyroscope.

    Only the latency is estimated from a smoothed estimate, which does not hold the filter's covariance.

    Returns
    -------
    None for a sensor without attitude, a sensor whose noise depends on vectors read with each sample, and a
    model without attitude and rate.
    """
    rows = attitude_rows(estimate, sensor)
    record = estimate.sensors[sensor]
    if rows is None or len(record.time_ns) < 3 or _noise_depends_on_vectors(estimate, sensor):
        return None
    used = record.used[:, rows].all(axis=1)
    time_ns, cov = record.time_ns, record.cov[:, rows, rows]
    gain, bias_gain = _gains(estimate, sensor, rows, cov, used)
    each = _signatures(estimate, time_ns, gain, bias_gain)
    used_rows = used & (np.arange(len(used)) > 0)
    mask = np.repeat(used_rows[:, None], 3, axis=1)
    white = whiten(record.residual[:, rows], cov, mask)
    white_each = np.zeros_like(each)
    factor = np.linalg.cholesky(cov[used_rows])
    white_each[used_rows] = np.linalg.solve(factor, each[used_rows])
    judged = (LATENCY,) if estimate.smoothed else (LATENCY, BIAS, MATRIX)
    chosen = np.r_[judged]
    x, y = white_each[used_rows][:, :, chosen].reshape(-1, len(chosen)), white[used_rows].ravel()
    information = x.T @ x
    narrow = np.diag(_WIDE[chosen] ** -2)
    size = np.linalg.solve(information + narrow, x.T @ y)
    left = white - white_each[:, :, chosen] @ size
    variance = max(float(np.nanmean(left**2)), 1.0) * inflation([on_grid(time_ns, left)])
    steps = np.diff(time_ns) / NANOSECONDS
    rate = np.trace(gain[1:], axis1=1, axis2=2)[used[1:]] / 3.0
    memory = float(np.median(steps)) / max(float(np.median(rate)) if rate.size else 1.0, 1e-6)
    return Faults(
        _among_all_faults(size, chosen),
        _among_all_faults(np.linalg.inv(information / variance + narrow), chosen),
        int(used_rows.sum()) * 3,
        _among_all_faults(information, chosen),
        time_ns,
        left,
        memory,
        judged,
    )


def _noise_depends_on_vectors(estimate: Estimate, sensor: str) -> bool:
    """Whether the noise depends on vectors in the body frame, which no record keeps.

    That noise rotates with the body, so the gain computed from `typical_aux` would be wrong.
    """
    leaves = jax.tree.leaves(estimate.model.sensor(sensor).typical_aux)
    return any(np.ndim(leaf) > 0 for leaf in leaves)


def _among_all_faults(values: Any, chosen: Any) -> Floats:
    """Values of the chosen faults among all 13."""
    full = np.zeros((13,) * values.ndim)
    full[np.ix_(*[chosen] * values.ndim)] = values
    return full


def _gains(
    estimate: Estimate, sensor: str, rows: slice, cov: Floats, used: Flags
) -> tuple[Any, Any]:
    """Gains of the attitude and of the gyroscope's bias for an innovation (N, 3), (N, 3, 3) each."""
    described = estimate.model.sensor(sensor)
    record = estimate.sensors[sensor]
    step = jnp.asarray(float(np.median(np.diff(record.time_ns))) / NANOSECONDS)
    noise = np.asarray(described.noise(estimate.params, described.typical_aux, step))
    noise = noise[rows, rows]
    # H is the identity here: the gain is (S - R) inv(S) = P+ inv(R).
    gain = np.linalg.solve(cov, cov - noise).transpose(0, 2, 1)
    bias_gain = np.zeros_like(gain)
    parts = {part.name: part for part in manifold.parts(estimate.model.space)}
    attitude = next(p.error for p in parts.values() if isinstance(p.manifold, SO3))
    bias = parts.get("bias")
    if bias is not None and bias.manifold.unit == "rad/s" and not estimate.smoothed:
        cross = estimate.cov[_index_at(estimate, record.time_ns)][:, bias.error, attitude]
        bias_gain = np.linalg.solve(noise, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
    off = ~used
    gain[off], bias_gain[off] = 0.0, 0.0
    return gain, bias_gain


def _index_at(estimate: Estimate, time_ns: Times) -> Any:
    """Index of the instant at each time, or of the one before."""
    return np.maximum(np.searchsorted(estimate.time_ns, time_ns, side="right") - 1, 0)


def _signatures(estimate: Estimate, time_ns: Times, gain: Floats, bias_gain: Floats) -> Floats:
    """Derivative (N, 3, 13) of the innovations by each fault.

    The attitude error ``a`` (from estimate to truth, on the right) and the bias error ``c`` caused by
    the fault obey ``a- = T a + c dt + u``, ``e = a- + d``, ``a = a- - K e``, ``c = c + L e``.
    """
    at = _index_at(estimate, time_ns)
    clock = (estimate.time_ns - estimate.time_ns[0]) / NANOSECONDS
    rate, attitude = estimate.rate.value, to_scipy(estimate.attitude.value[at])
    integral = cumulative_trapezoid(rate, clock, axis=0, initial=0.0)[at]
    # The gyroscope's own noise is in the innovations, too, and must not be taken for latency.
    window = max(1, round(_SMOOTH_S / max(float(np.median(np.diff(clock))), 1e-9)))
    smooth = uniform_filter1d(rate, window, axis=0, mode="nearest")
    count = len(time_ns)
    dt = np.diff(time_ns) / NANOSECONDS
    turn = np.diff(integral, axis=0)
    eye = np.eye(3)
    pushed, moved = np.zeros((count, 3, 13)), np.zeros((count, 3, 13))
    pushed[1:, :, BIAS] = -dt[:, None, None] * eye
    pushed[1:, :, MATRIX] = np.einsum("ij,nk->nijk", eye, turn).reshape(count - 1, 3, 9)
    moved[:, :, 0] = -smooth[at]
    carried = np.zeros((count, 3, 6))
    carried[1:, :, :3] = (attitude[1:].inv() * attitude[:-1]).as_matrix()
    carried[1:, :, 3:] = dt[:, None, None] * eye
    kept = eye - gain
    closed = np.concatenate([kept @ carried, bias_gain @ carried], axis=1)
    closed[:, 3:, 3:] += eye
    forced = np.concatenate([kept @ pushed - gain @ moved, bias_gain @ (pushed + moved)], axis=1)
    found = pushed + moved
    # The run starts from its first sample, so the attitude begins with that sample's error.
    state = np.zeros((6, 13))
    state[:3] = -moved[0]
    for k in range(1, count):
        found[k] += carried[k] @ state
        state = closed[k] @ state + forced[k]
    found[0] = 0.0
    return found
