"""What an estimate is on the host: named arrays with units and frames, and how it is written."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np

from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.estimation import parameters
from jaxekf.filtering.model import Model, Parameters
from jaxekf.geometry import manifold
from jaxekf.geometry.manifold import Manifold
from jaxekf.io import export
from jaxekf.io.atomic import finite_or_null, whole_file, whole_folder
from jaxekf.io.csv_table import write_csv
from jaxekf.io.export import Entry
from jaxekf.io.run_folder import SCHEMA_VERSION
from jaxekf.recordings.types import NANOSECONDS, Floats, Times


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


def trackers(sensors: Iterable[str]) -> list[str]:
    """Those of a model's sensors that see where the body is: a tracker, its markers, or a camera."""
    return [s for s in sensors if s in ("optical", "camera") or s.startswith("marker_")]


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
    weight: Floats | None = None
    """(N, rows) what the noise was divided by where tails are heavy: 1 in full, 0 where not used; None for
    a sensor without weighting."""


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
    online: bool = False
    """Whether it is what was known at each time, measurements being late."""
    requested: "Estimate | None" = None
    """The same at the times asked for by ``estimate(at=...)``, an excerpt."""
    excerpt: bool = False
    """Whether its instants are those of a request: it is read and exported, but not judged or saved."""
    start_ns: int | None = None
    """Where `time` is zero; None for the first instant."""

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

    def split(self, measured: Any, requested_ns: Times) -> "Estimate":
        """Only the instants that are `measured` (N,), and as `requested` those at the given times.

        Innovations, account and likelihood stay the whole run's in both.
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
            "online": self.online,
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

    def export(self, path: Path | str, *, overwrite: bool = False) -> Path:
        """Write one file, whole or not at all, in the format of its suffix. Returns its path.

        ``.csv`` is `estimate.csv` of the result folder: state, outputs, standard deviations, rounded to 12
        digits. ``.npz`` and ``.h5`` or ``.hdf5`` hold everything to the last bit, see
        `jaxekf.read_export`. ``.tum`` is the trajectory in the TUM format, ``timestamp tx ty tz qx qy qz
        qw``: the recording's time in seconds, exact to the nanosecond, the position (zero for a model
        without one) and the attitude, body to reference, scalar last.

        Raises `RecordingError` for another suffix and, without `overwrite`, for a file that exists;
        `ModelError` for a trajectory of a model without attitude.
        """
        form = export.format_of(path)
        with whole_file(path, overwrite=overwrite) as file:
            self._write(form, file)
        return Path(path)

    def save(
        self,
        path: Path | str,
        *,
        overwrite: bool = False,
        exports: Iterable[str] = (),
        diagnosis: Mapping[str, Any] | None = None,
    ) -> Path:
        """Write the result folder, whole or not at all.

        ``estimate.csv`` state, outputs and standard deviations; ``covariance.npz`` full matrices;
        ``innovations_SENSOR.csv``; ``noise.toml``, ``calibration.toml``; ``result.json`` summary,
        account, parameters, provenance with the hashes of the input files and, where it is given, the
        `diagnosis` (`Diagnosis.as_dict`, with its curves for `jaxekf report`). `exports` adds files as by
        `export`: ``npz`` `estimate.npz`, ``hdf5`` `estimate.h5`, ``tum`` `trajectory.tum`. Where times
        were asked for, there is ``requested.csv``, with the columns of `estimate.csv` at those, and the
        `exports` hold those only.

        Raises `RecordingError` for an output that exists, and for an excerpt.
        """
        if self.excerpt:
            raise RecordingError(
                path,
                "an estimate at requested times only",
                "one of the whole run",
                "saving the estimate it is a part of, or exporting this one to a file",
            )
        added = export.files_of(path, exports)
        exported = self
        if self.requested is not None:
            exported, added = self.requested, {"csv": "requested.csv"} | added
        with whole_folder(path, "result.json", overwrite=overwrite) as folder:
            columns, _ = self._table()
            self._write("csv", folder / "estimate.csv")
            for form, name in added.items():
                exported._write(form, folder / name)
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
                "parameters": self._parameters(),
            }
            if diagnosis is not None:
                document["diagnosis"] = finite_or_null(diagnosis)
            text = json.dumps(document, indent=2, allow_nan=False)
            (folder / "result.json").write_text(text + "\n", "utf-8")
        return Path(path)

    def _write(self, form: str, file: Path) -> None:
        """One file in a format of `export`."""
        if form == "csv":
            columns, values = self._table()
            write_csv(file, [column["name"] for column in columns], self.time_ns, values, 12)
        elif form == "tum":
            if "attitude" not in self.outputs:
                raise ModelError(
                    f"model '{self.model.name}' got a trajectory to write without the output 'attitude',"
                    " expected one; give the model that output, or export another format"
                )
            place = self.outputs.get("position")
            comments = [f"run {self.run}, model {self.model.name}", *self._told()]
            position = None if place is None else place.value
            export.write_tum(file, self.time_ns, self.attitude.value, position, comments)
        else:
            {"npz": export.write_npz, "hdf5": export.write_hdf5}[form](file, self._entries())

    def _parameters(self) -> dict[str, Any]:
        """Noise, initial belief, calibration and setup with their units, for JSON."""
        described = parameters.described_arrays(self.model, self.params)
        told: dict[str, dict[str, Any]] = {}
        for path, (value, unit) in described.items():
            section, name = path.split("/")
            told.setdefault(section, {})[name] = {"value": value.tolist(), "unit": unit}
        return finite_or_null(told)

    def _told(self) -> list[str]:
        """What an estimate was made of and how, a line of JSON each, for a file that has comments only."""
        said = {
            "schema_version": SCHEMA_VERSION,
            "smoothed": self.smoothed,
            "online": self.online,
            "provenance": self.provenance,
            "parameters": self._parameters(),
            "account": self.account,
        }
        return [f"{key} {json.dumps(value)}" for key, value in said.items()]

    def _entries(self) -> dict[str, Entry]:
        """All of the estimate, by the paths of an NPZ or HDF5 file."""
        facts = {
            "kind": export.KIND,
            "schema_version": SCHEMA_VERSION,
            "run": self.run,
            "model": self.model.name,
            "smoothed": self.smoothed,
            "online": self.online,
            "requested_times_only": self.excerpt,
            "log_likelihood": self.log_likelihood,
        }
        found = {"": Entry(None, facts), "time_ns": Entry(self.time_ns, {"unit": "ns"})}
        space = self.model.space
        parts = manifold.parts(space)
        for part, leaf in zip(parts, jax.tree.leaves(self.state), strict=True):
            found[f"state/{part.name}"] = Entry(np.asarray(leaf), _stored(part.manifold, ""))
        frames = [part.manifold.frame for part in parts for _ in range(part.manifold.dim)]
        about: dict[str, Any] = {"labels": list(self.error_labels), "frames": frames}
        about["units"] = list(manifold.error_units(space))
        found["covariance"] = Entry(np.asarray(self.cov), about)
        for name, output in self.outputs.items():
            kind = manifold.parts(self.model.output(name).space)[0].manifold
            head = f"outputs/{name}"
            found[f"{head}/value"] = Entry(np.asarray(output.value), _stored(kind, output.frame))
            about = {"unit": f"({output.unit})^2", "frame": output.frame}
            about["labels"] = list(kind.error_labels)
            found[f"{head}/covariance"] = Entry(np.asarray(output.cov), about)
        for name, record in self.sensors.items():
            found |= self._sensor_entries(name, record)
        for name, (value, unit) in parameters.described_arrays(self.model, self.params).items():
            found[f"parameters/{name}"] = Entry(value, {"unit": unit})
        found["notes"] = Entry(list(self.notes))
        found |= _leaves("account", self.account) | _leaves("provenance", self.provenance)
        return found

    def _sensor_entries(self, name: str, record: SensorRecord) -> dict[str, Entry]:
        space = self.model.sensor(name).space
        parts = manifold.parts(space)
        about = {
            "labels": list(manifold.error_labels(space)),
            "units": list(manifold.error_units(space)),
            "frames": [part.manifold.frame for part in parts for _ in range(part.manifold.dim)],
        }
        said = {"time_ns": {"unit": "ns"}, "residual": about, "cov": about, "nis": {"unit": "1"}}
        columns = {"time_ns": "time_ns", "residual": "residual", "cov": "covariance"}
        columns |= {key: key for key in ("used", "gated", "nis")}
        if record.weight is not None:
            columns["weight"] = "weight"
        return {
            f"sensors/{name}/{path}": Entry(np.asarray(getattr(record, key)), said.get(key, {}))
            for key, path in columns.items()
        }

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


def _stored(kind: Manifold, frame: str) -> dict[str, Any]:
    """Unit, frame and labels of stored numbers; of a quaternion, from where to where it rotates.

    Without a `frame` the manifold's own is taken.
    """
    seen = frame or kind.frame
    unit, seen = (kind.unit, seen) if kind.shape == (kind.dim,) else ("1", f"{seen} to reference")
    return {"unit": unit, "frame": seen, "labels": list(kind.component_labels)}


def _leaves(path: str, node: Any) -> dict[str, Entry]:
    """Nested mappings as entries; what neither format has, such as None, as JSON."""
    if isinstance(node, Mapping):
        return {
            at: entry for key in node for at, entry in _leaves(f"{path}/{key}", node[key]).items()
        }
    plain = isinstance(node, str | bool | int | float)
    return {path: Entry(node if plain else json.dumps(node))}


def _describe(name: str, space: Any, frame: str) -> list[dict[str, str]]:
    """Name, unit and frame of the columns of a state or output: its numbers, then their sigmas.

    Without a `frame` each part has its own.
    """
    head = f"{name}_" if name else ""
    columns = []
    for part in manifold.parts(space):
        for label in part.manifold.component_labels:
            whole = "_".join(filter(None, (part.name, label)))
            about = _stored(part.manifold, frame)
            columns.append(
                {"name": f"{head}{whole}", "unit": about["unit"], "frame": about["frame"]}
            )
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
    values = [record.residual + hidden, sigma + hidden, record.used, record.gated, record.nis]
    if record.weight is not None:
        heads.append("weight")
        values.insert(4, record.weight)
    columns = [f"{head}_{label}" if label else head for head in heads for label in labels]
    return [*columns, "nis"], record.time_ns, np.column_stack(values).astype(float)
