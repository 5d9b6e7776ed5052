"""Verdicts: an inconsistency in words, with its likely cause.

One fault changes many statistics. So the part that an identified fault explains is removed from the
innovations before the rest is judged, and the cause follows from the pattern of size and correlation: too
small a measurement noise makes the gain too high, which leaves no positive correlation; too small a process
noise, or a persistent error, leaves a positive one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxekf._support.deprecations import renamed
from jaxekf.evaluation.consistency import BAND, Consistency, Whiteness

FEWEST = 50
"""Fewest samples for a verdict."""
FEWEST_EFFECTIVE = 10.0
"""Fewest effectively independent samples of errors against ground truth."""
_FACTOR = 1.1
"""Smallest ratio of standard deviations that is reported."""
_PART_FACTOR = 1.2
_FAULT_P = 1e-8
_WHITE_P = 1e-6
_EFFECT = 0.1
"""Smallest effect of a fault in whitened innovations that is reported."""
_LESSER = 0.25
"""A fault with less effect than this share of the largest may be its linearisation error."""
_CORRELATION = 0.05
_SUM = 0.5
_SIGMAS = 6.0
_SLOW = 2.5


_Finding = tuple[str, str]
"""Kind and sentence of a verdict."""


@dataclass(frozen=True)
class Fault:
    """A systematic error found in the innovations of an attitude.

    Examples
    --------
    The tracker's stamps are 20 ms late:

    >>> from dataclasses import replace
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> optical = run.need_optical()
    >>> late = run.replace(optical=replace(optical, time_ns=optical.time_ns + 20_000_000))
    >>> fault = jaxekf.diagnose(jaxekf.estimate(late)).sensors["optical"].faults[0]
    >>> print(f"{fault.kind} {fault.size[0]:.2f} {fault.unit}, {fault.effect:.0f} times the noise")
    latency 0.02 s, 3 times the noise
    >>> fault.p < 1e-8
    True
    """

    kind: str
    """`latency`, `gyroscope_bias` or `gyroscope_matrix`."""
    size: tuple[float, ...]
    """Latency in s; bias error in rad/s; or gyroscope matrix minus the assumed one, by rows."""
    sigma: tuple[float, ...]
    """Standard deviation of each component of `size`."""
    unit: str
    """Unit of `size`: s, rad/s or 1."""
    p: float
    """P-value of the hypothesis that there is no fault."""
    effect: float
    """Root mean square contribution to whitened innovations, whose noise is 1."""


@dataclass(frozen=True)
class Verdict:
    """One inconsistency, for a program and for a person.

    Examples
    --------
    The tracker's stamps are 20 ms late:

    >>> from dataclasses import replace
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> optical = run.need_optical()
    >>> late = run.replace(optical=replace(optical, time_ns=optical.time_ns + 20_000_000))
    >>> verdict = jaxekf.diagnose(jaxekf.estimate(late)).verdicts[0]
    >>> print(f"{verdict.about}: {verdict.kind} of {verdict.size:.2f} {verdict.unit}")
    optical: latency of 0.02 s
    >>> print(str(verdict).partition("; ")[2])
    set the latency in recording.toml, or tune the calibration's clock offset or latency
    """

    kind: str
    """`noise_too_small`, `noise_too_large`, `process_noise_too_large`, `outliers`, `correlated`, `biased`,
    `latency`, `gyroscope_bias`, `gyroscope_matrix`, `overconfident` or `underconfident`."""
    about: str
    """The sensor, or the output that was compared with ground truth."""
    factor: float
    """Ratio of the actual to the predicted standard deviation."""
    size: float | None
    """Size of the fault in `unit`; None for a verdict without one."""
    unit: str
    """Unit of `size`; empty for a verdict without one."""
    sentence: str
    """The finding and its likely cause."""

    def __str__(self) -> str:
        return self.sentence


def significant_faults(faults: Sequence[Fault]) -> list[Fault]:
    """The faults that are significant and large enough to matter."""
    largest = max((fault.effect for fault in faults), default=0.0)
    least = max(_EFFECT, _LESSER * largest)
    return [fault for fault in faults if fault.p < _FAULT_P and fault.effect >= least]


def judge_fault(sensor: str, nis: Consistency, fault: Fault) -> Verdict:
    """The verdict on a significant fault."""
    size, sigma = np.array(fault.size), np.array(fault.sigma)
    if fault.kind == "latency":
        worth = float(size[0])
        what = "later" if worth > 0 else "earlier"
        sentence = (
            f"{sensor} is stamped {1e3 * abs(worth):.1f} ± {1e3 * sigma[0]:.1f} ms {what} than it was"
            " taken: its innovations follow the angular rate; set the latency in recording.toml, or tune"
            " the calibration's clock offset or latency"
        )
    elif fault.kind == "gyroscope_bias":
        worth = float(np.linalg.norm(size))
        each = ", ".join(
            f"{x:.3f} ± {s:.3f}" for x, s in zip(np.rad2deg(size), np.rad2deg(sigma), strict=True)
        )
        sentence = (
            f"innovations of {sensor} have the mean of a gyroscope bias error of ({each}) deg/s: the bias"
            " is fixed, or its random walk or initial deviation is too small; increase them"
        )
    else:
        at = int(np.argmax(np.abs(size) / np.maximum(sigma, np.finfo(float).tiny)))
        worth = float(np.abs(size[at]))
        row, column = divmod(at, 3)
        sentence = (
            f"innovations of {sensor} follow the integrated rate as with a gyroscope matrix error of"
            f" {100 * size[at]:.2f} ± {100 * sigma[at]:.2f} % in element {'xyz'[row]}{'xyz'[column]}: check"
            " scale and misalignment of the gyroscope, and tune the calibration"
        )
    return Verdict(fault.kind, sensor, nis.factor, worth, fault.unit, sentence)


def judge_sensor(
    sensor: str,
    nis: Consistency,
    white: Whiteness,
    *,
    labels: Sequence[str],
    memory_s: float | None = None,
    explained: Sequence[Fault] = (),
) -> list[Verdict]:
    """Verdicts on a sensor's innovations, without the `explained` faults.

    Parameters
    ----------
    sensor
        Name of the sensor.
    nis, white
        Statistics of its innovations.
    labels
        Names of the sensor's rows.
    memory_s
        Time constant of the filter under this sensor, s, if it is known.
    explained
        Faults that are removed from the innovations already.
    """
    known = [fault.kind for fault in explained]
    found: list[_Finding] = []
    rest = f"the rest of the innovations of {sensor}" if explained else sensor
    first = float(white.autocorrelation.mean(axis=0)[:5].mean())
    certain = white.p < _WHITE_P
    sums = abs(white.total) > _SIGMAS * white.total_sigma
    positive = (certain and first > _CORRELATION) or (sums and white.total > _SUM)
    negative = not positive and (certain or sums) and white.total < 0.0
    if "gyroscope_bias" in known:
        positive = False  # A drifting bias that is held fixed leaves more than its mean explains.
    left = np.sqrt(max(nis.mean - 1.0, 0.0))
    if left < _LESSER * max((fault.effect for fault in explained), default=0.0):
        positive = False  # The rest of a large fault beyond first order.
    one_sided = bool(np.any(np.abs(white.mean) > np.maximum(_SIGMAS * white.mean_sigma, _EFFECT)))
    slow = positive and memory_s is not None and white.correlated_s > _SLOW * memory_s
    if "gyroscope_bias" not in known and (one_sided or slow):
        found.append(_biased(sensor, white, memory_s))
        positive = False
    off = not nis.interval[0] <= 1.0 <= nis.interval[1]
    large, small = off and nis.factor > _FACTOR, off and nis.factor < 1.0 / _FACTOR
    if positive and not small:
        found.append(_correlated(sensor, nis, white, memory_s, rest))
    elif large:
        found.append(_too_small(sensor, nis, white, labels))
    elif negative and (small or first < -_CORRELATION):
        sentence = (
            f"innovations of {sensor} are {1 / nis.factor:.2f} times smaller than predicted and change sign"
            " too often: the process noise (of the gyroscope, or of the motion) is set too large"
        )
        found.append(("process_noise_too_large", sentence))
    elif small:
        sentence = (
            f"{sensor} noise is set too large by {1 / nis.factor:.2f}x (deviation): lower it or tune it, or"
            f" the process noise if that is the larger part of the covariance{_by_row(labels, white)}"
        )
        found.append(("noise_too_large", sentence))
    return [_verdict(finding, sensor, nis) for finding in found]


def _verdict(finding: _Finding, about: str, squares: Consistency) -> Verdict:
    kind, sentence = finding
    return Verdict(kind, about, squares.factor, None, "", sentence)


def _by_row(labels: Sequence[str], white: Whiteness) -> str:
    """The rows with the smallest and the largest scale, if they differ clearly."""
    low, high = int(np.argmin(white.scale)), int(np.argmax(white.scale))
    if white.scale[high] < 1.25 * white.scale[low]:
        return ""
    shown = [f"{labels[i] or 'its row'} {white.scale[i]:.2f}x" for i in (low, high)]
    return f"; rows differ, from {shown[0]} to {shown[1]} of the predicted deviation"


def _too_small(sensor: str, nis: Consistency, white: Whiteness, labels: Sequence[str]) -> _Finding:
    """Larger innovations without positive correlation: all of them, or a few."""
    if nis.typical - 1.0 < 0.3 * (nis.mean - 1.0):
        return "outliers", (
            f"most innovations of {sensor} are as large as predicted, a few are far larger (mean square"
            f" {nis.mean:.2f}, typical {nis.typical:.2f}): check for outliers, and gate them"
        )
    return "noise_too_small", (
        f"{sensor} noise is set too small by {nis.factor:.2f}x (deviation): raise it or tune it"
        f"{_by_row(labels, white)}"
    )


def _biased(sensor: str, white: Whiteness, memory_s: float | None) -> _Finding:
    """Innovations with a mean, or correlated for much longer than the filter's time constant."""
    shown = ", ".join(f"{x:.2f}" for x in white.mean)
    if memory_s is None:
        return "biased", (
            f"innovations of {sensor} have a mean of ({shown}) of their deviations: check for a fixed bias,"
            " or an error of alignment, lever arm, geometry or gravity"
        )
    return "gyroscope_bias", (
        f"innovations of {sensor} drift over {_correlation_time(white)}, with a mean of ({shown}) of their"
        " deviations: the gyroscope's bias is fixed or its random walk is too small, or gravity is wrong in"
        " a model that uses it"
    )


def _correlation_time(white: Whiteness) -> str:
    """Correlation time in words."""
    if white.correlated_s >= 0.6 * white.lag_s[-1]:
        return f"{white.lag_s[-1]:.2g} s and longer"
    return f"{white.correlated_s:.2g} s"


def _correlated(
    sensor: str, nis: Consistency, white: Whiteness, memory_s: float | None, rest: str
) -> _Finding:
    """Positive correlation: the prediction errs for longer than the filter assumes."""
    look = "latency, misalignment or wrong geometry, or process noise that is set too small"
    if memory_s is not None:
        look = "process noise (of the gyroscope, or of the motion) that is set too small"
    size = f" and {nis.factor:.2f} times as large as predicted" if nis.factor > _FACTOR else ""
    name = f"{rest} is" if rest != sensor else f"innovations of {sensor} are"
    return (
        "correlated",
        f"{name} correlated over {_correlation_time(white)}{size}: check for {look}",
    )


def judge_part(part: str, nees: Consistency) -> list[Verdict]:
    """Verdicts on errors against ground truth."""
    if nees.interval[0] <= 1.0 <= nees.interval[1]:
        return []
    times = f"errors of {part} are {max(nees.factor, 1 / nees.factor):.2f} times"
    if nees.factor > _PART_FACTOR:
        sentence = f"{times} as large as predicted: its deviations are too small"
        return [_verdict(("overconfident", sentence), part, nees)]
    if nees.factor < 1.0 / _PART_FACTOR:
        sentence = f"{times} smaller than predicted: noise is set too large"
        return [_verdict(("underconfident", sentence), part, nees)]
    return []


def insufficient_samples(about: str, squares: Consistency, *, truth: bool = False) -> str:
    """Reason why there is no verdict on a sensor or output; empty if there are samples enough."""
    if squares.samples < FEWEST:
        return f"{about}: {squares.samples} samples are too few to judge, {FEWEST} are needed"
    if truth and squares.effective < FEWEST_EFFECTIVE:
        return (
            f"{about}: errors are so correlated that {squares.samples} samples equal"
            f" {squares.effective:.0f} independent ones, too few to judge ({FEWEST_EFFECTIVE:.0f})"
        )
    return ""


def summary_line(about: str, squares: Consistency) -> str:
    """The statistics behind a verdict in one line."""
    low, high = squares.interval
    return (
        f"{about} {squares.mean:.2f} ({low:.2f} to {high:.2f}), {100 * squares.inside:.0f} % inside the"
        f" {100 * BAND:.0f} % band"
    )


__getattr__ = renamed(
    __name__,
    "in_order>summary_line named_faults>significant_faults too_few>insufficient_samples",
)
