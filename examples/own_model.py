"""A user-defined model: `loose` with the gyroscope's scale error as an additional state.

    python examples/own_model.py                        # estimates a bundled run
    jaxekf estimate RUN --model own_model:MODEL         # in the folder of this file

A model has a state space, a transition with its process noise, and sensors. Jacobians, the gradient for
tuning, masks, figures and files follow from these.
"""

import argparse
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxekf
from jaxekf import SO3, Euclidean, Input, InputSample, Model, Output, Parameters, Sensor
from jaxekf.geometry import linalg
from jaxekf.models import sources


class State(NamedTuple):
    """Attitude, gyroscope bias (rad/s) and scale error of each axis of the gyroscope."""

    q_ref_body: Any
    bias: Any
    scale: Any


class Noise(NamedTuple):
    """Spectral densities of the gyroscope, and the tracker's standard deviation."""

    gyroscope: Any
    bias_walk: Any
    scale_walk: Any
    optical: Any


class Calibration(NamedTuple):
    """Offset of the gyroscope's clock from the tracker's, seconds."""

    clock_offset: Any


class Initial(NamedTuple):
    """Standard deviations at the start."""

    attitude: Any
    bias: Any
    scale: Any


SPACE: Any = State(SO3(), Euclidean(3, "rad/s"), Euclidean(3, "1"))


def rate(x: State, measured: jax.Array) -> jax.Array:
    """Body rate, rad/s: the measured rate corrected for bias and scale error."""
    return (measured - x.bias) / (1.0 + x.scale)


def transition(x: State, u: InputSample, dt: Any, w: jax.Array, params: Parameters) -> State:
    """The attitude rotates by the mean rate over the step; bias and scale error are random walks."""
    turn = rate(x, u.mean) * dt + w[:3]
    return State(SO3().retract(x.q_ref_body, turn), x.bias + w[3:6], x.scale + w[6:])


def process_noise(params: Parameters, dt: Any) -> jax.Array:
    """Covariance (9, 9) of the noise integrated over dt."""
    noise = params.noise
    leaves = (noise.gyroscope, noise.bias_walk, noise.scale_walk)
    blocks = [linalg.covariance(leaf, 3) for leaf in leaves]
    return jax.scipy.linalg.block_diag(*blocks) * dt


def initial_covariance(params: Parameters) -> jax.Array:
    """Covariance (9, 9) at the start."""
    return jax.scipy.linalg.block_diag(*[linalg.covariance(leaf, 3) for leaf in params.initial])


def initial_mean(first: Any) -> State:
    """The first visible attitude, zero bias and zero scale error."""
    return State(jnp.asarray(first["optical"]), jnp.zeros(3), jnp.zeros(3))


MODEL = Model(
    name="own",
    summary="attitude, gyroscope bias and scale error",
    space=SPACE,
    transition=transition,
    process_noise=process_noise,
    sensors=(
        Sensor(
            "optical",
            SO3(),
            predict=lambda x, u, params, aux: x.q_ref_body,
            noise=lambda params, aux, dt: linalg.covariance(params.noise.optical, 3),
            source=sources.optical_attitude,
        ),
    ),
    parameters=Parameters(
        Noise(np.deg2rad(0.05), np.deg2rad(0.005), 1e-4, np.deg2rad(0.3)),
        calibration=Calibration(0.0),
        initial=Initial(np.deg2rad(10.0), np.deg2rad(1.0), 0.02),
    ),
    units=Parameters(
        Noise("rad/s/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "1/sqrt(s)", "rad"),
        calibration=Calibration("s"),
        initial=Initial("rad", "rad/s", "1"),
    ),
    noise_dims=Noise(3, 3, 3, 3),
    initial_mean=initial_mean,
    initial_covariance=initial_covariance,
    start_with=("optical",),
    input=Input(
        "gyroscope",
        sources.gyroscope,
        clock_offset=lambda params: params.calibration.clock_offset,
    ),
    outputs=(
        Output("attitude", SO3(), "body", lambda x, u, params: x.q_ref_body),
        Output(
            "rate",
            Euclidean(3, "rad/s"),
            "body",
            value=lambda x, u, params: rate(x, u.value),
            # The white noise of the gyroscope sample is not part of the state.
            noise=lambda u, params: linalg.covariance(params.noise.gyroscope, 3) * u.bandwidth,
        ),
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--smoke", action="store_true", help="no effect, since the script takes seconds"
    )
    parser.parse_args()
    jaxekf.set_up()
    run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    estimate = jaxekf.estimate(run, MODEL)
    scale = estimate.part("scale")
    print(f"attitude RMSE {jaxekf.score(estimate, run).attitude_rmse_deg:.3f} deg")
    print(f"scale error {100 * scale.value[-1]} % +- {100 * scale.sigma[-1]} %")


if __name__ == "__main__":
    main()
