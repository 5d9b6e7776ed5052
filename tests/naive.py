"""Any model filtered as a textbook says: one run, whole matrices, `jacfwd` for every Jacobian.

It shares with the package the model's own functions, `retract` and `local`, and nothing of the recursion;
every derivative of it is JAX's own.
"""

import jax
import jax.numpy as jnp
from jax import lax
from scipy.stats import chi2

from jaxekf import ekf, manifold


def _slope(space, function, x, at, size):
    """The Jacobian of ``local(at, function(retract(x, d)))`` at d = 0."""
    return jax.jacfwd(lambda d: manifold.local(space, at, function(d)))(jnp.zeros(size))


def _predict(model, params, x, p, u, dt):
    def move(d, w):
        return model.transition(manifold.retract(model.space, x, d), u, dt, w, params)

    sigma = model.process_noise(params, dt)
    still, here = jnp.zeros(sigma.shape[0]), jnp.zeros(model.error_dim)
    ahead = model.transition(x, u, dt, still, params)
    f = _slope(model.space, lambda d: move(d, still), x, ahead, model.error_dim)
    g = _slope(model.space, lambda w: move(here, w), x, ahead, sigma.shape[0])
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
    return e, h, r, mask


def _update(model, params, x, p, u, samples):
    looks = [
        _look(model, model.sensor(name), params, x, p, u, rows) for name, rows in samples.items()
    ]
    if not looks:
        return x, p, 0.0
    e, h, mask = (jnp.concatenate([look[i] for look in looks]) for i in (0, 1, 3))
    r = jax.scipy.linalg.block_diag(*[look[2] for look in looks])
    e, h = jnp.where(mask, e, 0.0), jnp.where(mask[:, None], h, 0.0)
    r = jnp.where(mask[:, None] & mask[None], r, jnp.eye(len(e)))
    s = h @ p @ h.T + r
    gain = jnp.linalg.solve(s, h @ p).T
    fit = e @ jnp.linalg.solve(s, e) + jnp.linalg.slogdet(s)[1]
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
    return x, p, gained


def run(model, params, belief, steps):
    """Predicted and updated means and covariances, (K, S, ...), and log-likelihoods (K, S)."""
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
        *carry, gained = _update(model, params, *before, u, samples)
        return tuple(carry), (before, tuple(carry), gained)

    samples = steps.fast | {name: everywhere(rows) for name, rows in steps.slow.items()}
    given = (steps.dt, inputs, samples)
    one_by_one = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), given)
    found = lax.scan(step, tuple(belief), one_by_one)[1]
    return jax.tree.map(lambda a: a.reshape(epochs, substeps, *a.shape[1:]), found)
