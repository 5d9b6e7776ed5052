"""Fisher information of the measurements, confidence intervals, and unobservable parameters.

The information is the expected one of the innovations, ``e_i' inv(S) e_j + tr(inv(S) S_i inv(S) S_j) / 2``
summed over all measurements, ``e_i`` and ``S_i`` the derivatives of innovation and covariance by central
differences of the filter itself: two runs of it for each parameter, all recorded runs side by side. With
the prior it gives Laplace's approximation of the posterior.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxekf._support.compilation import jit
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import Flags, Floats
from tuning.objective.data import Data
from tuning.objective.objectives import run_batch
from tuning.parametrisation.free_vector import Layout

_STEP = 1e-3
OPEN = 0.5
"""Share of its prior deviation above which a posterior deviation makes a number unobservable."""
_Z95 = 1.959963984540054


@dataclass(frozen=True)
class Information:
    """Fisher information of the free numbers of a layout, at one point.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> problem = {"objective": "likelihood", "free": ["noise.optical"], "iterations": 5}
    >>> known = tuning.tune(runs, **problem, confidence_intervals=True).information
    >>> print(f"noise.optical is known to {100.0 * known.sigma()[0]:.0f} %")  # of a logarithm
    noise.optical is known to 1 %
    """

    layout: Layout
    free: Floats
    """(n,) point at which it was taken."""
    matrix: Floats
    """(n, n) information of the measurements."""
    score: Floats
    """(n,) gradient of the innovations' log-likelihood."""

    def posterior(self, fixed: Flags | None = None) -> Floats:
        """(n, n) covariance given measurements and prior; zero for `fixed` numbers."""
        kept = np.ones(len(self.free), bool) if fixed is None else ~fixed
        precision = self.matrix + np.diag(np.asarray(self.layout.prior) ** -2.0)
        cov = np.zeros_like(precision)
        if kept.any():
            cov[np.ix_(kept, kept)] = np.linalg.inv(precision[np.ix_(kept, kept)])
        return cov

    def sigma(self, fixed: Flags | None = None) -> Floats:
        """(n,) posterior deviations."""
        return np.sqrt(np.diagonal(self.posterior(fixed)))

    def open(self, fixed: Flags | None = None) -> Flags:
        """(n,) numbers that the measurements do not determine, `fixed` included.

        They are fixed one after the other, the least known first: if only the sum of two is known, one is
        enough. Numbers of the encoder are left out: they are determined by errors, not by measurements.
        """
        found = np.zeros(len(self.free), bool) if fixed is None else fixed.copy()
        prior = np.asarray(self.layout.prior)
        while not found.all():
            left = np.where(self.layout.is_truth, 0.0, self.sigma(found) / prior)
            worst = int(np.argmax(left))
            if left[worst] <= OPEN:
                break
            found[worst] = True
        return found


def information(
    model: Model, where: Layout, free: Any, base: Parameters, groups: Sequence[Data]
) -> Information:
    """The information of all runs at a free vector (n,)."""
    point = np.asarray(free, float)
    count = len(point)
    matrix, score = np.zeros((count, count)), np.zeros(count)
    for data in groups:
        index = where.index(np.asarray(data.place))
        local, slope = of_runs(model, where, point[index], base, data)
        for run, at in enumerate(index):
            matrix[np.ix_(at, at)] += local[run]
            score[at] += slope[run]
    return Information(where, point, matrix, score)


def of_runs(
    model: Model,
    where: Layout,
    local: Floats,
    base: Parameters,
    data: Data,
    chosen: Sequence[int] | None = None,
) -> tuple[Floats, Floats]:
    """Information (runs, m, m) and score (runs, m) of each run in its own numbers, `local` (runs, m).

    `chosen` selects some of the numbers.
    """
    flat = where.of_one_run()

    def measure(local: Floats) -> tuple[dict[str, Any], Floats]:
        return jax.tree.map(np.asarray, _innovations(model, flat, local, base=base, data=data))

    middle, _ = measure(local)
    white, spread, gain = [], [], []
    factors = {name: np.linalg.inv(np.linalg.cholesky(cov)) for name, (_, cov, _) in middle.items()}
    for i in range(local.shape[1]) if chosen is None else chosen:
        step = np.zeros(local.shape[1])
        step[i] = _STEP
        (ahead, higher), (behind, lower) = measure(local + step), measure(local - step)
        first, second = [], []
        for name, (_, _, used) in middle.items():
            both = used & ahead[name][2] & behind[name][2]
            moved = (ahead[name][0] - behind[name][0]) / (2.0 * _STEP) * both
            grown = (ahead[name][1] - behind[name][1]) / (2.0 * _STEP)
            grown = grown * both[..., None] * both[..., None, :]
            a = _apply(factors[name], moved)
            b = factors[name] @ grown @ np.swapaxes(factors[name], -1, -2)
            first.append(a.reshape(len(local), -1))
            second.append(b.reshape(len(local), -1))
        white.append(np.concatenate(first, axis=1))
        spread.append(np.concatenate(second, axis=1))
        gain.append((higher - lower) / (2.0 * _STEP))
    a, b = np.stack(white, axis=1), np.stack(spread, axis=1)
    found = a @ a.transpose(0, 2, 1) + 0.5 * b @ b.transpose(0, 2, 1)
    return found, np.stack(gain, axis=1)


def _apply(factor: Floats, vectors: Floats) -> Floats:
    return (factor @ vectors[..., None])[..., 0]


@partial(jit, static_argnums=(0, 1))
def _innovations(
    model: Model, flat: Layout, local: Array, *, base: Parameters, data: Data
) -> tuple[dict[str, tuple[Array, Array, Array]], Array]:
    """Residual, covariance and mask of each sensor after the burn-in, and each run's log-likelihood."""
    every = jax.vmap(partial(flat.from_free, base=base._replace(setup=())))(local)
    output = run_batch(model, every._replace(setup=data.setup), data, "everything")
    found = {}
    for name, innovation in output.innovations.items():
        counted = data.counted if name in data.steps.fast else data.counted[:, :, -1]
        used = innovation.used & counted[..., None]
        found[name] = (innovation.residual, innovation.cov, used)
    likelihood = jnp.where(data.counted, output.instants.log_likelihood, 0.0)
    return found, jnp.sum(likelihood, axis=(1, 2))


_MORE = {
    "noise.bias_walk": "recordings of some minutes",
    "noise.accelerometer_walk": "recordings of some minutes",
    "noise.gyroscope": "times without the tracker, or a better tracker",
    "noise.accelerometer": "times without the tracker, or a better tracker",
    "noise.acceleration": "motion that changes",
    "calibration.gyroscope_matrix": "turning about each axis, to and fro, faster and slower",
    "calibration.accelerometer_matrix": "the tool at rest with each of its axes up and down",
    "calibration.alignment": "turning about two axes or more",
    "calibration.clock_offset": "turning that gets faster and slower",
    "calibration.latency": "motion that gets faster and slower",
    "calibration.clock_drift": "recordings of ten minutes, with turning at both ends",
    "calibration.lever_arm": "turning about two axes or more while the tool moves little",
    "initial": "more runs, for each begins only once",
}


def informative_motion(name: str) -> str:
    """Recordings that would determine a parameter, in words."""
    return _MORE.get(name, _MORE.get(name.split(".")[0], "longer recordings with more motion"))


def interval(layout: Layout, free: Any, sigma: Any) -> list[tuple[float, float, float]]:
    """Value and 95 % interval of each free number, in the parameter's unit.

    For a logarithm it is the interval of the value itself; below the diagonal of a full matrix that of the
    entry divided by the diagonal one of its row.
    """
    found = []
    for (leaf, i), value, deviation in zip(layout.numbers(), free, sigma, strict=True):
        half = _Z95 * float(deviation)
        ends = [leaf.unbounded(float(value) + off, i) for off in (0.0, -half, half)]
        if leaf.is_logarithm(i):
            ends = [float(np.exp(end)) for end in ends]
        elif leaf.kind == "linear":
            ends = [end * leaf.step for end in ends]
        found.append((ends[0], ends[1], ends[2]))
    return found
