"""Any model filtered as a textbook says: one run, whole matrices, `jacfwd` for every Jacobian.

It shares with the package the model's own functions, `retract` and `local`, and nothing of the recursion;
every derivative of it is JAX's own.
"""

import jax
import jax.numpy as jnp
from jax import lax
from scipy.stats import chi2

from jaxekf.filtering import ekf
from jaxekf.geometry import manifold


def _slope(space, function, x, at, size):
    """The Jacobian of ``local(at, function(retract(x, d)))`` at d = 0."""
    return jax.jacfwd(lambda d: manifold.local(space, at, function(d)))(jnp.zeros(size))


def _predict(model, params, x, p, u, dt):
    def move(d, w):
        return model.transition(manifold.retract(model.space, x, d), u, dt, w, params)

    sigma = model.process_noise(params, dt)
    n, m = model.error_dim, sigma.shape[0]
    ahead = model.transition(x, u, dt, jnp.zeros(m), params)
    both = _slope(model.space, lambda dw: move(dw[:n], dw[n:]), x, ahead, n + m)
    f, g = both[:, :n], both[:, n:]
    return ahead, f @ p @ f.T + g @ sigma @ g.T


def _look(model, sensor, params, x, p, u, rows):
    """Residual, slope, noise and mask of one sensor's sample, gated rows hidden."""

    def see(d):
        return sensor.predict(manifold.retract(model.space, x, d), u, params, rows.aux)

    expected = sensor.predict(x, u, params, rows.aux)
    h = _slope(sensor.space, see, x, expected, model.error_dim)
    e = manifold.local(sensor.space, expected, rows.value)
    r = sensor.noise(params, rows.aux, rows.dt)
    mask = rows.mask
    if sensor.gate is not None:
        shown = [jnp.array(members) for members in sensor.group_rows]
        kept = jnp.ones(sensor.rows, bool)
        for members in shown:
            both = rows.mask[members][:, None] & rows.mask[members][None]
            s = (h @ p @ h.T + r)[members][:, members]
            s = jnp.where(both, s, jnp.eye(len(members)))
            part = jnp.where(rows.mask[members], e[members], 0.0)
            distance = part @ jnp.linalg.solve(s, part)
            bounds = jnp.array([jnp.inf, *chi2.ppf(sensor.gate, range(1, len(members) + 1))])
            inside = distance <= bounds[jnp.sum(rows.mask[members])]
            kept = kept.at[members].set(inside)
        mask = mask & lax.stop_gradient(kept)
    if sensor.weighting is not None:
        r = _enlarged(sensor, e, h @ p @ h.T + r, r, rows.mask)
    return e, h, r, mask


def _enlarged(sensor, e, s, r, mask):
    """The noise with each group's made larger the farther the group is off."""
    scale = jnp.ones(sensor.rows)
    for group in sensor.group_rows:
        members = jnp.array(group)
        seen = mask[members]
        part = jnp.where(seen[:, None] & seen[None], s[members][:, members], jnp.eye(len(group)))
        error = jnp.where(seen, e[members], 0.0)
        square, count = error @ jnp.linalg.solve(part, error), jnp.sum(seen)
        if sensor.weighting == "huber":
            bound = jnp.array([1.0, *chi2.ppf(0.95, range(1, len(group) + 1))])[count]
            larger = jnp.where(square > bound, jnp.sqrt(jnp.maximum(square, 1e-9) / bound), 1.0)
        else:
            larger = jnp.maximum((4.0 + square) / (4.0 + count), 1.0)
        scale = scale.at[members].set(larger)
    return r * jnp.sqrt(scale[:, None] * scale[None])


def _update(model, params, x, p, u, samples):
    looks = [
        _look(model, model.sensor(name), params, x, p, u, rows) for name, rows in samples.items()
    ]
    if not looks:
        return x, p, 0.0, jnp.zeros(model.error_dim)
    e, h, mask = (jnp.concatenate([look[i] for look in looks]) for i in (0, 1, 3))
    r = jax.scipy.linalg.block_diag(*[look[2] for look in looks])
    e, h = jnp.where(mask, e, 0.0), jnp.where(mask[:, None], h, 0.0)
    r = jnp.where(mask[:, None] & mask[None], r, jnp.eye(len(e)))
    root = jnp.linalg.cholesky(h @ p @ h.T + r)
    white = jax.scipy.linalg.solve_triangular(root, jnp.c_[e, h @ p], lower=True)
    gain = jax.scipy.linalg.solve_triangular(root, white[:, 1:], lower=True, trans=1).T
    fit = white[:, 0] @ white[:, 0] + 2.0 * jnp.sum(jnp.log(jnp.diagonal(root)))
    gained = -0.5 * (fit + jnp.sum(mask) * jnp.log(2.0 * jnp.pi))
    delta = gain @ e
    rest = jnp.eye(model.error_dim) - gain @ h
    joseph = rest @ p @ rest.T + gain @ r @ gain.T
    y = manifold.retract(model.space, x, delta)
    reset = _slope(
        model.space,
        lambda d: manifold.retract(model.space, x, delta + d),
        x,
        y,
        model.error_dim,
    )
    joseph = reset @ joseph @ reset.T
    if model.project is not None:
        y = model.project(y)
    some = jnp.any(mask)
    x, p = jax.tree.map(lambda a, b: jnp.where(some, a, b), (y, joseph), (x, p))
    return x, p, gained, jnp.where(some, delta, 0.0)


def run(model, params, belief, steps):
    """Predicted and updated means and covariances, (K, S, ...), and log-likelihoods (K, S)."""
    return _run(model, params, belief, steps)[:3]


def _run(model, params, belief, steps):
    """As `run`, with the error vectors by which the updates moved the means."""
    inputs = ekf.inputs_of(model, params, steps)
    epochs, substeps = steps.dt.shape
    last = jnp.arange(substeps) == substeps - 1

    def everywhere(rows):
        """A slow sensor's samples at all substeps, hidden but at the last."""
        spread = jax.tree.map(lambda a: jnp.repeat(a[:, None], substeps, axis=1), rows)
        return spread._replace(mask=spread.mask & last[None, :, None])

    def step(carry, given):
        dt, u, samples = given
        before = _predict(model, params, *carry, u, dt)
        *carry, gained, delta = _update(model, params, *before, u, samples)
        return tuple(carry), (before, tuple(carry), gained, delta)

    samples = steps.fast | {name: everywhere(rows) for name, rows in steps.slow.items()}
    given = (steps.dt, inputs, samples)
    one_by_one = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), given)
    found = lax.scan(step, tuple(belief), one_by_one)[1]
    return jax.tree.map(lambda a: a.reshape(epochs, substeps, *a.shape[1:]), found)


def smooth(model, params, belief, steps):
    """Smoothed means and covariances, (K, S, ...), and those of the start: Rauch, Tung, Striebel with
    an inverse of every predicted covariance, errors carried from mean to mean to first order.

    Where a constraint moved the mean by c, what came later was counted from there; without that move it
    would have said ``d + c - P_smoothed inv(P) c`` instead of d.
    """
    predicted, updated, _, moves = _run(model, params, belief, steps)
    flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), (predicted, updated, moves))
    inputs = jax.tree.map(
        lambda a: a.reshape(-1, *a.shape[2:]), (steps.dt, ekf.inputs_of(model, params, steps))
    )
    earlier = jax.tree.map(
        lambda first, later: jnp.concatenate([jnp.asarray(first)[None], later[:-1]]),
        tuple(belief),
        flat[1],
    )

    def counted_from(x, delta):
        """The derivative of an error counted from ``retract(x, delta)`` by the one counted from x."""
        y = manifold.retract(model.space, x, delta)
        return _slope(
            model.space,
            lambda d: manifold.retract(model.space, x, delta + d),
            x,
            y,
            model.error_dim,
        )

    def back(carry, given):
        later, spread = carry
        (x, p), (before, before_p), (after, after_p), moved, (dt, u) = given
        shown = manifold.retract(model.space, after, later)
        if model.project is not None:
            shown = model.project(shown)
            free = manifold.retract(model.space, x, moved)
            c = manifold.local(model.space, free, model.project(free))
            c = jnp.where(jnp.any(moved != 0.0), c, 0.0)
        reset = counted_from(after, later)
        found = shown, reset @ spread @ reset.T
        if model.project is not None:
            later = later + c - spread @ jnp.linalg.solve(after_p, c)
        # From the updated mean to the predicted one.
        turn = jnp.linalg.inv(counted_from(x, moved))
        error, spread = turn @ later + moved, turn @ spread @ turn.T
        predicted = model.transition(before, u, dt, jnp.zeros(params_noise(dt)), params)
        f = _slope(
            model.space,
            lambda d: model.transition(
                manifold.retract(model.space, before, d), u, dt, jnp.zeros(params_noise(dt)), params
            ),
            before,
            predicted,
            model.error_dim,
        )
        gain = jnp.linalg.solve(p, f @ before_p).T
        return (gain @ error, before_p + gain @ (spread - p) @ gain.T), found

    def params_noise(dt):
        return model.process_noise(params, dt).shape[0]

    start = jnp.zeros(model.error_dim), flat[1][1][-1]
    given = (flat[0], earlier, flat[1], flat[2], inputs)
    (delta, spread), found = lax.scan(back, start, given, reverse=True)
    first = manifold.retract(model.space, belief.mean, delta)
    first = first if model.project is None else model.project(first)
    reset = counted_from(belief.mean, delta)
    epochs, substeps = steps.dt.shape
    shaped = jax.tree.map(lambda a: a.reshape(epochs, substeps, *a.shape[1:]), found)
    return shaped, (first, reset @ spread @ reset.T)
