"""Constant offset (hard iron) and unequal axes (soft iron) of a magnetometer, by the size of the field.

The field in the sensor's frame moves on a sphere about the sensor's offset while the body turns, and on an
ellipsoid where iron beside the sensor distorts it. Both follow from the samples alone, where the body
turned about more than one axis; a field that is disturbed for a part of the run fits neither.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxekf.checks._findings import Findings
from jaxekf.checks.sensor_agreement import Evidence
from jaxekf.recordings.types import Floats, Recording

_FEWEST, _MOST, _BLOCKS = 200, 2000, 10
_LARGE, _SURE, _SIGNIFICANT = 0.05, 0.02, 5.0
"""Offset that matters, largest uncertainty at which it is stated, as shares of the field; and the offset in
its uncertainties."""
_SCATTER = 0.1
"""Scatter of the field's size about the fit, as its share, above which the field is disturbed."""
_BETTER, _UNEQUAL = 3.0, 0.03
"""Factor by which an ellipsoid reduces the variance left by a sphere, and the difference of its axes, from
which on it is the better description."""


class FieldFit(NamedTuple):
    """Sphere or ellipsoid through the samples of a magnetometer."""

    offset: Floats
    """(3,) in the magnetometer's unit."""
    sigma: Floats
    """(3,) standard deviations, by leaving out one of ten parts of the run at a time."""
    size: float
    """Size of the field."""
    scatter: float
    """Root mean square of the size's deviations, as a share."""
    axes: Floats
    """(3,) lengths of the axes over their mean; ones for a sphere."""


def field_findings(recording: Recording, found: Evidence) -> Findings:
    """A warning on a magnetometer with an offset, with the entry of `recording.toml` that corrects it."""
    imu = recording.imu
    if imu is None or imu.magnetometer is None:
        return Findings()
    made = fit_field(imu.magnetometer)
    if made is None or made.scatter > _SCATTER or made.sigma.max() > _SURE * made.size:
        return Findings()
    warnings = []
    length = float(np.linalg.norm(made.offset))
    sigma = float(np.linalg.norm(made.sigma))
    if length > max(_LARGE * made.size, _SIGNIFICANT * sigma):
        values = ", ".join(_rounded(value, made.sigma.min()) for value in made.offset)
        spread = ", ".join(f"{value:.2g}" for value in made.sigma)
        warnings.append(
            f"the magnetometer has an offset of ({values}) ± ({spread}) in its unit,"
            f" {100.0 * length / made.size:.0f} % of the field of {made.size:.4g}: iron or a magnet moves"
            f" with it (hard iron); state [imu] magnetometer_offset = [{values}] in recording.toml, which"
            " is subtracted when the run is read"
        )
    if np.ptp(made.axes) > _UNEQUAL:
        axes = ", ".join(f"{value:.3f}" for value in made.axes)
        warnings.append(
            f"the field is an ellipsoid with axes of {axes} times their mean (soft iron, or unequal gains"
            " of the magnetometer's axes): calibrate the magnetometer beside its iron"
        )
    return Findings(tuple(warnings))


def fit_field(samples: Floats) -> FieldFit | None:
    """The fit to samples (N, 3), NaN where none was read; None where the body turned too little, or where
    parts of the run contradict each other.

    Examples
    --------
    >>> import numpy as np
    >>> ways = np.random.default_rng(0).normal(size=(1000, 3))
    >>> field = 50.0 * ways / np.linalg.norm(ways, axis=1, keepdims=True) + [9.0, 0.0, -3.0]
    >>> made = fit_field(field)
    >>> print(made.offset.round(3) + 0.0, round(made.size, 3))
    [ 9.  0. -3.] 50.0
    """
    samples = samples[np.isfinite(samples).all(axis=1) & samples.any(axis=1)]
    if len(samples) < _FEWEST:
        return None
    samples = samples[:: -(-len(samples) // _MOST)]
    unit = float(np.linalg.norm(samples, axis=1).mean())
    scaled = samples / unit
    parts = np.array_split(np.arange(len(scaled)), _BLOCKS)
    fits = [_sphere, _ellipsoid]
    left = []
    for fit in fits:
        made = fit(scaled)
        left.append(np.inf if made is None else made[2])
    better = left[1] * _BETTER < left[0] and np.ptp(_axes(_ellipsoid(scaled))) > _UNEQUAL
    fit = fits[1] if better else fits[0]
    whole = fit(scaled)
    some = [fit(np.delete(scaled, part, axis=0)) for part in parts]
    if whole is None or any(one is None for one in some):
        return None
    offsets = np.array([one[0] for one in some if one is not None])
    halves = [] if better else [_sphere(half) for half in np.array_split(scaled, 2)]
    agreed = [one[0] for one in halves if one is not None and one[2] < _SCATTER**2]
    if len(agreed) == 2 and np.linalg.norm(agreed[0] - agreed[1]) > _LARGE:
        return None
    sigma = np.sqrt((_BLOCKS - 1.0) * offsets.var(axis=0))
    offset, shape, variance = whole
    size = 1.0 / float(np.cbrt(np.sqrt(np.linalg.det(shape))))
    axes = _axes(whole) if better else np.ones(3)
    return FieldFit(unit * offset, unit * sigma, unit * size, float(np.sqrt(variance)), axes)


_TRACELESS = tuple(
    np.array(one, float)
    for one in (
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, -1]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    )
)
_Quadric = tuple[Floats, Floats, float]
"""Centre c, matrix M of ``(x - c)' M (x - c) = 1``, and the variance of the size, as a share."""


def _sphere(x: Floats) -> _Quadric | None:
    rows = np.concatenate([2.0 * x, np.ones((len(x), 1))], axis=1)
    made = _solved(rows, np.sum(x * x, axis=1), lambda s: (np.eye(3), s[:3], s[3]))
    return None if made is None else _refined(x, *made, [])


def _ellipsoid(x: Floats) -> _Quadric | None:
    """The quadric whose matrix has the trace 3."""
    a, b, c = x.T
    square = a * a + b * b + c * c
    unequal = np.stack(
        [a * a + b * b - 2.0 * c * c, a * a - 2.0 * b * b + c * c, 2 * a * b, 2 * a * c, 2 * b * c],
        axis=1,
    )
    rows = np.concatenate([-unequal, 2.0 * x, np.ones((len(x), 1))], axis=1)

    def parts(s: Floats) -> tuple[Floats, Floats, float]:
        matrix = np.array(
            [
                [1.0 + s[0] + s[1], s[2], s[3]],
                [s[2], 1.0 + s[0] - 2.0 * s[1], s[4]],
                [s[3], s[4], 1.0 - 2.0 * s[0] + s[1]],
            ]
        )
        return matrix, s[5:8], s[8]

    made = _solved(rows, square, parts)
    if made is None:
        return None
    return _refined(x, *made, _TRACELESS)


def _solved(
    rows: Floats, right: Floats, parts: Callable[[Floats], tuple[Floats, Floats, float]]
) -> tuple[Floats, Floats] | None:
    """Centre and matrix of the quadric ``x' A x - 2 b' x = c`` that fits best in its squares."""
    solution, _, rank, _ = np.linalg.lstsq(rows, right, rcond=1e-6)
    if rank < rows.shape[1]:
        return None
    matrix, linear, constant = parts(np.asarray(solution, float))
    if np.linalg.eigvalsh(matrix).min() < 0.05:
        return None
    centre = np.asarray(np.linalg.solve(matrix, linear), float)
    level = float(constant + centre @ matrix @ centre)
    return (centre, matrix / level) if level > 0.0 else None


def _refined(x: Floats, centre: Floats, matrix: Floats, units: Sequence[Floats]) -> _Quadric | None:
    """The quadric that fits best in the sizes of the field, for a fit of squares is off by the noise.

    Four steps of Gauss-Newton in the centre c, the radius r and the symmetric factor U, of trace 3, which
    moves by the `units`: ``|U (x - c)| - r`` is small.
    """
    values, ways = np.linalg.eigh(matrix)
    factor = (ways * np.sqrt(values)) @ ways.T
    radius = 3.0 / float(np.trace(factor))
    factor *= radius
    for _ in range(4):
        apart = x - centre
        whitened = apart @ factor
        size = np.linalg.norm(whitened, axis=1)
        way = whitened / size[:, None]
        columns = [np.sum(way * (apart @ one), axis=1) for one in units]
        slope = np.stack([*(-way @ factor).T, -np.ones(len(x)), *columns], axis=1)
        try:
            step = np.linalg.solve(slope.T @ slope, slope.T @ (radius - size))
        except np.linalg.LinAlgError:
            return None
        centre, radius = centre + step[:3], radius + step[3]
        factor = factor + sum(
            (a * one for a, one in zip(step[4:], units, strict=True)), np.zeros((3, 3))
        )
        if not np.isfinite(step).all() or radius <= 0.0 or np.linalg.eigvalsh(factor)[0] < 0.05:
            return None
    size = np.linalg.norm((x - centre) @ factor, axis=1) / radius
    return centre, factor @ factor / radius**2, float(np.mean((size - 1.0) ** 2))


def _axes(made: _Quadric | None) -> Floats:
    if made is None:
        return np.ones(3)
    lengths = 1.0 / np.sqrt(np.linalg.eigvalsh(made[1]))
    return np.sort(lengths / lengths.mean())


def _rounded(value: float, sigma: float) -> str:
    """A value with the digits that its uncertainty leaves."""
    digits = max(0, -int(np.floor(np.log10(max(sigma, 1e-9)))))
    return f"{value:.{digits}f}"
