"""The arrays that the filter scans over: samples laid out by epoch and substep.

`jaxekf.estimation.timeline` makes them from a recording.
"""

from typing import Any, NamedTuple


class Rows(NamedTuple):
    """Samples of one sensor, one for each substep or epoch; leading axes (K, S) or (K,)."""

    value: Any
    """The sample; hidden numbers may be anything, NaN included."""
    aux: Any
    """Auxiliary data of `Sensor.predict`; finite also where the sample is hidden."""
    mask: Any
    """(..., m) True where a row is visible."""
    dt: Any
    """Sampling period in seconds: the time since the sensor's previous sample, nominal after a gap."""


class Knots(NamedTuple):
    """A sampled input as a piecewise linear function of time since the start of the run."""

    time: Any
    """(N,) seconds."""
    value: Any
    """(N, c)."""
    integral: Any
    """(N, c) trapezoidal integral from the first knot."""


class Steps(NamedTuple):
    """The inputs of the filter: K epochs of S substeps."""

    time: Any
    """(K, S) seconds since the start of the run, at the end of each substep."""
    dt: Any
    """(K, S) seconds; 0 in padding."""
    valid: Any
    """(K, S) False in padding."""
    knots: Knots | None
    fast: dict[str, Rows]
    """Sensors sampled at substeps, leading axes (K, S)."""
    slow: dict[str, Rows]
    """Sensors sampled at the end of epochs, leading axis (K,)."""
