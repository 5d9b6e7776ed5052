"""A plain extended Kalman filter in NumPy, slow and explicit, to hold the package against.

One run, one step at a time, in the textbook matrix form, every Jacobian written by hand. It shares
no code with the package. Quaternions are ``w, x, y, z``, body to reference; attitude errors act on
the right (body frame).
"""

import numpy as np


def product(p, q):
    """Hamilton product."""
    return np.concatenate(
        [[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])]
    )


def conjugate(q):
    """Inverse of a unit quaternion."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def exp(v):
    """Quaternion of a rotation vector; ``np.sinc`` carries the limit at zero."""
    angle = np.sqrt(v @ v)
    return np.concatenate([[np.cos(0.5 * angle)], 0.5 * np.sinc(angle / (2.0 * np.pi)) * v])


def log(q):
    """Rotation vector, of length at most pi, of ``q`` or ``-q``."""
    q = -q if q[0] < 0.0 else q
    length = np.sqrt(q[1:] @ q[1:])
    return (2.0 * np.arctan2(length, q[0]) / length if length > 0.0 else 2.0) * q[1:]


def matrix(q):
    """Rotation matrix, ``v_ref = matrix(q) @ v_body``."""
    w, v = q[0], q[1:]
    return (w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * skew(v)


def skew(v):
    """Matrix of the cross product."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def left_matrix(q):
    """``left_matrix(q) @ p == product(q, p)``."""
    lower = np.column_stack([q[1:], q[0] * np.eye(3) + skew(q[1:])])
    return np.vstack([np.concatenate([[q[0]], -q[1:]]), lower])


def attitude_errors(q, estimates):
    """Rotation vectors (N, 3), in the body frame of ``q``, that take it to `estimates` (N, 4)."""
    turned = np.asarray(estimates) @ left_matrix(conjugate(np.asarray(q))).T
    turned *= np.where(turned[:, :1] < 0.0, -1.0, 1.0)
    length = np.sqrt(np.sum(turned[:, 1:] ** 2, axis=1, keepdims=True))
    return 2.0 * np.arctan2(length, turned[:, :1]) / length * turned[:, 1:]


def right_jacobian(v):
    """``exp(v + e) ~ exp(v) exp(right_jacobian(v) e)``."""
    angle = np.sqrt(v @ v)
    first = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    if angle < 0.2:
        a = angle * angle
        second = (1.0 - a / 20.0 * (1.0 - a / 42.0 * (1.0 - a / 72.0 * (1.0 - a / 110.0)))) / 6.0
    else:
        second = (angle - np.sin(angle)) / angle**3
    return np.eye(3) - first * skew(v) + second * skew(v) @ skew(v)


def exp_derivative(v):
    """Derivative (4, 3) of `exp`."""
    angle = np.sqrt(v @ v)
    sine = 0.5 * np.sinc(angle / (2.0 * np.pi))
    if angle < 0.2:
        a = angle * angle
        slope = -(1.0 - a / 40.0 * (1.0 - a / 112.0 * (1.0 - a / 216.0 * (1.0 - a / 352.0)))) / 24.0
    else:
        slope = (0.5 * angle * np.cos(0.5 * angle) - np.sin(0.5 * angle)) / angle**3
    return np.vstack([-0.5 * sine * v, sine * np.eye(3) + slope * np.outer(v, v)])


def interval_mean(knot_time, knot_value, begin, end):
    """Mean over [begin, end] of samples joined by straight lines, held beyond the ends."""
    inner = knot_time[(knot_time > begin) & (knot_time < end)]
    points = np.concatenate([[begin], inner, [end]])
    values = np.column_stack([np.interp(points, knot_time, column) for column in knot_value.T])
    if end == begin:
        return values[0]
    areas = 0.5 * (values[1:] + values[:-1]) * np.diff(points)[:, None]
    return areas.sum(axis=0) / (end - begin)


class Loose:
    """State (q, bias); the rate ``matrix (u - bias - noise)`` drives q, which is measured."""

    def __init__(self, *, gyroscope, bias_walk, optical, gyroscope_matrix):
        self.gyroscope, self.bias_walk, self.optical = gyroscope, bias_walk, optical
        self.gyroscope_matrix = gyroscope_matrix

    def predict(self, x, u, dt):
        q, bias = x
        turn = self.gyroscope_matrix @ (u - bias) * dt
        jacobian = right_jacobian(turn)
        f = np.eye(6)
        f[:3, :3] = matrix(exp(turn)).T
        f[:3, 3:] = -jacobian @ self.gyroscope_matrix * dt
        g = np.eye(6)
        g[:3, :3] = jacobian
        through = self.gyroscope_matrix
        sigma = np.zeros((6, 6))
        sigma[:3, :3] = through @ (self.gyroscope * dt + self.bias_walk * dt**3 / 3.0) @ through.T
        sigma[:3, 3:] = -0.5 * through @ self.bias_walk * dt**2
        sigma[3:, :3] = sigma[:3, 3:].T
        sigma[3:, 3:] = self.bias_walk * dt
        return (product(q, exp(turn)), bias), f, g @ sigma @ g.T

    def measure(self, name, x, value, dt):
        assert name == "optical"
        return log(product(conjugate(x[0]), value)), np.eye(3, 6), self.optical

    def correct(self, x, delta):
        reset = np.eye(6)
        reset[:3, :3] = right_jacobian(delta[:3])
        return (product(x[0], exp(delta[:3])), x[1] + delta[3:]), reset


class LooseRate:
    """State (q, rate, bias) in the body frame; the attitude and the rate plus bias are measured."""

    def __init__(self, *, acceleration, gyroscope, bias_walk, optical):
        self.acceleration, self.gyroscope = acceleration, gyroscope
        self.bias_walk, self.optical = bias_walk, optical

    def predict(self, x, u, dt):
        q, rate, bias = x
        turn = rate * dt
        jacobian = right_jacobian(turn)
        f = np.eye(9)
        f[:3, :3] = matrix(exp(turn)).T
        f[:3, 3:6] = jacobian * dt
        g = np.eye(9)
        g[:3, :3] = jacobian
        sigma = np.zeros((9, 9))
        sigma[:3, :3] = self.acceleration * dt**3 / 3.0
        sigma[:3, 3:6] = sigma[3:6, :3] = 0.5 * self.acceleration * dt**2
        sigma[3:6, 3:6] = self.acceleration * dt
        sigma[6:, 6:] = self.bias_walk * dt
        return (product(q, exp(turn)), rate, bias), f, g @ sigma @ g.T

    def measure(self, name, x, value, dt):
        q, rate, bias = x
        if name == "optical":
            return log(product(conjugate(q), value)), np.eye(3, 9), self.optical
        h = np.hstack([np.zeros((3, 3)), np.eye(3), np.eye(3)])
        return value - rate - bias, h, self.gyroscope / dt

    def correct(self, x, delta):
        reset = np.eye(9)
        reset[:3, :3] = right_jacobian(delta[:3])
        moved = (product(x[0], exp(delta[:3])), x[1] + delta[3:6], x[2] + delta[6:])
        return moved, reset


class LooseAdditive:
    """State (q, rate, bias) with the rate in the reference frame and all errors added."""

    def __init__(self, *, quaternion, acceleration, bias_walk, optical, gyroscope):
        self.quaternion, self.acceleration, self.bias_walk = quaternion, acceleration, bias_walk
        self.optical, self.gyroscope = optical, gyroscope

    def predict(self, x, u, dt):
        q, rate, bias = x
        turn = exp(rate * dt)
        f = np.eye(10)
        f[:4, :4] = left_matrix(turn)
        derivative = exp_derivative(rate * dt) * dt
        f[:4, 4:7] = np.column_stack([product(column, q) for column in derivative.T])
        sigma = np.zeros((10, 10))
        sigma[:4, :4] = self.quaternion * dt
        sigma[4:7, 4:7] = self.acceleration * dt
        sigma[7:, 7:] = self.bias_walk * dt
        return (product(turn, q), rate, bias), f, sigma

    def measure(self, name, x, value, dt):
        q, rate, bias = x
        if name == "optical":
            return (value if value @ q >= 0.0 else -value) - q, np.eye(4, 10), self.optical
        h = np.hstack([np.zeros((3, 4)), np.eye(3), np.eye(3)])
        return value - rate - bias, h, self.gyroscope

    def correct(self, x, delta):
        q = x[0] + delta[:4]
        moved = (q / np.sqrt(q @ q), x[1] + delta[4:7], x[2] + delta[7:])
        return moved, np.eye(10)


def run(system, mean, cov, events):
    """Filter `events`, a list of ``dt, u, samples`` with samples ``{name: (value, mask, dt)}``.

    Returns a list with one dict for each event. Residuals are 0, and their covariance that of the
    identity, where a row is hidden.
    """
    results = []
    for dt, u, samples in events:
        mean, f, noise = system.predict(mean, u, dt)
        cov = f @ cov @ f.T + noise
        result = {"predicted": (mean, cov), "innovations": {}, "log_likelihood": 0.0}
        residuals, slopes, noises = [], [], []
        for name, (value, mask, since) in samples.items():
            e, h, r = system.measure(name, mean, value, since)
            s = h @ cov @ h.T + r
            shown = np.where(mask[:, None] & mask[None, :], s, np.eye(len(mask)))
            seen = e[mask]
            nis = seen @ np.linalg.solve(s[np.ix_(mask, mask)], seen) if mask.any() else 0.0
            result["innovations"][name] = (np.where(mask, e, 0.0), shown, nis)
            if mask.any():
                residuals.append(seen)
                slopes.append(h[mask])
                noises.append(r[np.ix_(mask, mask)])
        if residuals:
            e, h, r = np.concatenate(residuals), np.vstack(slopes), block_diagonal(noises)
            s = h @ cov @ h.T + r
            gain = cov @ h.T @ np.linalg.inv(s)
            rest = np.eye(len(cov)) - gain @ h
            mean, reset = system.correct(mean, gain @ e)
            cov = reset @ (rest @ cov @ rest.T + gain @ r @ gain.T) @ reset.T
            _, log_det = np.linalg.slogdet(s)
            quadratic = e @ np.linalg.solve(s, e)
            result["log_likelihood"] = -0.5 * (quadratic + log_det + len(e) * np.log(2.0 * np.pi))
        result["updated"] = (mean, cov)
        results.append(result)
    return results


def block_diagonal(blocks):
    """The blocks along a diagonal of zeros."""
    size = sum(len(block) for block in blocks)
    whole, start = np.zeros((size, size)), 0
    for block in blocks:
        whole[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    return whole
