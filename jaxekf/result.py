"""What an estimate is on the host: named arrays with units and frames, and how it is written."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np

from jaxekf import manifold, parameters
from jaxekf.files import finite_or_null, whole_folder
from jaxekf.model import Model, Parameters
from jaxekf.recording import NANOSECONDS, Floats, Times
from jaxekf.storage import SCHEMA_VERSION
from jaxekf.tables import write_csv


@dataclass(frozen=True)
class OutputEstimate:
    """A quantity over time with its uncertainty."""

    value: Floats
    """(N, ...): quaternions (N, 4) for an attitude."""
    cov: Floats
    """(N, d, d) covariance of the error vector, in `frame`, units squared."""
    frame: str
    unit: str

    @property
    def sigma(self) -> Floats:
        """(N, d) standard deviations."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))


class Estimated(Protocol):
    """What an estimate says over time, made just now or read from a result folder."""

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


@dataclass(frozen=True)
class SensorRecord:
    """What one sensor said against what was predicted, at its own times."""

    time_ns: Times
    residual: Floats
    """(N, rows) innovation; 0 where a row was not used."""
    cov: Floats
    """(N, rows, rows) its predicted covariance."""
    used: Any
    """(N, rows) rows that entered the update."""
    gated: Any
    """(N, rows) visible rows that the gate kept out."""
    nis: Floats
    """(N,) normalised innovation squared, chi-square with as many degrees as visible rows."""


@dataclass(frozen=True)
class Estimate:
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
    """What a user should know of how the run was read and started."""
    provenance: dict[str, Any] = field(default_factory=dict)
    smoothed: bool = False
    """Whether every instant was estimated from the whole run, not from what was measured until then."""

    @property
    def time(self) -> Floats:
        """Seconds since the first instant."""
        return (self.time_ns - self.time_ns[0]) / NANOSECONDS

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

    def mean_nis(self, sensor: str) -> float:
        """Mean normalised innovation squared by degree of freedom; 1 where the noise is right."""
        record = self.sensors[sensor]
        rows = (record.used | record.gated).sum(axis=1)
        return float(record.nis[rows > 0].sum() / rows.sum()) if rows.any() else float("nan")

    def summary(self) -> dict[str, Any]:
        """Numbers that say how the run went, for JSON."""
        return {
            "run": self.run,
            "model": self.model.name,
            "smoothed": self.smoothed,
            "instants": len(self.time_ns),
            "duration_s": float(self.time[-1]),
            "log_likelihood": self.log_likelihood,
            "mean_nis": {
                name: self.mean_nis(name) if len(record.nis) else None
                for name, record in self.sensors.items()
            },
            "account": self.account,
            "notes": list(self.notes),
        }

    def save(
        self,
        path: Path | str,
        *,
        overwrite: bool = False,
        diagnosis: Mapping[str, Any] | None = None,
    ) -> Path:
        """Write the result folder, whole or not at all.

        ``estimate.csv`` state, outputs and standard deviations; ``covariance.npz`` full matrices;
        ``innovations_SENSOR.csv``; ``noise.toml``, ``calibration.toml``; ``result.json`` summary,
        account, provenance and, where it is given, the `diagnosis` (`Diagnosis.as_dict`, with its curves
        for `jaxekf report`).
        """
        with whole_folder(path, "result.json", overwrite=overwrite) as folder:
            columns, values = self._table()
            names = [column["name"] for column in columns]
            write_csv(folder / "estimate.csv", names, self.time_ns, values, 12)
            self._save_covariance(folder / "covariance.npz")
            for name, record in self.sensors.items():
                labels = manifold.error_labels(self.model.sensor(name).space)
                write_csv(folder / f"innovations_{name}.csv", *_innovation_table(labels, record), 9)
            parameters.save(folder, self.model, self.params, {"run": self.run})
            document = {"schema_version": SCHEMA_VERSION, **self.summary()}
            document |= {
                "estimate_columns": [{"name": "time", "unit": "s", "frame": ""}, *columns],
                "innovation_units": {
                    name: list(manifold.error_units(self.model.sensor(name).space))
                    for name in self.sensors
                },
                "provenance": self.provenance,
            }
            if diagnosis is not None:
                document["diagnosis"] = finite_or_null(diagnosis)
            text = json.dumps(document, indent=2, allow_nan=False)
            (folder / "result.json").write_text(text + "\n", "utf-8")
        return Path(path)

    def _table(self) -> tuple[list[dict[str, str]], Floats]:
        """Columns of `estimate.csv`, with unit and frame, and their values."""
        columns: list[dict[str, str]] = []
        blocks = [np.asarray(leaf) for leaf in jax.tree.leaves(self.state)]
        blocks.append(np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2)))
        described = [("", self.model.space, "")]
        parts = {part.name for part in manifold.parts(self.model.space)}
        for name, output in self.outputs.items():
            if name in parts or (name == "attitude" and "q_ref_body" in parts):
                continue
            described.append((name, self.model.output(name).space, output.frame))
            blocks += [output.value, output.sigma]
        for name, space, frame in described:
            columns += _describe(name, space, frame)
        return columns, np.concatenate(blocks, axis=1)

    def _save_covariance(self, path: Path) -> None:
        arrays: Mapping[str, Any] = {f"cov_{name}": out.cov for name, out in self.outputs.items()}
        about: Mapping[str, Any] = {
            f"unit_{name}": np.array([f"({out.unit})^2", f"frame: {out.frame}"])
            for name, out in self.outputs.items()
        }
        np.savez_compressed(
            path,
            schema_version=SCHEMA_VERSION,
            time_ns=self.time_ns,
            cov=self.cov,
            labels=np.array(self.error_labels),
            units=np.array(manifold.error_units(self.model.space)),
            **arrays,
            **about,
        )


def _describe(name: str, space: Any, frame: str) -> list[dict[str, str]]:
    """Name, unit and frame of the columns of a state or output: its numbers, then their sigmas.

    Without a `frame` each part has its own.
    """
    head = f"{name}_" if name else ""
    columns = []
    for part in manifold.parts(space):
        for label in part.manifold.component_labels:
            whole = "_".join(filter(None, (part.name, label)))
            quaternion = part.manifold.shape != (part.manifold.dim,)
            own = frame or part.manifold.frame
            unit, seen = ("1", "body to reference") if quaternion else (part.manifold.unit, own)
            columns.append({"name": f"{head}{whole}", "unit": unit, "frame": seen})
    frames = [
        frame or p.manifold.frame for p in manifold.parts(space) for _ in range(p.manifold.dim)
    ]
    described = zip(manifold.error_labels(space), manifold.error_units(space), frames, strict=True)
    for label, unit, own in described:
        columns.append({"name": f"sigma_{head}{label}", "unit": unit, "frame": own})
    return columns


def _innovation_table(
    labels: tuple[str, ...], record: SensorRecord
) -> tuple[list[str], Times, Floats]:
    """Columns, times and values of an innovation file; what was not used is blank."""
    rows = np.arange(record.residual.shape[1])
    sigma = np.sqrt(record.cov[:, rows, rows])
    hidden = np.where(record.used, 0.0, np.nan)
    heads = ["residual", "sigma", "used", "gated"]
    columns = [f"{head}_{label}" if label else head for head in heads for label in labels]
    values = [record.residual + hidden, sigma + hidden, record.used, record.gated, record.nis]
    return [*columns, "nis"], record.time_ns, np.column_stack(values).astype(float)
