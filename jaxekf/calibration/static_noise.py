"""Sensor noise from a static recording, as initial values for tuning.

`static_noise` measures, `start_for` writes the result into a model's parameters, `write_curve` and
`as_dict` save it.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.deprecations import renamed
from jaxekf._support.errors import RecordingError
from jaxekf.calibration import static_interval
from jaxekf.calibration.allan import Curve, ImuNoise, SensorNoise, imu_noise
from jaxekf.calibration.noise_densities import Coefficient
from jaxekf.calibration.static_interval import TrackerNoise
from jaxekf.filtering.model import Model, Parameters
from jaxekf.recordings.types import NANOSECONDS, Floats, Recording

AXES = ("x", "y", "z")
_WALKS = {"gyroscope": "bias_walk", "accelerometer": "accelerometer_walk"}
_COLUMN_UNITS = {"rad/s": "rad_s", "m/s^2": "m_s2"}


class StaticNoise(NamedTuple):
    """Noise of the sensors of a static run."""

    run: str
    begin_s: float
    """Seconds from the IMU's first sample."""
    end_s: float
    imu: ImuNoise
    tracker: TrackerNoise

    @property
    def sensors(self) -> dict[str, SensorNoise]:
        """Gyroscope and, if there is one, accelerometer."""
        found = {"gyroscope": self.imu.gyroscope}
        if self.imu.accelerometer is not None:
            found["accelerometer"] = self.imu.accelerometer
        return found


class NoiseStart(NamedTuple):
    """Parameters to start tuning from."""

    params: Parameters
    """The model's defaults with the measured noise."""
    taken: tuple[str, ...]
    """Names of the noise parameters that were measured."""
    sentences: tuple[str, ...]
    """Warnings, and reasons why a parameter keeps its default."""


def static_noise(
    recording: Recording, begin_s: float | None = None, end_s: float | None = None
) -> StaticNoise:
    """Noise of a static interval.

    Parameters
    ----------
    recording
        The run.
    begin_s, end_s
        Static interval, s from the IMU's first sample. Without either, the static interval at the start of
        the run is found by `static_interval.static_head`.

    Raises
    ------
    RecordingError
        If the interval is too short or outside the run.

    Examples
    --------
    >>> import jaxekf, numpy as np
    >>> from jaxekf.calibration import static_noise
    >>> found = static_noise.static_noise(jaxekf.load(jaxekf.demo.FOLDER / "constant-rate"))
    >>> white = np.rad2deg(found.imu.gyroscope.white)  # deg/s/sqrt(Hz); the simulator has 0.05
    >>> bool((np.abs(white - 0.05) < 0.02).all())
    True
    """
    imu = recording.need_imu()
    last = float(imu.time_ns[-1] - imu.time_ns[0]) / NANOSECONDS
    if begin_s is None and end_s is None:
        begin, end = 0.0, static_interval.static_head(recording)
    else:
        begin, end = begin_s or 0.0, min(last, last if end_s is None else end_s)
        if begin >= end:
            raise RecordingError(
                str(recording.path or recording.name),
                f"the stretch from {begin:g} to {end:g} s",
                f"one within the {last:g} s of the run",
                "another --from and --to",
            )
    found = imu_noise(static_interval.cut_imu(imu, begin, end), recording.path or recording.name)
    return StaticNoise(
        recording.name,
        begin,
        end,
        found,
        static_interval.tracker_noise(recording, begin, end, last),
    )


def start_for(model: Model, found: StaticNoise) -> NoiseStart:
    """The model's defaults with the measured noise, axis by axis.

    A bias walk that is not significant keeps its default, or the upper end of its confidence interval
    if that is smaller.
    """
    noise, units = model.parameters.noise, model.units.noise
    known = _known(found)
    changes: dict[str, Any] = {}
    sentences = []
    for name, (value, unit) in known.items():
        # The same name in another unit is another quantity, such as a deviation of samples.
        if unit != getattr(units, name, None):
            continue
        if not np.all(value > 0.0):
            sentences.append(
                f"{name} is zero on an axis, which a filter cannot use: the default is kept"
            )
            continue
        changes[name] = value
    for label, sensor in found.sensors.items():
        name = _WALKS[label]
        if name in noise._fields:
            value, text = _walk(name, sensor, np.asarray(getattr(noise, name), float), found)
            if value is not None:
                changes[name] = value
            sentences += text
    for label, sensor in found.sensors.items():
        bands, half = [axis_noise.band_hz for axis_noise in sensor.axes], 0.5 / sensor.curve.tau[0]
        if min(bands) < 0.9 * half and label in changes:
            sentences.append(
                f"{label}: densities are valid up to {min(bands):.2g} Hz; from there to {half:.3g} Hz the"
                " noise is not white"
            )
    for label, scatter in found.tracker._asdict().items():
        if scatter is not None and scatter.wanders and label in changes:
            sentences.append(
                f"{label}: the deviation about the mean is {scatter.wander:.1f} times that from sample to"
                " sample: the samples are filtered or drift, and the right noise is between the two"
            )
    params = model.parameters._replace(noise=noise._replace(**changes))
    return NoiseStart(params, tuple(changes), tuple(sentences))


def _known(found: StaticNoise) -> dict[str, tuple[Floats, str]]:
    """Deviations and densities by the names that models use, with their units."""
    known = {
        name: (sensor.white, f"{sensor.unit}/sqrt(Hz)") for name, sensor in found.sensors.items()
    }
    for name, unit in (("optical", "rad"), ("position", "m"), ("marker", "m")):
        scatter = getattr(found.tracker, name)
        if scatter is not None:
            known[name] = (scatter.value, unit)
    return known


def _walk(
    name: str, sensor: SensorNoise, default: Floats, found: StaticNoise
) -> tuple[Floats | None, list[str]]:
    """The walk of each axis if it is significant, and a sentence on the other axes."""
    walks = [axis.walk_alone for axis in sensor.axes]
    significant = np.array([walk.significant for walk in walks])
    if significant.all():
        return np.array([walk.value for walk in walks]), []
    high = np.array([walk.high for walk in walks])
    usual = np.broadcast_to(default if default.ndim < 2 else np.diagonal(default), (3,))
    value = np.where(significant, [walk.value for walk in walks], np.minimum(usual, high))
    limits = ", ".join(
        f"{shown(high[i], sensor.unit, '/s/√Hz')} ({AXES[i]})" for i in np.flatnonzero(~significant)
    )
    kept = "the default is kept" if np.all(usual <= high) else "the bound is used"
    sentence = (
        f"{name}: {found.imu.duration_s:.0f} s are too short to estimate a random walk of the bias; it is"
        f" below {limits}; {kept}"
    )
    unchanged = not significant.any() and bool(np.all(usual <= high))
    return (None if unchanged or not np.all(value > 0.0) else value), [sentence]


def shown(value: float, unit: str, suffix: str) -> str:
    """A number with its unit for display, degrees for radians."""
    if unit.startswith("rad"):
        value, unit = float(np.rad2deg(value)), unit.replace("rad", "deg", 1)
    return f"{value:.2g} {_pretty(unit + suffix)}"


def _pretty(unit: str) -> str:
    return unit.replace("/s/s", "/s²").replace("m/s^2/s", "m/s³").replace("^2", "²")


def curve_table(found: StaticNoise) -> tuple[list[str], Floats]:
    """The Allan deviation as columns: `tau_s`, then deviation, low and high of each sensor and axis.

    The unit is in each column name.
    """
    columns, values = ["tau_s"], [found.imu.gyroscope.curve.tau[:, None]]
    for label, sensor in found.sensors.items():
        unit = _COLUMN_UNITS[sensor.unit]
        for i, axis in enumerate(AXES):
            columns += [f"{label}_{axis}{part}_{unit}" for part in ("", "_low", "_high")]
            values += [getattr(sensor.curve, part)[:, [i]] for part in Curve._fields[1:]]
    return columns, np.concatenate(values, axis=1)


def as_dict(found: StaticNoise) -> dict[str, Any]:
    """The result as a JSON document, in SI units, without the curve."""
    document: dict[str, Any] = {
        "run": found.run,
        "begin_s": found.begin_s,
        "end_s": found.end_s,
        "samples": found.imu.samples,
        "samples_interpolated": found.imu.missing,
    }
    for label, sensor in found.sensors.items():
        floor, at = sensor.floor()
        document[label] = {"unit": sensor.unit}
        for i, axis in enumerate(AXES):
            axis_noise = sensor.axes[i]
            document[label][axis] = {
                "white": _interval(axis_noise.white),
                "walk": _interval(axis_noise.walk),
                "walk_standing_for_flicker": _interval(axis_noise.walk_alone),
                "flicker": axis_noise.flicker,
                "quantisation": axis_noise.quantisation,
                "floor": float(floor[i]),
                "floor_at_s": float(at[i]),
                "fitted_up_to_hz": axis_noise.band_hz,
            }
    for label, scatter in found.tracker._asdict().items():
        if scatter is not None:
            document[label] = {
                "unit": "rad" if label == "optical" else "m",
                "deviation": scatter.value.tolist(),
                "low": scatter.low.tolist(),
                "high": scatter.high.tolist(),
                "differences": scatter.samples,
                "wander": scatter.wander,
            }
    return document


def _interval(estimated: Coefficient) -> dict[str, Any]:
    return estimated._asdict() | {"found": estimated.significant}


def write_curve(path: Path, found: StaticNoise) -> None:
    """Write `curve_table` as a CSV file."""
    columns, values = curve_table(found)
    np.savetxt(path, values, "%.9g", ",", header=",".join(columns), comments="", encoding="utf-8")


__getattr__ = renamed(__name__, "Start>NoiseStart")
