"""State spaces: retract, local and their derivatives, for single, mixed and nested manifolds."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxekf.geometry import manifold, rotation
from jaxekf.geometry.manifold import SO3, AdditiveQuaternion, Euclidean


class Pose(NamedTuple):
    q_ref_body: Any
    position: Any


class Nested(NamedTuple):
    bias: Any
    pose: Any
    q_camera: Any


class Mixed(NamedTuple):
    rate: Any
    q_ref_body: Any
    q_added: Any


SPACES = {
    "euclidean": Euclidean(5),
    "rotation": SO3(),
    "added quaternion": AdditiveQuaternion(),
    "mixed": Mixed(Euclidean(3), SO3(), AdditiveQuaternion()),
    "nested": Nested(Euclidean(2), Pose(SO3(), Euclidean(3)), SO3()),
}


class Functions(NamedTuple):
    retract: Any
    local: Any


COMPILED = {
    name: Functions(
        jax.jit(lambda x, d, space=space: manifold.retract(space, x, d)),
        jax.jit(lambda x, y, space=space: manifold.local(space, x, y)),
    )
    for name, space in SPACES.items()
}


def random_state(space, seed):
    """A state: unit quaternions, numbers of order one."""
    rng = np.random.default_rng([seed, 23])
    leaves, structure = jax.tree.flatten(space, is_leaf=lambda m: isinstance(m, manifold.Manifold))
    values = []
    for m in leaves:
        value = rng.standard_normal(m.shape)
        values.append(value if isinstance(m, Euclidean) else value / np.linalg.norm(value))
    return jax.tree.unflatten(structure, values)


def random_error(space, seed, size):
    """An error vector whose parts have length `size` (below 0.9 where the quaternion is added)."""
    rng = np.random.default_rng([seed, 29])
    error = np.zeros(manifold.error_dim(space))
    for part in manifold.parts(space):
        direction = rng.standard_normal(part.manifold.dim)
        length = min(size, 0.9) if isinstance(part.manifold, AdditiveQuaternion) else size
        error[part.error] = length * direction / np.linalg.norm(direction)
    return error


def signs_aligned(space, x, y):
    """`x` with each quaternion's sign turned to that of `y`."""
    leaves = jax.tree.leaves(space, is_leaf=lambda m: isinstance(m, manifold.Manifold))
    first, structure = jax.tree.flatten(x)
    turned = [
        a if isinstance(m, Euclidean) or np.sum(a * b) >= 0.0 else -a
        for m, a, b in zip(leaves, first, jax.tree.leaves(y), strict=True)
    ]
    return jax.tree.unflatten(structure, turned)


def assert_close(actual, expected, atol):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=atol), actual, expected)


every_space = pytest.mark.parametrize("name", SPACES)
seeds = st.integers(0, 2**31)
sizes = st.one_of(st.floats(0.0, np.pi - 1e-6), st.sampled_from([0.0, 1e-300, 1e-8, 0.1]))


@every_space
@given(seed=seeds, size=sizes)
def test_local_undoes_retract(name, seed, size):
    """Errors on the wrong side, a misplaced slice of the error vector, a half angle."""
    space, (retract, local) = SPACES[name], COMPILED[name]
    x, delta = random_state(space, seed), random_error(space, seed, size)
    np.testing.assert_allclose(local(x, retract(x, delta)), delta, rtol=0, atol=1e-12)


@every_space
@given(seed=seeds)
def test_retract_reaches(name, seed):
    """A retract that does not arrive, at either sign of a quaternion."""
    space, (retract, local) = SPACES[name], COMPILED[name]
    x, y = random_state(space, seed), random_state(space, seed + 1)
    reached = retract(x, local(x, y))
    assert_close(signs_aligned(space, reached, y), y, 1e-12)
    again = retract(x, np.zeros(manifold.error_dim(space)))
    assert_close(again, x, 1e-15)


@given(seed=seeds)
def test_rotation_errors_are_in_the_body_frame(seed):
    """An error applied on the left, in the reference frame."""
    space = SPACES["nested"]
    x, delta = random_state(space, seed), random_error(space, seed, 0.5)
    moved = COMPILED["nested"].retract(x, delta)
    part = {p.name: p.error for p in manifold.parts(space)}["pose.q_ref_body"]
    expected = rotation.product(x.pose.q_ref_body, rotation.exp(delta[part]))
    np.testing.assert_allclose(moved.pose.q_ref_body, expected, rtol=0, atol=1e-14)


@every_space
@pytest.mark.parametrize("seed", [1, 2])
def test_lift_and_lower_are_the_derivatives(name, seed):
    """A hand-written derivative that is not that of retract or local."""
    space = SPACES[name]
    x, delta = random_state(space, seed), random_error(space, seed, 0.7)
    x = jax.tree.map(jnp.asarray, x)
    zero = jnp.zeros_like(delta)
    change = jax.jvp(lambda d: manifold.retract(space, x, d), (zero,), (jnp.asarray(delta),))[1]
    assert_close(manifold.lift(space, x, delta), change, 1e-14)
    any_change = jax.tree.map(jnp.asarray, random_state(space, seed + 7))
    error = jax.jvp(lambda y: manifold.local(space, x, y), (x,), (any_change,))[1]
    np.testing.assert_allclose(manifold.lower(space, x, any_change), error, rtol=0, atol=1e-13)
    np.testing.assert_allclose(manifold.lower(space, x, change), delta, rtol=0, atol=1e-14)


class PlainSO3(SO3):
    """A rotation that leaves its derivatives to the defaults."""

    lift = manifold.Manifold.lift
    lower = manifold.Manifold.lower
    reset_jacobian = manifold.Manifold.reset_jacobian


def test_default_derivatives():
    """Defaults by autodiff that differ from the hand-written ones, or a silent identity reset."""
    x = jnp.asarray(random_state(SO3(), 3))
    delta = jnp.array([0.3, -0.2, 0.5])
    np.testing.assert_allclose(PlainSO3().lift(x, delta), SO3().lift(x, delta), rtol=0, atol=1e-14)
    change = jnp.array([0.1, 0.2, -0.3, 0.4])
    expected = SO3().lower(x, change)
    np.testing.assert_allclose(PlainSO3().lower(x, change), expected, rtol=0, atol=1e-14)
    with pytest.raises(TypeError, match="PlainSO3 without reset_jacobian"):
        PlainSO3().reset_jacobian(delta)


@every_space
@pytest.mark.parametrize("size", [0.0, 1e-7, 0.4, 2.5])
def test_reset_jacobian(name, size):
    """A reset that is missing, inverted, transposed, or in the wrong block."""
    space, (retract, local) = SPACES[name], COMPILED[name]
    x, delta = random_state(space, 4), random_error(space, 4, size)
    if manifold.is_curved(space) and size > 1.0:
        assert np.abs(manifold.reset_jacobian(space, delta) - np.eye(len(delta))).max() > 0.1
    step, columns, moved = 1e-6, [], retract(x, delta)
    for e in step * np.eye(len(delta)):
        ahead, behind = local(moved, retract(x, delta + e)), local(moved, retract(x, delta - e))
        columns.append((ahead - behind) / (2 * step))
    expected = np.stack(columns, axis=1)
    reset = manifold.reset_jacobian(space, jnp.asarray(delta))
    np.testing.assert_allclose(reset, expected, rtol=0, atol=1e-9)


@every_space
def test_declaration(name):
    """Labels, units or slices that do not follow the error vector."""
    space = SPACES[name]
    n = manifold.error_dim(space)
    covered = np.concatenate([np.arange(n)[part.error] for part in manifold.parts(space)])
    np.testing.assert_array_equal(covered, np.arange(n))
    assert len(set(manifold.error_labels(space))) == n
    assert len(manifold.error_units(space)) == n
    stored = sum(leaf.size for leaf in jax.tree.leaves(random_state(space, 0)))
    assert len(set(manifold.component_labels(space))) == stored


def test_curved_only_where_it_is():
    """A reset that is skipped for rotations, or paid for where everything is added."""
    curved = {name: manifold.is_curved(space) for name, space in SPACES.items()}
    flat = {"euclidean", "added quaternion"}
    assert curved == {name: name not in flat for name in SPACES}


def test_added_quaternion_takes_the_nearer_sign():
    """A measured quaternion of the other sign that pulls the state through zero."""
    x = jnp.array([0.8, 0.6, 0.0, 0.0])
    y = jnp.array([0.79, 0.61, 0.01, -0.02])
    expected = y - x
    np.testing.assert_array_equal(AdditiveQuaternion().local(x, y), expected)
    np.testing.assert_array_equal(AdditiveQuaternion().local(x, -y), expected)
