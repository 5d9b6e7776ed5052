"""Result folders of `jaxekf estimate`, read again: what a report needs, without model or filter."""

import json
import tomllib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.estimation.result import OutputEstimate
from jaxekf.io.csv_table import numbers, read_table, read_times
from jaxekf.io.run_folder import SCHEMA_VERSION
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Times

_AGAIN = "estimating the run again with this version of jaxekf"
_KINDS = ("result.json", "tuning.json")
_EXPECTED = "a result folder of jaxekf estimate or a tuned folder of jaxekf tune"
_AXES = ("x", "y", "z")
_NEEDED: Mapping[str, type | tuple[type, ...]] = {
    "run": str,
    "model": str,
    "smoothed": bool,
    "duration_s": (int, float),
    "mean_nis": dict,
    "account": dict,
    "notes": list,
    "estimate_columns": list,
    "innovation_units": dict,
    "provenance": dict,
}


class SavedSensor(NamedTuple):
    """NIS of one sensor at its own times."""

    time_ns: Times
    nis: Floats
    """(N,) chi-square with as many degrees as visible rows."""
    freedom: Floats
    """(N,) visible rows."""
    refused: Flags
    """(N,) samples that the gate kept out whole."""


class Setting(NamedTuple):
    """One leaf of the parameters an estimate was made with."""

    section: str
    """`noise`, `initial` or `calibration`."""
    name: str
    value: Any
    unit: str


@dataclass(frozen=True)
class SavedResult:
    """A result folder in memory."""

    folder: Path
    run: str
    time_ns: Times
    labels: tuple[str, ...]
    """Of the rows of the covariance."""
    columns: dict[str, Floats]
    """`estimate.csv`: each column (N,), SI."""
    units: dict[str, str]
    """Of the columns."""
    cov: Floats
    """(N, n, n), SI."""
    outputs: dict[str, OutputEstimate]
    sensors: dict[str, SavedSensor]
    settings: tuple[Setting, ...]
    document: Mapping[str, Any]
    """`result.json`."""

    @property
    def time(self) -> Floats:
        """Seconds since the first instant."""
        return (self.time_ns - self.time_ns[0]) / NANOSECONDS

    @property
    def diagnosis(self) -> Mapping[str, Any] | None:
        """As `Diagnosis.as_dict` with curves; None where none was saved."""
        return self.document.get("diagnosis")

    @property
    def model(self) -> str:
        """Name of the model, and how it was used."""
        how = ", smoothed" if self.document["smoothed"] else ""
        # Results of earlier versions do not tell.
        how += ", as known at each time" if self.document.get("online") else ""
        return f"{self.document['model']}{how}"

    def vector(self, name: str) -> tuple[Floats, Floats] | None:
        """Value and deviation (N, 3) of a part of the state; None where the model has no such part."""
        wanted = [f"{name}_{axis}" for axis in _AXES]
        if not all(w in self.columns and f"sigma_{w}" in self.columns for w in wanted):
            return None
        value = np.stack([self.columns[w] for w in wanted], axis=1)
        return value, np.stack([self.columns[f"sigma_{w}"] for w in wanted], axis=1)


def read_result(folder: Path | str) -> SavedResult:
    """Read a result folder.

    Raises `RecordingError`, which names the file, for a folder that is none, a file that is missing or
    broken, and a result of another version.
    """
    folder = Path(folder)
    document = _read_document(folder)
    arrays = _read_arrays(folder / "covariance.npz")
    table_file = _existing(folder / "estimate.csv")
    table = read_table(table_file)
    names = [column for column in table.columns if column != "time"]
    values = numbers(table, names, blank=True)
    columns = {name: values[:, i] for i, name in enumerate(names)}
    time_ns = arrays["time_ns"]
    if not np.array_equal(read_times(table), time_ns):
        raise RecordingError(table_file, "other times than covariance.npz", "the same", _AGAIN)
    described = document["estimate_columns"]
    return SavedResult(
        folder=folder,
        run=document["run"],
        time_ns=time_ns,
        labels=tuple(str(label) for label in arrays["labels"]),
        columns=columns,
        units={
            entry["name"]: entry["unit"]
            for entry in described
            if isinstance(entry, dict) and {"name", "unit"} <= entry.keys()
        },
        cov=arrays["cov"],
        outputs=_outputs(columns, arrays),
        sensors={
            name: _read_sensor(_existing(folder / f"innovations_{name}.csv"))
            for name in document["innovation_units"]
            if document["mean_nis"].get(name) is not None
        },
        settings=_read_settings(folder),
        document=document,
    )


def _existing(file: Path) -> Path:
    if not file.is_file():
        raise RecordingError(
            file, "no such file", "a whole result folder of jaxekf estimate", _AGAIN
        )
    return file


def _read_document(folder: Path) -> dict[str, Any]:
    """`result.json`, of a version and kind that is known."""
    file = folder / "result.json"
    if not folder.is_dir():
        raise RecordingError(folder, "no such folder", _EXPECTED, "another path")
    if not file.is_file():
        files = [path for kind in _KINDS for path in folder.glob(f"*/{kind}")]
        inner = sorted({path.parent.name for path in files})
        hint = f"the folders in it ({', '.join(inner[:3])})" if inner else "another path"
        if (folder / "noise.toml").is_file():
            hint = "tuning again with this version of jaxekf, if it was tuned"
        raise RecordingError(folder, f"a folder without {' or '.join(_KINDS)}", _EXPECTED, hint)
    try:
        document = json.loads(file.read_text("utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(file, f"text that is not JSON ({error})", "JSON", _AGAIN) from error
    version = document.get("schema_version") if isinstance(document, dict) else None
    if version != SCHEMA_VERSION:
        raise RecordingError(file, f"schema_version {version!r}", f"{SCHEMA_VERSION}", _AGAIN)
    for key, kind in _NEEDED.items():
        if not isinstance(document.get(key), kind):
            raise RecordingError(
                file, f"{key} = {document.get(key)!r}", "what jaxekf estimate writes there", _AGAIN
            )
    if "diagnosis" in document:
        _check_diagnosis(file, document["diagnosis"])
    return document


def _check_diagnosis(file: Path, diagnosis: Any) -> None:
    """It may have been saved from Python, where anything can be handed over."""
    for key, kind in {"verdicts": list, "notes": list, "sensors": dict, "parts": dict}.items():
        if not isinstance(diagnosis, dict) or not isinstance(diagnosis.get(key), kind):
            raise RecordingError(
                file,
                f"a diagnosis without {key}",
                "what Diagnosis.as_dict returns",
                "saving the result with that",
            )


def _read_arrays(file: Path) -> dict[str, Any]:
    """All arrays of `covariance.npz`."""
    try:
        with np.load(_existing(file), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (zipfile.BadZipFile, ValueError, OSError, EOFError) as error:
        raise RecordingError(
            file, f"a file that cannot be read ({error})", "a NumPy archive", _AGAIN
        ) from error
    missing = [name for name in ("time_ns", "cov", "labels") if name not in arrays]
    if missing:
        raise RecordingError(file, f"no {', '.join(missing)}", "them", _AGAIN)
    if arrays.get("schema_version") != SCHEMA_VERSION:
        got = f"schema_version {arrays.get('schema_version')}"
        raise RecordingError(file, got, f"{SCHEMA_VERSION}", _AGAIN)
    return arrays


def _outputs(columns: Mapping[str, Floats], arrays: Mapping[str, Any]) -> dict[str, OutputEstimate]:
    """Those outputs whose values stand in `estimate.csv`, with their covariances."""
    found = {}
    for key in arrays:
        name = key.removeprefix("cov_")
        if not key.startswith("cov_") or f"unit_{name}" not in arrays:
            continue
        stems = (name, "q_ref_body") if name == "attitude" else (name,)
        for stem in stems:
            # A quaternion has a w, a vector has none.
            held = [f"{stem}_{c}" for c in ("w", *_AXES) if f"{stem}_{c}" in columns]
            if len(held) >= len(_AXES):
                unit, frame = (str(text) for text in arrays[f"unit_{name}"])
                found[name] = OutputEstimate(
                    np.stack([columns[h] for h in held], axis=1),
                    arrays[key],
                    frame.removeprefix("frame: "),
                    unit.removesuffix("^2").strip("()"),
                )
                break
    return found


def _read_sensor(file: Path) -> SavedSensor:
    table = read_table(file)
    used = [name for name in table.columns if name.split("_")[0] == "used"]
    gated = [name for name in table.columns if name.split("_")[0] == "gated"]
    if "nis" not in table.columns or not used or len(used) != len(gated):
        raise RecordingError(file, "other columns", "those of jaxekf estimate", _AGAIN)
    taken, kept_out = numbers(table, used) > 0, numbers(table, gated) > 0
    return SavedSensor(
        read_times(table),
        numbers(table, ("nis",), blank=True)[:, 0],
        (taken | kept_out).sum(axis=1).astype(float),
        np.asarray(kept_out.any(axis=1) & ~taken.any(axis=1)),
    )


def _read_settings(folder: Path) -> tuple[Setting, ...]:
    """Noise, initial belief and, where the model has any, calibration."""
    found = []
    files = [_existing(folder / "noise.toml"), folder / "calibration.toml"]
    for file in (f for f in files if f.is_file()):
        try:
            document = tomllib.loads(file.read_text("utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise RecordingError(
                file, f"text that is not TOML ({error})", "TOML", _AGAIN
            ) from error
        if document.get("schema_version") != SCHEMA_VERSION:
            got = f"schema_version {document.get('schema_version')!r}"
            raise RecordingError(file, got, f"{SCHEMA_VERSION}", _AGAIN)
        for section in ("noise", "initial", "calibration"):
            for name, entry in document.get(section, {}).items():
                found.append(Setting(section, name, entry.get("value"), entry.get("unit", "")))
    return tuple(found)
