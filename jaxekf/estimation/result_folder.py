"""Writing an estimate: the files of a result folder, and exports."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.estimation import parameters
from jaxekf.estimation._estimate_data import EstimateData, SensorRecord
from jaxekf.geometry import manifold
from jaxekf.geometry.manifold import Manifold
from jaxekf.io import export
from jaxekf.io.atomic import whole_folder
from jaxekf.io.csv_table import write_csv
from jaxekf.io.description import SCHEMA_VERSION
from jaxekf.io.documents import codec
from jaxekf.io.documents.result import Column, Innovations, Quantity, ResultDocument
from jaxekf.io.export import Entry
from jaxekf.recordings.types import Floats, Times

INNOVATIONS = "innovations.npz"
"""Innovations of all sensors to the last bit, by the paths of an export."""


def write(
    made: EstimateData,
    path: Path | str,
    *,
    overwrite: bool,
    exports: Iterable[str],
    diagnosis: Mapping[str, Any] | None,
    score: Mapping[str, Any] | None,
) -> None:
    """Write a result folder as `Estimate.save` describes it."""
    if made.excerpt:
        raise RecordingError(
            path,
            "an estimate at requested times only",
            "one of the whole run",
            "saving the estimate it is a part of, or exporting this one to a file",
        )
    added = export.files_of(path, exports)
    exported = made
    if made.requested is not None:
        exported, added = made.requested, {"csv": "requested.csv"} | added
    with whole_folder(path, "result.json", overwrite=overwrite) as folder:
        columns = _write_table(made, folder / "estimate.csv")
        for form, name in added.items():
            write_file(exported, form, folder / name)
        _write_covariance(made, folder / "covariance.npz")
        for name, record in made.sensors.items():
            labels = manifold.error_labels(made.model.sensor(name).space)
            write_csv(folder / f"innovations_{name}.csv", *_innovation_table(labels, record), 9)
        export.write_npz(
            folder / INNOVATIONS,
            {"": Entry(None, _facts(made)), **_innovations(made)},
        )
        parameters.save(folder, made.model, made.params, {"run": made.run})
        text = codec.as_text(_document(made, columns, diagnosis, score))
        (folder / "result.json").write_text(text, "utf-8")


def write_file(made: EstimateData, form: str, file: Path) -> None:
    """Write one file in a format of `export`."""
    if form == "csv":
        _write_table(made, file)
    elif form == "tum":
        if "attitude" not in made.outputs:
            raise ModelError(
                f"model '{made.model.name}' got a trajectory to write without the output 'attitude',"
                " expected one; give the model that output, or export another format"
            )
        position = made.outputs.get("position")
        export.write_tum(
            file,
            made.time_ns,
            made.outputs["attitude"].value,
            None if position is None else position.value,
            [
                f"run {made.run}, model {made.model.name}, time{made.clock.label}",
                *_comments(made),
            ],
        )
    else:
        {"npz": export.write_npz, "hdf5": export.write_hdf5}[form](file, _entries(made))


def _write_table(made: EstimateData, file: Path) -> list[Column]:
    """Write states, outputs and their standard deviations as CSV. Returns the columns after the time."""
    columns, values = _table(made)
    write_csv(file, [column.name for column in columns], made.time_ns, values, 12)
    return columns


def _document(
    made: EstimateData,
    columns: list[Column],
    diagnosis: Mapping[str, Any] | None,
    score: Mapping[str, Any] | None,
) -> ResultDocument:
    """`result.json`; diagnosis and score are written as they are given."""
    given: dict[str, Any] = {"diagnosis": diagnosis, "score": score}
    return ResultDocument(
        **made.summary(),
        estimate_columns=[Column("time", "s", _frame(made)), *columns],
        innovation_units={
            name: list(manifold.error_units(made.model.sensor(name).space)) for name in made.sensors
        },
        innovations=Innovations(
            INNOVATIONS, {name: len(record.time_ns) for name, record in made.sensors.items()}
        ),
        provenance=made.provenance,
        parameters=_parameters(made),
        **{key: value for key, value in given.items() if value is not None},
    )


def _frame(made: EstimateData) -> str:
    """The clock of the times, as the frame of their column."""
    return f"{made.clock.name} clock"


def _of_time(made: EstimateData) -> dict[str, str]:
    """Attributes of times in an NPZ or HDF5 file."""
    return {"unit": "ns", "clock": made.clock.name}


def _parameters(made: EstimateData) -> dict[str, dict[str, Quantity]]:
    """Noise, initial belief, calibration and setup with their units."""
    found: dict[str, dict[str, Quantity]] = {}
    for path, (value, unit) in parameters.described_arrays(made.model, made.params).items():
        section, name = path.split("/")
        found.setdefault(section, {})[name] = Quantity(value, unit)
    return found


def _comments(made: EstimateData) -> list[str]:
    """Provenance and parameters, a line of JSON each, for a file that has comments only."""
    facts = {
        "schema_version": SCHEMA_VERSION,
        "smoothed": made.smoothed,
        "online": made.online,
        "clock": made.clock.as_dict(),
        "provenance": made.provenance,
        "parameters": _parameters(made),
        "account": made.account,
    }
    return [f"{key} {json.dumps(value)}" for key, value in codec.plain(facts).items()]


def _facts(made: EstimateData) -> dict[str, Any]:
    """Attributes at the root of an NPZ or HDF5 file."""
    return {
        "kind": export.KIND,
        "schema_version": SCHEMA_VERSION,
        "run": made.run,
        "model": made.model.name,
        "smoothed": made.smoothed,
        "online": made.online,
        "clock": json.dumps(made.clock.as_dict()),
        "requested_times_only": made.excerpt,
        "log_likelihood": made.log_likelihood,
    }


def _entries(made: EstimateData) -> dict[str, Entry]:
    """The whole estimate, by the paths of an NPZ or HDF5 file."""
    found = {"": Entry(None, _facts(made)), "time_ns": Entry(made.time_ns, _of_time(made))}
    space = made.model.space
    for part, leaf in zip(manifold.parts(space), jax.tree.leaves(made.state), strict=True):
        found[f"state/{part.name}"] = Entry(np.asarray(leaf), _attributes(part.manifold, ""))
    found["covariance"] = Entry(np.asarray(made.cov), _error_attributes(space))
    for name, output in made.outputs.items():
        kind = manifold.parts(made.model.output(name).space)[0].manifold
        head = f"outputs/{name}"
        found[f"{head}/value"] = Entry(np.asarray(output.value), _attributes(kind, output.frame))
        about: dict[str, Any] = {"unit": f"({output.unit})^2", "frame": output.frame}
        about["labels"] = list(kind.error_labels)
        found[f"{head}/covariance"] = Entry(np.asarray(output.cov), about)
    found |= _innovations(made)
    for name, (value, unit) in parameters.described_arrays(made.model, made.params).items():
        found[f"parameters/{name}"] = Entry(value, {"unit": unit})
    found["notes"] = Entry(list(made.notes))
    return found | _leaves("account", made.account) | _leaves("provenance", made.provenance)


def _innovations(made: EstimateData) -> dict[str, Entry]:
    """Innovations of all sensors, by the paths of an NPZ or HDF5 file."""
    found = {}
    for name, record in made.sensors.items():
        about = _error_attributes(made.model.sensor(name).space)
        columns = {
            "time_ns": Entry(record.time_ns, _of_time(made)),
            "residual": Entry(record.residual, about),
            "covariance": Entry(record.cov, about),
            "used": Entry(record.used),
            "gated": Entry(record.gated),
            "nis": Entry(record.nis, {"unit": "1"}),
        }
        if record.weight is not None:
            columns["weight"] = Entry(record.weight)
        for path, entry in columns.items():
            found[f"sensors/{name}/{path}"] = entry._replace(value=np.asarray(entry.value))
    return found


def _error_attributes(space: Any) -> dict[str, Any]:
    """Labels, units and frames of the rows of an error vector."""
    return {
        "labels": list(manifold.error_labels(space)),
        "frames": [p.manifold.frame for p in manifold.parts(space) for _ in range(p.manifold.dim)],
        "units": list(manifold.error_units(space)),
    }


def _table(made: EstimateData) -> tuple[list[Column], Floats]:
    """Columns of `estimate.csv` without the time, and their values."""
    columns: list[Column] = []
    blocks = [np.asarray(leaf) for leaf in jax.tree.leaves(made.state)]
    blocks.append(np.sqrt(np.diagonal(made.cov, axis1=1, axis2=2)))
    described = [("", made.model.space, "")]
    parts = {part.name for part in manifold.parts(made.model.space)}
    for name, output in made.outputs.items():
        if name in parts or (name == "attitude" and "q_ref_body" in parts):
            continue
        described.append((name, made.model.output(name).space, output.frame))
        blocks += [output.value, output.sigma]
    for name, space, frame in described:
        columns += _columns(name, space, frame)
    return columns, np.concatenate(blocks, axis=1)


def _write_covariance(made: EstimateData, path: Path) -> None:
    arrays: Mapping[str, Any] = {f"cov_{name}": out.cov for name, out in made.outputs.items()}
    about: Mapping[str, Any] = {
        f"unit_{name}": np.array([f"({out.unit})^2", f"frame: {out.frame}"])
        for name, out in made.outputs.items()
    }
    np.savez_compressed(
        path,
        schema_version=SCHEMA_VERSION,
        clock=made.clock.name,
        time_ns=made.time_ns,
        cov=made.cov,
        labels=np.array(made.error_labels),
        units=np.array(manifold.error_units(made.model.space)),
        **arrays,
        **about,
    )


def _attributes(kind: Manifold, frame: str) -> dict[str, Any]:
    """Unit, frame and labels of stored numbers; for a quaternion, the frames it rotates between.

    Without a `frame` the manifold's own is taken.
    """
    seen = frame or kind.frame
    unit, seen = (kind.unit, seen) if kind.shape == (kind.dim,) else ("1", f"{seen} to reference")
    return {"unit": unit, "frame": seen, "labels": list(kind.component_labels)}


def _leaves(path: str, node: Any) -> dict[str, Entry]:
    """Nested mappings as entries; values that neither format has, such as None, as JSON."""
    if isinstance(node, Mapping):
        return {
            at: entry for key in node for at, entry in _leaves(f"{path}/{key}", node[key]).items()
        }
    simple = isinstance(node, str | bool | int | float)
    return {path: Entry(node if simple else json.dumps(node))}


def _columns(name: str, space: Any, frame: str) -> list[Column]:
    """Columns of a state or output: its numbers, then their standard deviations.

    Without a `frame` each part has its own.
    """
    head = f"{name}_" if name else ""
    columns = []
    for part in manifold.parts(space):
        about = _attributes(part.manifold, frame)
        for label in part.manifold.component_labels:
            whole = "_".join(filter(None, (part.name, label)))
            columns.append(Column(f"{head}{whole}", about["unit"], about["frame"]))
    errors = _error_attributes(space)
    for label, unit, own in zip(*(errors[k] for k in ("labels", "units", "frames")), strict=True):
        columns.append(Column(f"sigma_{head}{label}", unit, frame or own))
    return columns


def _innovation_table(
    labels: tuple[str, ...], record: SensorRecord
) -> tuple[list[str], Times, Floats]:
    """Columns, times and values of an innovation file; rows that were not used are blank."""
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
