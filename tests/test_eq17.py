"""The Jacobian of `loose_additive` against eq. 17 of Cheng (2023), mended and as printed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxekf.filtering import _linearisation as linearisation
from jaxekf.models import loose_additive

T = 0.016


@jax.jit
@jax.vmap
def autodiff_jacobians(q, rate):
    model = loose_additive.MODEL
    params = jax.tree.map(jnp.asarray, model.parameters)
    x = loose_additive.State(q, rate, jnp.array([0.01, -0.02, 0.03]))
    return linearisation.linearise_transition(model, params, x, None, jnp.asarray(T))[1:]


def left_matrix(p):
    """``left_matrix(p) q`` is the Hamilton product ``p q``."""
    w, x, y, z = p
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def eq17(q, rate, exponent=2):
    """F of ``q(k+1) = cos(T|w|/2) q + sin(T|w|/2)/|w| (w q)``; rate and bias stay.

    `exponent` is that of ``|w|`` under the first cosine: 2 by differentiation, 1 as printed.
    """
    speed = np.sqrt(rate @ rate)
    half = 0.5 * T * speed
    turn = left_matrix(np.concatenate([[0.0], rate]))
    sine = 0.5 * T * np.sinc(half / np.pi)
    if half < 1e-3:
        slope = (0.5 * T) ** 3 * (-1.0 / 3.0 + half**2 / 30.0)
    else:
        slope = T * np.cos(half) / (2.0 * speed**exponent) - np.sin(half) / speed**3
    f = np.eye(10)
    f[:4, :4] = np.cos(half) * np.eye(4) + sine * turn
    for j in range(3):
        axis = left_matrix(np.eye(4)[j + 1])
        f[:4, 4 + j] = (-0.5 * T * sine * np.eye(4) + slope * turn) @ q * rate[j] + sine * axis @ q
    return f


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_eq17_with_the_square():
    """A transition that is not the published one, or derivatives that fail at small rates."""
    rng = np.random.default_rng(17)
    q = unit(rng.standard_normal((1000, 4)))
    speed = rng.uniform(0.0, 10.0, 1000)
    speed[:300] = 10.0 ** rng.uniform(-12.0, 0.0, 300)
    speed[:10] = 0.0
    speed[10:20] = 1e-200
    rate = speed[:, None] * unit(rng.standard_normal((1000, 3)))
    f, g = autodiff_jacobians(q, rate)
    expected = np.stack([eq17(a, b) for a, b in zip(q, rate, strict=True)])
    assert np.abs(f - expected).max() <= 1e-12
    np.testing.assert_array_equal(g, np.broadcast_to(np.eye(10), g.shape))


@pytest.mark.parametrize("seed", range(5))
def test_eq17_as_printed_is_wrong(seed):
    """A comparison that would not see the misprint, which is in the rate's block alone."""
    q = unit(np.random.default_rng([seed, 9]).standard_normal(4))
    rate = np.array([np.deg2rad(-9.0), 0.0, 0.0])
    f = np.asarray(autodiff_jacobians(q[None], rate[None])[0][0])
    printed, mended = eq17(q, rate, exponent=1), eq17(q, rate)
    assert np.abs(f - mended).max() <= 1e-12
    assert np.abs(f - printed).max() > 2e-3
    np.testing.assert_array_equal(np.abs(printed - mended)[4:], 0.0)
    np.testing.assert_array_equal(np.abs(printed - mended)[:4, :4], 0.0)


def test_eq17_hand_form_is_the_derivative():
    """A mistake in the hand-coded form that the filter shares."""
    q, rate = unit(np.array([0.3, -0.5, 0.7, 0.2])), np.array([1.1, -0.4, 2.3])

    def step(rate):
        half = 0.5 * T * np.linalg.norm(rate)
        turn = left_matrix(np.concatenate([[0.0], rate]))
        return np.cos(half) * q + np.sin(half) / np.linalg.norm(rate) * turn @ q

    columns = [(step(rate + e) - step(rate - e)) / 2e-5 for e in 1e-5 * np.eye(3)]
    np.testing.assert_allclose(eq17(q, rate)[:4, 4:7], np.stack(columns, axis=1), atol=1e-12)
    np.testing.assert_allclose(eq17(q, rate)[:4, :4] @ q, step(rate), rtol=0, atol=1e-15)
