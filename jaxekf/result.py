"""What an estimate is on the host: named arrays with units and frames, and how it is written."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxekf import manifold, parameters
from jaxekf.model import Model, Parameters
from jaxekf.recording import NANOSECONDS, Floats, Times
from jaxekf.storage import SCHEMA_VERSION, whole_folder, write_csv


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
    provenance: dict[str, Any] = field(default_factory=dict)

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
                    values, self.cov[:, part.error, part.error], "body", part.manifold.unit
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
        return float(record.nis[rows > 0].sum() / max(rows.sum(), 1))

    def summary(self) -> dict[str, Any]:
        """Numbers that say how the run went, for JSON."""
        return {
            "run": self.run,
            "model": self.model.name,
            "instants": len(self.time_ns),
            "duration_s": float(self.time[-1]),
            "log_likelihood": self.log_likelihood,
            "mean_nis": {name: self.mean_nis(name) for name in self.sensors},
            "account": self.account,
        }

    def save(self, path: Path | str, *, overwrite: bool = False) -> Path:
        """Write the result folder, whole or not at all.

        ``estimate.csv`` state, outputs and standard deviations; ``covariance.npz`` full matrices;
        ``innovations_SENSOR.csv``; ``noise.toml``, ``calibration.toml``; ``result.json`` summary,
        account and provenance.
        """
        with whole_folder(path, overwrite=overwrite) as folder:
            columns, values = self._table()
            write_csv(folder / "estimate.csv", columns, self.time_ns, values, 12)
            self._save_covariance(folder / "covariance.npz")
            for name, record in self.sensors.items():
                labels = manifold.error_labels(self.model.sensor(name).space)
                rows = np.arange(record.residual.shape[1])
                sigma = np.sqrt(record.cov[:, rows, rows])
                hidden = np.where(record.used, 0.0, np.nan)
                table = np.c_[record.residual + hidden, sigma + hidden, record.nis]
                heads = [f"residual_{x}" for x in labels] + [f"sigma_{x}" for x in labels]
                file = folder / f"innovations_{name}.csv"
                write_csv(file, [*heads, "nis"], record.time_ns, table, 9)
            parameters.save(folder, self.model, self.params, {"run": self.run})
            head = {"schema_version": SCHEMA_VERSION}
            text = json.dumps(head | self.summary() | {"provenance": self.provenance}, indent=2)
            (folder / "result.json").write_text(text + "\n", "utf-8")
        return Path(path)

    def _table(self) -> tuple[list[str], Floats]:
        columns = list(manifold.component_labels(self.model.space))
        blocks = [np.asarray(leaf) for leaf in jax.tree.leaves(self.state)]
        columns += [f"sigma_{label}" for label in self.error_labels]
        blocks.append(np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2)))
        parts = {part.name for part in manifold.parts(self.model.space)}
        for name, output in self.outputs.items():
            space = self.model.output(name).space
            if name in parts or (name == "attitude" and "q_ref_body" in parts):
                continue
            columns += [f"{name}_{label}" for label in manifold.component_labels(space)]
            columns += [f"sigma_{name}_{label}" for label in manifold.error_labels(space)]
            blocks += [output.value, output.sigma]
        return columns, np.concatenate(blocks, axis=1)

    def _save_covariance(self, path: Path) -> None:
        arrays: Mapping[str, Any] = {f"cov_{name}": out.cov for name, out in self.outputs.items()}
        np.savez_compressed(
            path,
            schema_version=SCHEMA_VERSION,
            time_ns=self.time_ns,
            cov=self.cov,
            labels=np.array(self.error_labels),
            units=np.array(manifold.error_units(self.model.space)),
            **arrays,
        )
