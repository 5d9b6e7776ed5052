"""State spaces: the parts of a state, and how an error vector moves it.

A state is a NamedTuple of arrays. Its *space* is the same NamedTuple type with manifolds instead of arrays,
one for each field; nesting is allowed. From this declaration follow the size of the error vector, the slice
of each part, labels, units and column headers.

Errors act on the right, in the body frame: ``local(x, retract(x, delta)) == delta`` for errors within the
injectivity radius, and ``retract(x, local(x, y))`` is ``y`` (for rotations up to sign).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxekf.geometry import rotation

_AXES = ("x", "y", "z")


class Manifold(ABC):
    """One part of a state: its storage, its error vector and its names.

    A new manifold defines the abstract members; the derivatives have defaults by autodiff.

    Examples
    --------
    An angle, whose error is the shorter way around the circle:

    >>> import jax.numpy as jnp
    >>> import jaxekf
    >>> class Angle(jaxekf.Manifold):
    ...     unit, dim, shape, curved = "rad", 1, (1,), False
    ...     component_labels = error_labels = ("",)
    ...     def retract(self, x, delta):
    ...         return x + delta
    ...     def local(self, x, y):
    ...         return (y - x + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
    >>> print(f"{Angle().local(jnp.array([3.1]), jnp.array([-3.1]))[0]:.2f} rad")
    0.08 rad
    """

    unit: str
    """Unit of the error vector."""
    frame: str = "body"
    """Frame of the error vector."""

    @property
    @abstractmethod
    def dim(self) -> int:
        """Length of the error vector."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of the stored array."""

    @property
    @abstractmethod
    def component_labels(self) -> tuple[str, ...]:
        """Suffix of each stored component, for column headers."""

    @property
    @abstractmethod
    def error_labels(self) -> tuple[str, ...]:
        """Suffix of each component of the error vector."""

    @abstractmethod
    def retract(self, x: Array, delta: Array) -> Array:
        """``x`` moved by the error ``delta``."""

    @abstractmethod
    def local(self, x: Array, y: Array) -> Array:
        """The error that moves ``x`` to ``y``."""

    @property
    def curved(self) -> bool:
        """Whether `reset_jacobian` differs from the identity."""
        return True

    def lift(self, x: Array, delta: Array) -> Array:
        """Derivative of ``retract(x, .)`` at zero, applied to `delta`: an error as a change of ``x``."""
        return jax.jvp(lambda d: self.retract(x, d), (jnp.zeros_like(delta),), (delta,))[1]

    def lower(self, x: Array, change: Array) -> Array:
        """Derivative of ``local(x, .)`` at ``x``, applied to `change`: a change of ``x`` as an error."""
        return jax.jvp(lambda y: self.local(x, y), (x,), (change,))[1]

    def reset_jacobian(self, delta: Array) -> Array:
        """Derivative, at zero, of ``e -> local(retract(x, delta), retract(x, delta + e))``.

        It must not depend on ``x``, as is the case for a Lie group.
        """
        raise TypeError(
            f"got the curved manifold {type(self).__name__} without reset_jacobian, expected one;"
            " define it, or set curved to False where the identity is good enough"
        )


class _Additive(Manifold):
    """A part whose error is added to its stored numbers."""

    @property
    def error_labels(self) -> tuple[str, ...]:
        return self.component_labels

    @property
    def curved(self) -> bool:
        return False

    def retract(self, x: Array, delta: Array) -> Array:
        return x + delta

    def lift(self, x: Array, delta: Array) -> Array:
        return delta

    def lower(self, x: Array, change: Array) -> Array:
        return change


@dataclass(frozen=True)
class Euclidean(_Additive):
    """A vector of `size` components with additive error.

    Examples
    --------
    >>> import jaxekf
    >>> offset = jaxekf.Euclidean(2, "uT", labels=("east", "north"))
    >>> offset.dim, offset.error_labels, offset.unit
    (2, ('east', 'north'), 'uT')
    """

    size: int
    """Number of components."""
    unit: str = ""
    """Unit of all components."""
    labels: tuple[str, ...] = ()
    """Label of each component; by default x, y, z for three, else their numbers."""
    frame: str = "body"
    """Frame of the vector and of its error."""

    @property
    def dim(self) -> int:
        return self.size

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.size,)

    @property
    def component_labels(self) -> tuple[str, ...]:
        if self.labels:
            return self.labels
        return _AXES if self.size == 3 else tuple(str(i) for i in range(self.size))

    def local(self, x: Array, y: Array) -> Array:
        return y - x


@dataclass(frozen=True)
class SO3(Manifold):
    """A rotation stored as a unit quaternion w, x, y, z; the error is a body-frame rotation vector.

    Examples
    --------
    A quarter turn about z as an error of three components, and back:

    >>> import jax.numpy as jnp
    >>> import jaxekf
    >>> space = jaxekf.SO3()
    >>> start = jnp.array([1.0, 0.0, 0.0, 0.0])
    >>> turned = space.retract(start, jnp.array([0.0, 0.0, jnp.pi / 2]))
    >>> print(turned.round(2), jnp.rad2deg(space.local(start, turned)).round(1))
    [0.71 0.   0.   0.71] [ 0.  0. 90.]
    """

    unit: str = "rad"
    """Unit of the error vector."""

    @property
    def dim(self) -> int:
        return 3

    @property
    def shape(self) -> tuple[int, ...]:
        return (4,)

    @property
    def component_labels(self) -> tuple[str, ...]:
        return ("w", *_AXES)

    @property
    def error_labels(self) -> tuple[str, ...]:
        return _AXES

    def retract(self, x: Array, delta: Array) -> Array:
        return rotation.keep_unit(rotation.product(x, rotation.exp(delta)))

    def local(self, x: Array, y: Array) -> Array:
        return rotation.difference(x, y)

    def lift(self, x: Array, delta: Array) -> Array:
        return 0.5 * rotation.product(x, rotation.pure(delta))

    def lower(self, x: Array, change: Array) -> Array:
        return 2.0 * rotation.product(rotation.conjugate(x), change)[..., 1:]

    def reset_jacobian(self, delta: Array) -> Array:
        return rotation.right_jacobian(delta)


@dataclass(frozen=True)
class AdditiveQuaternion(_Additive):
    """A quaternion as four independent components with additive error, as in Cheng (2023).

    Both signs of a quaternion are the same rotation, so `local` takes the sign of ``y`` nearer to
    ``x``. The norm is not constrained here; the model's `project` normalises it.

    Examples
    --------
    Both signs of a quaternion have no difference:

    >>> import jax.numpy as jnp
    >>> import jaxekf
    >>> space = jaxekf.AdditiveQuaternion()
    >>> q = jnp.array([0.6, 0.8, 0.0, 0.0])
    >>> space.dim, bool((space.local(q, -q) == 0.0).all())
    (4, True)
    """

    unit: str = ""
    """Unit of the error vector; none."""

    @property
    def dim(self) -> int:
        return 4

    @property
    def shape(self) -> tuple[int, ...]:
        return (4,)

    @property
    def component_labels(self) -> tuple[str, ...]:
        return ("w", *_AXES)

    def local(self, x: Array, y: Array) -> Array:
        return jnp.where(jnp.sum(x * y) < 0.0, -y, y) - x


class Part(NamedTuple):
    """One leaf of a space: its name, its manifold and its slice of the error vector."""

    name: str
    manifold: Manifold
    error: slice


def _is_manifold(node: Any) -> bool:
    return isinstance(node, Manifold)


def _flatten(space: Any, *states: Any) -> tuple[list[Manifold], list[list[Array]], Any]:
    manifolds, structure = jax.tree.flatten(space, is_leaf=_is_manifold)
    return manifolds, [structure.flatten_up_to(state) for state in states], structure


def parts(space: Any) -> tuple[Part, ...]:
    """The leaves of a space in order, with their names and slices of the error vector.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.geometry import manifold
    >>> [(part.name, part.manifold.dim) for part in manifold.parts(jaxekf.get_model("loose").space)]
    [('q_ref_body', 3), ('bias', 3)]
    """
    found, start = [], 0
    for path, manifold in jax.tree_util.tree_flatten_with_path(space, is_leaf=_is_manifold)[0]:
        name = ".".join(str(getattr(key, "name", getattr(key, "key", key))) for key in path)
        found.append(Part(name, manifold, slice(start, start + manifold.dim)))
        start += manifold.dim
    return tuple(found)


def error_dim(space: Any) -> int:
    """Length of the error vector of a space.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.geometry import manifold
    >>> manifold.error_dim(jaxekf.SO3())  # of four stored numbers
    3
    """
    return sum(part.manifold.dim for part in parts(space))


def error_labels(space: Any) -> tuple[str, ...]:
    """Name of each component of the error vector, ``bias_x`` for instance.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.geometry import manifold
    >>> manifold.error_labels(jaxekf.get_model("loose").space)[-3:]
    ('bias_x', 'bias_y', 'bias_z')
    """
    return tuple(
        "_".join(filter(None, (part.name, label)))
        for part in parts(space)
        for label in part.manifold.error_labels
    )


def component_labels(space: Any) -> tuple[str, ...]:
    """Name of each stored component, ``q_ref_body_w`` for instance."""
    return tuple(
        "_".join(filter(None, (part.name, label)))
        for part in parts(space)
        for label in part.manifold.component_labels
    )


def error_units(space: Any) -> tuple[str, ...]:
    """Unit of each component of the error vector."""
    return tuple(part.manifold.unit for part in parts(space) for _ in range(part.manifold.dim))


def retract(space: Any, x: Any, delta: Array) -> Any:
    """``x`` moved by the error vector ``delta``, shape (error_dim,).

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import manifold, rotation
    >>> jaxekf.set_up()
    >>> delta = np.array([0.0, 0.0, np.pi / 2])  # a quarter turn about z
    >>> moved = manifold.retract(jaxekf.SO3(), rotation.identity(), delta)
    >>> np.allclose(moved, np.sqrt([0.5, 0.0, 0.0, 0.5]))
    True
    """
    manifolds, (leaves,), structure = _flatten(space, x)
    moved, start = [], 0
    for manifold, leaf in zip(manifolds, leaves, strict=True):
        moved.append(manifold.retract(leaf, delta[start : start + manifold.dim]))
        start += manifold.dim
    return jax.tree.unflatten(structure, moved)


def local(space: Any, x: Any, y: Any) -> Array:
    """The error vector that moves ``x`` to ``y``, shape (error_dim,).

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import manifold, rotation
    >>> jaxekf.set_up()
    >>> half_turn_about_y = np.array([0.0, 0.0, 1.0, 0.0])
    >>> delta = manifold.local(jaxekf.SO3(), rotation.identity(), half_turn_about_y)
    >>> np.rad2deg(delta).round(9).tolist()
    [0.0, 180.0, 0.0]
    """
    manifolds, (first, second), _ = _flatten(space, x, y)
    return jnp.concatenate(
        [m.local(a, b) for m, a, b in zip(manifolds, first, second, strict=True)]
    )


def lift(space: Any, x: Any, delta: Array) -> Any:
    """An error vector as a change of the stored numbers of ``x`` (linear in `delta`).

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.geometry import manifold, rotation
    >>> manifold.lift(jaxekf.SO3(), rotation.identity(), np.array([0.0, 0.0, 0.5])).tolist()
    [0.0, 0.0, 0.0, 0.25]
    """
    manifolds, (leaves,), structure = _flatten(space, x)
    changes, start = [], 0
    for manifold, leaf in zip(manifolds, leaves, strict=True):
        changes.append(manifold.lift(leaf, delta[start : start + manifold.dim]))
        start += manifold.dim
    return jax.tree.unflatten(structure, changes)


def lower(space: Any, x: Any, change: Any) -> Array:
    """A change of the stored numbers of ``x`` as an error vector (linear in `change`)."""
    manifolds, (leaves, changes), _ = _flatten(space, x, change)
    return jnp.concatenate(
        [m.lower(a, b) for m, a, b in zip(manifolds, leaves, changes, strict=True)]
    )


def is_curved(space: Any) -> bool:
    """Whether a change of the mean changes the covariance, because a part of the space is curved.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf.geometry import manifold
    >>> manifold.is_curved(jaxekf.SO3()), manifold.is_curved(jaxekf.Euclidean(3))
    (True, False)
    """
    return any(part.manifold.curved for part in parts(space))


def reset_jacobian(space: Any, delta: Array) -> Array:
    """Jacobian (n, n) of the error reset: from errors about ``x`` to errors about ``retract(x, delta)``.

    To first order the error about the updated mean is ``J(delta)`` times the error about the old one (Sola,
    Deray, Atchuthan 2018, eq. 67 for rotations).

    Examples
    --------
    >>> import jax, jaxekf, numpy as np
    >>> from jaxekf.geometry import manifold, rotation
    >>> jaxekf.set_up()
    >>> delta = np.array([0.0, 0.0, 0.1])
    >>> jacobian = jax.jit(lambda delta: manifold.reset_jacobian(jaxekf.SO3(), delta))(delta)
    >>> np.allclose(jacobian, np.eye(3) - rotation.skew(delta) / 2.0, atol=2e-3)  # the first terms
    True
    """
    size = error_dim(space)
    rows = []
    for part in parts(space):
        dim, start = part.manifold.dim, part.error.start
        block = jnp.eye(dim, dtype=delta.dtype)
        if part.manifold.curved:
            block = part.manifold.reset_jacobian(delta[part.error])
        before, after = jnp.zeros((dim, start)), jnp.zeros((dim, size - start - dim))
        pieces = [before.astype(delta.dtype), block, after.astype(delta.dtype)]
        rows.append(jnp.concatenate(pieces, axis=1))
    return jnp.concatenate(rows)


def dtype_of(state: Any) -> Any:
    """The common floating-point type of a state's leaves."""
    return jnp.result_type(*jax.tree.leaves(state))


def copy_where(condition: Array, yes: Any, no: Any) -> Any:
    """``yes`` if the scalar `condition` is true, else ``no``, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
