"""Derivatives on the manifold: rotations by closed forms, everything else by JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxekf.filtering.lowering.group_derivative import derivative
from jaxekf.geometry import rotation
from jaxekf.geometry.manifold import SO3, AdditiveQuaternion, Euclidean

FUNCTIONS = {
    "product": lambda q, v: rotation.product(q, rotation.exp(v)),
    "both sides": lambda q, v: rotation.product(rotation.product(rotation.exp(v), q), q),
    "conjugate": lambda q, v: rotation.product(rotation.conjugate(q), rotation.exp(v)),
    "align": lambda q, v: rotation.align(rotation.keep_unit(q), rotation.exp(v)),
    "rotate": lambda q, v: rotation.rotate(q, v * v),
    "rotate inverse": lambda q, v: rotation.rotate_inverse(rotation.normalise(q), v),
    "matrix": lambda q, v: (rotation.to_matrix(q) @ v) * jnp.sin(v[::-1]),
    "difference": lambda q, v: rotation.difference(q, rotation.product(q, rotation.exp(v))),
    "cross": lambda q, v: rotation.cross(rotation.rotate(q, v), v) / (1.0 + jnp.sum(v * v)),
    "numbers": lambda q, v: q[1:] * v + jnp.where(v > 0, v, 0.5 * q[0]),
    "opaque": lambda q, v: jnp.cumsum(rotation.rotate(q, v)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("angle", [0.0, 0.3, 3.0])
def test_derivatives_are_those_of_jax_through_the_charts(name, angle):
    """A closed form that is transposed, has the wrong sign, or is taken at the wrong rotation."""
    function = FUNCTIONS[name]
    q = rotation.exp(angle * jnp.array([0.6, -0.64, 0.48]))
    v = jnp.array([0.7, -0.4, 0.5])
    value = function(q, v)
    end = SO3() if value.shape == (4,) else Euclidean(3)
    found = derivative(function, (q, v), ([SO3()], [Euclidean(3)]), [end])

    def charted(turn, change):
        return end.local(value, function(SO3().retract(q, turn), v + change))

    zero = jnp.zeros(3)
    expected = jax.jacfwd(charted, (0, 1))(zero, zero)
    np.testing.assert_allclose(found.value, value)
    for part, matrix in enumerate(expected):
        block = found.blocks.get((0, part), np.zeros((3, 3)))
        np.testing.assert_allclose(block, matrix, atol=1e-13)


def test_four_free_numbers_are_not_taken_for_a_rotation():
    """A quaternion that is four numbers, not of unit norm, whose radial direction gets lost."""
    q, v = jnp.array([0.9, 0.2, -0.3, 0.4]), jnp.array([0.1, 0.2, -0.1])

    def function(q, v):
        return rotation.product(rotation.exp(v), q)

    spaces = ([AdditiveQuaternion()], [Euclidean(3)])
    found = derivative(function, (q, v), spaces, [AdditiveQuaternion()])
    expected = jax.jacfwd(function, (0, 1))(q, v)
    np.testing.assert_allclose(found.blocks[0, 0], expected[0], atol=1e-14)
    np.testing.assert_allclose(found.blocks[0, 1], expected[1], atol=1e-14)
    assert not found.fallbacks


def test_what_leaves_the_group_is_named():
    """A function that takes a quaternion apart, of which nothing is said."""
    q = rotation.identity()
    found = derivative(lambda q: q[1:] * 2.0, (q,), ([SO3()],), [Euclidean(3)])
    assert found.fallbacks
    assert not derivative(lambda q: rotation.conjugate(q), (q,), ([SO3()],), [SO3()]).fallbacks
    assert not derivative(
        lambda q: rotation.to_matrix(q)[0], (q,), ([SO3()],), [Euclidean(3)]
    ).fallbacks
