"""What the statistics of innovations and errors mean, in words, and what to look for.

One fault shows in many statistics. So what a known fault explains is taken out of the innovations before
the rest is judged, and of the rest's size and correlation only their pattern names a cause: with too
little noise given to a sensor the gain is too high, which leaves no positive correlation; with too little
given to the prediction, or an error that lasts, it does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxekf._support.deprecations import renamed
from jaxekf.evaluation.consistency import BAND, Consistency, Whiteness

FEWEST = 50
"""Samples without which there is no verdict."""
FEWEST_EFFECTIVE = 10.0
"""The same for independent samples of errors against truth."""
_FACTOR = 1.1
"""Deviations wrong by less are not worth a word."""
_PART_FACTOR = 1.2
_FAULT_P = 1e-8
_WHITE_P = 1e-6
_EFFECT = 0.1
"""A fault that leaves less in innovations, against noise of 1, is not worth a word."""
_LESSER = 0.25
"""A fault of less effect than this share of the largest may be what its linearisation left over."""
_CORRELATION = 0.05
_SUM = 0.5
_SIGMAS = 6.0
_SLOW = 2.5


@dataclass(frozen=True)
class Fault:
    """Something that is not noise, found in the innovations of an attitude."""

    kind: str
    """`latency`, `gyroscope_bias` or `gyroscope_matrix`."""
    size: tuple[float, ...]
    """Seconds by which samples are older than stamped; rad/s by which the bias is off; the gyroscope's
    matrix less what it was taken for, by rows."""
    sigma: tuple[float, ...]
    unit: str
    p: float
    """Probability of as much where there is none."""
    effect: float
    """Root mean square of what it leaves in whitened innovations, of which noise leaves 1."""


@dataclass(frozen=True)
class Verdict:
    """One thing that is wrong, for a program and for a person."""

    kind: str
    """`noise_too_small`, `noise_too_large`, `process_noise_too_large`, `outliers`, `correlated`, `biased`,
    `latency`, `gyroscope_bias`, `gyroscope_matrix`, `overconfident` or `underconfident`."""
    about: str
    """The sensor, or the output that was compared with truth."""
    factor: float
    """How many times larger deviations are than said; below 1 where they are smaller."""
    size: float | None
    """How large the fault is, in `unit`, where it has a size of its own."""
    unit: str
    sentence: str
    """What was seen, and what to look for."""

    def __str__(self) -> str:
        return self.sentence


def significant_faults(faults: Sequence[Fault]) -> list[Fault]:
    """Those faults that are certain, and matter."""
    largest = max((fault.effect for fault in faults), default=0.0)
    least = max(_EFFECT, _LESSER * largest)
    return [fault for fault in faults if fault.p < _FAULT_P and fault.effect >= least]


def judge_fault(sensor: str, nis: Consistency, fault: Fault) -> Verdict:
    """The verdict on a certain fault."""
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
        each = ", ".join(f"{x:.3f}" for x in np.rad2deg(size))
        sentence = (
            f"innovations of {sensor} keep to one side as with a gyroscope bias off by ({each}) deg/s: the"
            " bias is held fixed, its walk is too small, or its initial deviation is; widen them"
        )
    else:
        worth = float(np.abs(size).max())
        sentence = (
            f"innovations of {sensor} follow the integrated rate as with a gyroscope matrix off by"
            f" {100 * worth:.1f} %: look for scale or misalignment of the gyroscope, and tune the"
            " calibration"
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
    """Verdicts on a sensor's innovations, without those faults that are `explained` already.

    `labels` name the sensor's rows; `memory_s` is the filter's time constant under this sensor, where it
    is known.
    """
    known = [fault.kind for fault in explained]
    found, rest = [], f"the rest of the innovations of {sensor}" if explained else sensor
    first = float(white.autocorrelation.mean(axis=0)[:5].mean())
    certain = white.p < _WHITE_P
    sums = abs(white.total) > _SIGMAS * white.total_sigma
    positive = (certain and first > _CORRELATION) or (sums and white.total > _SUM)
    negative = not positive and (certain or sums) and white.total < 0.0
    if "gyroscope_bias" in known:
        positive = False  # A bias that wanders while it is held leaves more than its mean explains.
    left = np.sqrt(max(nis.mean - 1.0, 0.0))
    if left < _LESSER * max((fault.effect for fault in explained), default=0.0):
        positive = False  # What a large fault leaves beyond first order.
    one_sided = bool(np.any(np.abs(white.mean) > np.maximum(_SIGMAS * white.mean_sigma, _EFFECT)))
    slow = positive and memory_s is not None and white.correlated_s > _SLOW * memory_s
    if "gyroscope_bias" not in known and (one_sided or slow):
        found.append(_lasting(sensor, nis, white, memory_s))
        positive = False
    off = not nis.interval[0] <= 1.0 <= nis.interval[1]
    large, small = off and nis.factor > _FACTOR, off and nis.factor < 1.0 / _FACTOR
    if positive and not small:
        found.append(_correlated(sensor, nis, white, memory_s, rest))
    elif large:
        found.append(_too_small(sensor, nis, white, labels))
    elif negative and (small or first < -_CORRELATION):
        found.append(
            _verdict(
                "process_noise_too_large",
                sensor,
                nis,
                f"innovations of {sensor} are {1 / nis.factor:.2f} times smaller than said and change sides"
                " too often: the process noise (of the gyroscope, or of the motion) is set too large",
            )
        )
    elif small:
        found.append(
            _verdict(
                "noise_too_large",
                sensor,
                nis,
                f"{sensor} noise is set too large by {1 / nis.factor:.2f}x (deviation): lower it or"
                " tune it, or the process noise where that is the larger part of what is said"
                f"{_by_row(labels, white)}",
            )
        )
    return found


def _verdict(kind: str, about: str, squares: Consistency, sentence: str) -> Verdict:
    return Verdict(kind, about, squares.factor, None, "", sentence)


def _by_row(labels: Sequence[str], white: Whiteness) -> str:
    """Which rows stand out, where they are not all alike."""
    low, high = int(np.argmin(white.scale)), int(np.argmax(white.scale))
    if white.scale[high] < 1.25 * white.scale[low]:
        return ""
    shown = [f"{labels[i] or 'its row'} {white.scale[i]:.2f}x" for i in (low, high)]
    return f"; rows differ, from {shown[0]} to {shown[1]} of what is said"


def _too_small(sensor: str, nis: Consistency, white: Whiteness, labels: Sequence[str]) -> Verdict:
    """Larger innovations without positive correlation: all of them, or a few."""
    if nis.typical - 1.0 < 0.3 * (nis.mean - 1.0):
        return _verdict(
            "outliers",
            sensor,
            nis,
            f"most innovations of {sensor} are as large as said, a few are far larger (mean square"
            f" {nis.mean:.2f}, typical {nis.typical:.2f}): look for outliers, and gate them",
        )
    return _verdict(
        "noise_too_small",
        sensor,
        nis,
        f"{sensor} noise is set too small by {nis.factor:.2f}x (deviation): raise it or tune it"
        f"{_by_row(labels, white)}",
    )


def _lasting(sensor: str, nis: Consistency, white: Whiteness, memory_s: float | None) -> Verdict:
    """Innovations that keep to one side, or wander far more slowly than the filter forgets."""
    shown = ", ".join(f"{x:.2f}" for x in white.mean)
    if memory_s is None:
        return _verdict(
            "biased",
            sensor,
            nis,
            f"innovations of {sensor} are off to one side by ({shown}) of their deviations: look for a bias"
            " that is held fixed, or an error of alignment, lever arm, geometry or gravity",
        )
    return _verdict(
        "gyroscope_bias",
        sensor,
        nis,
        f"innovations of {sensor} wander over {_lasts(white)}, on average ({shown}) of their deviations off"
        " to one side: the gyroscope's bias is held fixed or its walk is too small, or gravity, where it is"
        " used, is wrong",
    )


def _lasts(white: Whiteness) -> str:
    """For how long innovations are correlated, in words."""
    if white.correlated_s >= 0.6 * white.lag_s[-1]:
        return f"{white.lag_s[-1]:.2g} s and longer"
    return f"{white.correlated_s:.2g} s"


def _correlated(
    sensor: str, nis: Consistency, white: Whiteness, memory_s: float | None, rest: str
) -> Verdict:
    """Positive correlation: the prediction errs for longer than the filter thinks."""
    look = "latency, misalignment or wrong geometry, or process noise that is set too small"
    if memory_s is not None:
        look = "process noise (of the gyroscope, or of the motion) that is set too small"
    size = f" and {nis.factor:.2f} times as large as said" if nis.factor > _FACTOR else ""
    name = f"{rest} is" if rest != sensor else f"innovations of {sensor} are"
    sentence = f"{name} correlated over {_lasts(white)}{size}: look for {look}"
    return _verdict("correlated", sensor, nis, sentence)


def judge_part(part: str, nees: Consistency) -> list[Verdict]:
    """Verdicts on errors against truth."""
    if nees.interval[0] <= 1.0 <= nees.interval[1]:
        return []
    if nees.factor > _PART_FACTOR:
        return [
            _verdict(
                "overconfident",
                part,
                nees,
                f"errors of {part} are {nees.factor:.2f} times as large as said: do not trust its"
                " deviations",
            )
        ]
    if nees.factor < 1.0 / _PART_FACTOR:
        return [
            _verdict(
                "underconfident",
                part,
                nees,
                f"errors of {part} are {1 / nees.factor:.2f} times smaller than said: noise is set"
                " too large",
            )
        ]
    return []


def insufficient_samples(about: str, squares: Consistency, *, truth: bool = False) -> str:
    """Why there is no verdict on a sensor or part; empty where there is enough to judge."""
    if squares.samples < FEWEST:
        return f"{about}: {squares.samples} samples are too few to judge, {FEWEST} are needed"
    if truth and squares.effective < FEWEST_EFFECTIVE:
        return (
            f"{about}: errors last so long that {squares.samples} samples tell as much as"
            f" {squares.effective:.0f} independent ones, too few to judge ({FEWEST_EFFECTIVE:.0f})"
        )
    return ""


def summary_line(about: str, squares: Consistency) -> str:
    """Numbers on which a verdict is based, in a line."""
    low, high = squares.interval
    return (
        f"{about} {squares.mean:.2f} ({low:.2f} to {high:.2f}), {100 * squares.inside:.0f} % inside the"
        f" {100 * BAND:.0f} % band"
    )


__getattr__ = renamed(
    __name__,
    {
        "in_order": "summary_line",
        "named_faults": "significant_faults",
        "too_few": "insufficient_samples",
    },
)
