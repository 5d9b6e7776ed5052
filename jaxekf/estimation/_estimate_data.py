"""An estimate in memory: named arrays with units and frames, and what follows from them."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, Self

import jax
import numpy as np

from jaxekf.estimation.clock import Clock
from jaxekf.filtering.model import Model, Parameters
from jaxekf.geometry import manifold
from jaxekf.recordings.types import NANOSECONDS, Floats, Times


@dataclass(frozen=True)
class OutputEstimate:
    """A quantity over time with its uncertainty.

    Examples
    --------
    The gyroscope's bias at the end of the run, and its standard deviations:

    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5")
    >>> bias = estimate.bias
    >>> bias.value.shape, bias.cov.shape, bias.unit, bias.frame
    ((3001, 3), (3001, 3, 3), 'rad/s', 'body')
    >>> print(np.rad2deg(bias.value[-1]).round(2), np.rad2deg(bias.sigma[-1]).round(3))  # deg/s
    [ 0.7   0.45 -0.02] [0.017 0.017 0.017]
    """

    value: Floats
    """(N, ...): quaternions (N, 4) for an attitude."""
    cov: Floats
    """(N, d, d) covariance of the error vector, in `frame`, units squared."""
    frame: str
    """Frame of the error vector, such as ``body``."""
    unit: str
    """Unit of the error vector: rad for an attitude."""

    @property
    def sigma(self) -> Floats:
        """(N, d) standard deviations."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))


def trackers(sensors: Iterable[str]) -> list[str]:
    """Names of the sensors that measure a pose: a tracker, its markers, or a camera."""
    return [s for s in sensors if s in ("optical", "camera") or s.startswith("marker_")]


class Estimated(Protocol):
    """An estimate over time, in memory or read from a result folder."""

    @property
    def run(self) -> str: ...

    @property
    def time_ns(self) -> Times:
        """(N,) instants."""
        ...

    @property
    def time(self) -> Floats:
        """(N,) seconds since the first instant."""
        ...

    @property
    def outputs(self) -> dict[str, OutputEstimate]: ...

    @property
    def clock(self) -> Clock: ...


@dataclass(frozen=True)
class SensorRecord:
    """Innovations of one sensor, at its own times.

    Examples
    --------
    The tracker's innovations are rotation vectors; their standard deviations in deg:

    >>> import numpy as np
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5")
    >>> optical = estimate.sensors["optical"]
    >>> optical.residual.shape, optical.nis.shape, bool(optical.gated.any())
    ((1272, 3), (1272,), False)
    >>> print(np.rad2deg(optical.residual.std(axis=0)).round(1))
    [0.3 0.3 0.3]
    """

    time_ns: Times
    """(N,) int64 nanoseconds at which the samples were taken, on `Estimate.clock`."""
    residual: Floats
    """(N, rows) innovation; 0 where a row was not used."""
    cov: Floats
    """(N, rows, rows) its predicted covariance."""
    used: Any
    """(N, rows) rows that entered the update."""
    gated: Any
    """(N, rows) visible rows that the gate refused."""
    nis: Floats
    """(N,) normalised innovation squared, chi-square with as many degrees as visible rows."""
    weight: Floats | None = None
    """(N, rows) weight of a row under robust weighting: 1 in full, 0 where not used; None for a sensor
    without weighting."""


@dataclass(frozen=True)
class EstimateData:
    """The estimate of one run, at every instant of its timeline."""

    run: str
    model: Model
    time_ns: Times
    state: Any
    """The model's state with a leading axis (N,)."""
    cov: Floats
    """(N, n, n) covariance of the error vector (body frame, on the right); see `error_labels`."""
    outputs: dict[str, OutputEstimate]
    """`attitude` (w, x, y, z body to reference) and `rate` (rad/s, body frame) in the loose models."""
    sensors: dict[str, SensorRecord]
    log_likelihood: float
    account: dict[str, dict[str, int]]
    """For each stream the rows read, used, masked, gated and dropped."""
    params: Parameters
    notes: tuple[str, ...] = ()
    """Remarks on how the run was read and initialised."""
    provenance: dict[str, Any] = field(default_factory=dict)
    smoothed: bool = False
    """Whether the smoother was run, so that each instant uses the measurements of the whole run."""
    online: bool = False
    """Whether each instant uses only the measurements that had arrived by then."""
    requested: Self | None = None
    """The estimate at the times requested by ``estimate(at=...)``, an excerpt."""
    excerpt: bool = False
    """Whether its instants are requested times: it can be exported, but not diagnosed or saved."""
    start_ns: int | None = None
    """Zero of `time`; None for the first instant."""
    clock: Clock = field(default_factory=Clock)
    """The clock of all times: the IMU's, by the offset and drift of the parameters, unless asked for
    otherwise."""

    @property
    def time(self) -> Floats:
        """Seconds since the first instant of the run."""
        start = self.time_ns[0] if self.start_ns is None else self.start_ns
        return (self.time_ns - start) / NANOSECONDS

    @property
    def attitude(self) -> OutputEstimate:
        """Attitude of the tool in the tracker's reference frame."""
        return self.outputs["attitude"]

    @property
    def rate(self) -> OutputEstimate:
        """Angular rate of the tool, body frame, rad/s."""
        return self.outputs["rate"]

    @property
    def bias(self) -> OutputEstimate:
        """Gyroscope bias, rad/s."""
        return self.part("bias")

    def part(self, name: str) -> OutputEstimate:
        """A part of the state by its name, with its block of the covariance."""
        for part, values in zip(
            manifold.parts(self.model.space), jax.tree.leaves(self.state), strict=True
        ):
            if part.name == name:
                return OutputEstimate(
                    values,
                    self.cov[:, part.error, part.error],
                    part.manifold.frame,
                    part.manifold.unit,
                )
        names = [part.name for part in manifold.parts(self.model.space)]
        raise KeyError(f"got the state part '{name}', expected one of {names}; check the spelling")

    @property
    def error_labels(self) -> tuple[str, ...]:
        """Name of each row of the covariance."""
        return manifold.error_labels(self.model.space)

    def split(self, measured: Any, requested_ns: Times) -> Self:
        """Split into the instants that are `measured` (N,) and, as `requested`, those at the given times.

        Innovations, account and likelihood remain those of the whole run in both.
        """

        def pick(at: Any) -> dict[str, Any]:
            outputs = {
                name: replace(out, value=np.asarray(out.value)[at], cov=np.asarray(out.cov)[at])
                for name, out in self.outputs.items()
            }
            state = jax.tree.map(lambda a: np.asarray(a)[at], self.state)
            chosen = {"time_ns": self.time_ns[at], "state": state, "cov": self.cov[at]}
            return chosen | {"outputs": outputs}

        asked = np.searchsorted(self.time_ns, requested_ns)
        excerpt = replace(self, **pick(asked), excerpt=True, start_ns=int(self.time_ns[0]))
        return replace(self, **pick(np.flatnonzero(measured)), requested=excerpt)

    def mean_nis(self, sensor: str) -> float:
        """Mean normalised innovation squared by degree of freedom; 1 for a consistent filter."""
        record = self.sensors[sensor]
        rows = (record.used | record.gated).sum(axis=1)
        return float(record.nis[rows > 0].sum() / rows.sum()) if rows.any() else float("nan")

    def summary(self) -> dict[str, Any]:
        """Summary of the run for JSON."""
        return {
            "run": self.run,
            "model": self.model.name,
            "smoothed": self.smoothed,
            "online": self.online,
            "clock": self.clock.as_dict(),
            "instants": len(self.time_ns),
            "requested": None if self.requested is None else len(self.requested.time_ns),
            "duration_s": float(self.time[-1]),
            "log_likelihood": self.log_likelihood,
            "mean_nis": {
                name: self.mean_nis(name) if len(record.nis) else None
                for name, record in self.sensors.items()
            },
            "outliers": {
                sensor.name: {"gate": sensor.gate, "weighting": sensor.weighting}
                for sensor in self.model.sensors
            },
            "account": self.account,
            "notes": list(self.notes),
        }
