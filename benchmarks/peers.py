"""The same problem with other packages, each as one filter function."""

import importlib.util
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from problem import DT, MEAN, MODEL, VARIANCE, Noise, observe, parameters, start, steps, turn

from jaxekf import run_filter_batch

YARDSTICK = Path(
    os.environ.get("JAXEKF_YARDSTICK", Path(__file__).parents[2] / "shared" / "yardstick")
)
"""Folder of the sources of the two C++ programs."""
Filter = Callable[[Noise, Any], tuple[Any, Any]]
"""``filter(noise, given)``: means (runs, T, 10) and the summed log-likelihood."""


def available(name: str) -> bool:
    """Whether a package can be imported."""
    return importlib.util.find_spec(name) is not None


def ours(noise: Noise, given: Any) -> tuple[Any, Any]:
    """This package, on all devices."""
    runs = given.dt.shape[0]
    params = jax.tree.map(lambda a: jnp.broadcast_to(a, (runs, *jnp.shape(a))), parameters(noise))
    devices = jax.devices() if len(jax.devices()) > 1 else ()
    output = run_filter_batch(MODEL, params, start(runs), given, keep="means", devices=devices)
    mean = jnp.concatenate(jax.tree.leaves(output.instants.updated.mean), axis=-1)
    return mean[:, :, 0], jnp.sum(output.instants.log_likelihood)


def given_to_ours(z: np.ndarray) -> Any:
    """The steps, with the runs distributed over the devices."""
    arrays = steps(z)
    if len(jax.devices()) == 1 or z.shape[0] < 2 * 16:
        return jax.tree.map(jnp.asarray, arrays)
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("runs",))
    return jax.device_put(
        arrays, jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("runs"))
    )


def over_runs(one: Callable[[Noise, Any], tuple[Any, Any]]) -> Filter:
    """A filter of one run, vectorised over runs by `vmap`."""

    def many(noise: Noise, z: Any) -> tuple[Any, Any]:
        mean, gained = jax.vmap(one, in_axes=(None, 0))(noise, z)
        return mean, jnp.sum(gained)

    return many


def textbook(noise: Noise, z: Any) -> tuple[Any, Any]:
    """Textbook JAX: `jacfwd`, `@`, `cho_solve`, Joseph's form, in a scan."""
    q, r = jnp.diag(noise.process), jnp.diag(noise.measurement)

    def step(carry: Any, given: Any) -> Any:
        x, p = carry
        z, dt = given
        f = jax.jacfwd(turn)(x, dt)
        x = turn(x, dt)
        p = f @ p @ f.T + q * (dt / DT)
        h = jax.jacfwd(observe)(x)
        s = h @ p @ h.T + r
        factor = jax.scipy.linalg.cho_factor(s, lower=True)
        gain = jax.scipy.linalg.cho_solve(factor, h @ p).T
        e = z - observe(x)
        a = jnp.eye(10) - gain @ h
        logdet = 2.0 * jnp.sum(jnp.log(jnp.diag(factor[0])))
        fit = e @ jax.scipy.linalg.cho_solve(factor, e)
        gained = -0.5 * (fit + logdet + 7 * jnp.log(2 * jnp.pi))
        x = x + gain @ e
        p = a @ p @ a.T + gain @ r @ gain.T
        return (x, 0.5 * (p + p.T)), (x, gained)

    dt = jnp.full(z.shape[0], DT).at[0].set(0.0)
    _, (means, gained) = lax.scan(step, (jnp.asarray(MEAN), jnp.diag(VARIANCE)), (z, dt))
    return means, jnp.sum(gained)


def dynamax(noise: Noise, z: Any) -> tuple[Any, Any]:
    """dynamax's EKF; only the means are output."""
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

    params = ParamsNLGSSM(
        initial_mean=jnp.asarray(MEAN),
        initial_covariance=jnp.diag(VARIANCE),
        dynamics_function=lambda x: turn(x, DT),
        dynamics_covariance=jnp.diag(noise.process),
        emission_function=observe,
        emission_covariance=jnp.diag(noise.measurement),
    )
    found = extended_kalman_filter(params, z, output_fields=["filtered_means"])
    return found.filtered_means, found.marginal_loglik


def cuthbert(noise: Noise, z: Any) -> tuple[Any, Any]:
    """cuthbert's square-root filter with linearised moments."""
    import cuthbert as package
    from cuthbert.gaussian import moments

    chol_q, chol_r = jnp.diag(jnp.sqrt(noise.process)), jnp.diag(jnp.sqrt(noise.measurement))

    def dynamics(state: Any, given: Any) -> Any:
        _, dt = given
        return (lambda x: (turn(x, dt), chol_q * (dt > 0))), state.mean

    def observation(state: Any, given: Any) -> Any:
        return (lambda x: (observe(x), chol_r)), state.mean, given[0]

    built = moments.build_filter(
        jnp.asarray(MEAN), jnp.diag(jnp.sqrt(VARIANCE)), dynamics, observation
    )
    dt = jnp.full(z.shape[0], DT).at[0].set(0.0)
    given = (z, dt)
    found = package.filter(built, given, built.init_prepare())
    return found.mean[1:], found.log_normalizing_constant[-1]


def filterpy(noise: Noise, z: np.ndarray) -> tuple[np.ndarray, float]:
    """filterpy's EKF of one run, in NumPy, with a Jacobian derived by hand."""
    from filterpy.kalman import ExtendedKalmanFilter

    kf = ExtendedKalmanFilter(dim_x=10, dim_z=7)
    kf.x, kf.P = MEAN.copy(), np.diag(VARIANCE)
    kf.R, q = np.diag(noise.measurement), np.diag(noise.process)
    slope = np.zeros((7, 10))
    slope[:4, :4], slope[4:, 4:7], slope[4:, 7:] = np.eye(4), np.eye(3), np.eye(3)
    means, total = [], 0.0
    for k, row in enumerate(z):
        if k:
            kf.F, kf.Q = _jacobian(kf.x), q
            kf.x = np.concatenate([_left(kf.x[4:7]) @ kf.x[:4], kf.x[4:]])
            kf.P = kf.F @ kf.P @ kf.F.T + kf.Q
        kf.update(row, lambda x: slope, lambda x: slope @ x)
        means.append(kf.x.copy())
        total += float(
            -0.5 * (kf.y @ kf.SI @ kf.y + np.linalg.slogdet(kf.S)[1] + 7 * np.log(2 * np.pi))
        )
    return np.array(means), total


def _left(rate: np.ndarray) -> np.ndarray:
    """Matrix (4, 4) that rotates a quaternion by ``rate DT``."""
    square = rate @ rate + 1e-30
    n = np.sqrt(square)
    c, s = np.cos(n * DT / 2), np.sin(n * DT / 2) / n
    w, x, y, z = c, *(s * rate)
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _jacobian(x: np.ndarray) -> np.ndarray:
    """Derivative (10, 10) of the transition; eq. 17 of Cheng (2023) has its block for the rate."""
    q, rate = x[:4], x[4:7]
    f = np.eye(10)
    f[:4, :4] = _left(rate)
    square = rate @ rate + 1e-30
    n = np.sqrt(square)
    c, s = np.cos(n * DT / 2), np.sin(n * DT / 2)
    m = np.array(
        [[-q[1], -q[2], -q[3]], [q[0], q[3], -q[2]], [-q[3], q[0], q[1]], [q[2], -q[1], q[0]]]
    )
    f[:4, 4:7] = (
        -DT / (2 * n) * s * np.outer(q, rate)
        + (DT * c / (2 * square) - s / (square * n)) * np.outer(m @ rate, rate)
        + s / n * m
    )
    return f


def yardsticks() -> dict[str, float]:
    """Microseconds per step and run of the C++ programs that can be built."""
    compiler = shutil.which("g++")
    if compiler is None or not YARDSTICK.is_dir():
        return {}
    found = {}
    flags = ["-O3", "-march=native", "-ffast-math", "-pthread"]
    with tempfile.TemporaryDirectory() as folder:
        for name in ("scalar_ekf", "simd_limit"):
            program = Path(folder) / name
            source = YARDSTICK / f"{name}.cpp"
            done = subprocess.run([compiler, *flags, source, "-o", program], capture_output=True)
            if done.returncode:
                continue
            text = subprocess.run([program], check=True, capture_output=True, text=True).stdout
            for line in text.splitlines():
                value = float(line.split("us/step/run ")[1].split()[0])
                if name == "scalar_ekf":
                    found["C++ scalar, one thread"] = value
                else:
                    found[f"C++ vectors, {line.split()[1]} thread(s)"] = value
    return found
