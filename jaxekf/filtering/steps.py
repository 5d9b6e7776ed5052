"""The arrays that the filter scans over: samples laid out by epoch and substep.

`jaxekf.estimation.timeline` makes them from a recording.
"""

from typing import Any, NamedTuple


class Rows(NamedTuple):
    """Samples of one sensor, one for each substep or epoch; leading axes (K, S) or (K,).

    Examples
    --------
    The share of epochs at whose end the tracker sees the tool:

    >>> import jaxekf
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> rows = line.steps.slow["optical"]
    >>> rows.value.shape, rows.mask.shape
    ((1501, 4), (1501, 3))
    >>> print(f"{rows.mask.all(axis=-1).mean():.0%}")
    85%
    """

    value: Any
    """The sample; hidden numbers may be anything, NaN included."""
    aux: Any
    """Auxiliary data of `Sensor.predict`; finite also where the sample is hidden."""
    mask: Any
    """(..., m) True where a row is visible."""
    dt: Any
    """Sampling period in seconds: the time since the sensor's previous sample, nominal after a gap."""


class Knots(NamedTuple):
    """A sampled input as a piecewise linear function of time since the start of the run.

    Examples
    --------
    The mean rate over the whole run from its integral:

    >>> import numpy as np
    >>> import jaxekf
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> knots = line.steps.knots
    >>> mean = (knots.integral[-1] - knots.integral[0]) / (knots.time[-1] - knots.time[0])
    >>> print(np.rad2deg(mean).round(1))  # deg/s
    [ 0.8  0.1 -0.1]
    """

    time: Any
    """(N,) seconds."""
    value: Any
    """(N, c) samples of c channels."""
    integral: Any
    """(N, c) trapezoidal integral from the first knot."""


class Steps(NamedTuple):
    """The inputs of the filter: K epochs of S substeps.

    Examples
    --------
    The gyroscope has two samples for one of the tracker:

    >>> import jaxekf
    >>> model = jaxekf.get_model("loose")
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> steps = line.steps
    >>> steps.dt.shape, list(steps.fast), list(steps.slow), steps.knots.value.shape
    ((1501, 2), [], ['optical'], (3001, 3))
    >>> print(f"{steps.dt.sum():.2f} s, padding {1.0 - steps.valid.mean():.2%}")
    24.00 s, padding 0.03%
    """

    time: Any
    """(K, S) seconds since the start of the run, at the end of each substep."""
    dt: Any
    """(K, S) seconds; 0 in padding."""
    valid: Any
    """(K, S) False in padding."""
    knots: Knots | None
    """The sampled input; None for a model without."""
    fast: dict[str, Rows]
    """Sensors sampled at substeps, leading axes (K, S)."""
    slow: dict[str, Rows]
    """Sensors sampled at the end of epochs, leading axis (K,)."""
    excess: Any = None
    """(K, S, n) variances that a substep adds to those of the error vector, beside the process noise: of
    the rotation that an input at the limit of its range does not contain. None for a run without."""
