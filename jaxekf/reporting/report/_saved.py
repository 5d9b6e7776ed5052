"""A result folder of `jaxekf estimate` read into memory, without model or filter."""

import tomllib
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import UnsetType, structs

from jaxekf._support.errors import RecordingError
from jaxekf.estimation.clock import Clock
from jaxekf.estimation.result import OutputEstimate
from jaxekf.io.csv_table import numbers, read_table, read_times
from jaxekf.io.documents import codec
from jaxekf.io.documents.result import DiagnosisDocument, ResultDocument
from jaxekf.io.run_folder import SCHEMA_VERSION
from jaxekf.recordings.types import NANOSECONDS, Flags, Floats, Times

_AGAIN = "estimating the run again with this version of jaxekf"
_KINDS = ("result.json", "tuning.json")
_EXPECTED = "a result folder of jaxekf estimate or a tuned folder of jaxekf tune"
_AXES = ("x", "y", "z")


class SavedSensor(NamedTuple):
    """NIS of one sensor at its own times."""

    time_ns: Times
    nis: Floats
    freedom: Floats
    """(N,) visible rows, the degrees of freedom."""
    refused: Flags
    """(N,) samples of which the gate refused all rows."""


class Setting(NamedTuple):
    """One parameter that an estimate was made with."""

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
    """Labels of the rows of the covariance."""
    columns: dict[str, Floats]
    """`estimate.csv`: each column (N,), SI."""
    units: dict[str, str]
    """Unit of each column."""
    cov: Floats
    """(N, n, n), SI."""
    outputs: dict[str, OutputEstimate]
    sensors: dict[str, SavedSensor]
    settings: tuple[Setting, ...]
    document: ResultDocument

    @property
    def time(self) -> Floats:
        """Seconds since the first instant."""
        return (self.time_ns - self.time_ns[0]) / NANOSECONDS

    @property
    def clock(self) -> Clock:
        """The clock of the times."""
        return Clock(**structs.asdict(self.document.clock))

    @property
    def diagnosis(self) -> DiagnosisDocument | None:
        """The saved diagnosis, if any."""
        found = self.document.diagnosis
        return None if isinstance(found, UnsetType) else found

    @property
    def model(self) -> str:
        """Name of the model, and how it was used."""
        how = ", smoothed" if self.document.smoothed else ""
        how += ", as known at each time" if self.document.online else ""
        return f"{self.document.model}{how}"

    def vector(self, name: str) -> tuple[Floats, Floats] | None:
        """Value and standard deviation (N, 3) of a part of the state; None if there is no such part."""
        wanted = [f"{name}_{axis}" for axis in _AXES]
        if not all(w in self.columns and f"sigma_{w}" in self.columns for w in wanted):
            return None
        value = np.stack([self.columns[w] for w in wanted], axis=1)
        return value, np.stack([self.columns[f"sigma_{w}"] for w in wanted], axis=1)


def read_result(folder: Path | str) -> SavedResult:
    """Read a result folder.

    Raises `RecordingError`, which names the file, for a folder that is not a result, a file that is missing
    or broken, and a result of another version.
    """
    folder = Path(folder)
    document = _read_document(folder)
    arrays = _read_arrays(folder / "covariance.npz", ("time_ns", "cov", "labels"))
    table_file = _existing(folder / "estimate.csv")
    table = read_table(table_file)
    names = [column for column in table.columns if column != "time"]
    values = numbers(table, names, blank=True)
    columns = {name: values[:, i] for i, name in enumerate(names)}
    time_ns = arrays["time_ns"]
    if not np.array_equal(read_times(table), time_ns):
        raise RecordingError(table_file, "other times than covariance.npz", "the same", _AGAIN)
    return SavedResult(
        folder=folder,
        run=document.run,
        time_ns=time_ns,
        labels=tuple(str(label) for label in arrays["labels"]),
        columns=columns,
        units={column.name: column.unit for column in document.estimate_columns},
        cov=arrays["cov"],
        outputs=_outputs(columns, arrays),
        sensors=_read_sensors(folder, document),
        settings=_read_settings(folder),
        document=document,
    )


def _existing(file: Path) -> Path:
    if not file.is_file():
        raise RecordingError(
            file, "no such file", "a whole result folder of jaxekf estimate", _AGAIN
        )
    return file


def _read_document(folder: Path) -> ResultDocument:
    """Read `result.json`. Raises `RecordingError` if the folder is not a result."""
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
    return codec.read(file, ResultDocument, _AGAIN)


def _read_arrays(file: Path, needed: Sequence[str]) -> dict[str, Any]:
    """All arrays of an NPZ file, in which those that are `needed` must be."""
    try:
        with np.load(_existing(file), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (zipfile.BadZipFile, ValueError, OSError, EOFError) as error:
        raise RecordingError(
            file, f"a file that cannot be read ({error})", "a NumPy archive", _AGAIN
        ) from error
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise RecordingError(file, f"no {', '.join(missing)}", "these arrays", _AGAIN)
    if arrays.get("schema_version") != SCHEMA_VERSION:
        got = f"schema_version {arrays.get('schema_version')}"
        raise RecordingError(file, got, f"{SCHEMA_VERSION}", _AGAIN)
    return arrays


def _outputs(columns: Mapping[str, Floats], arrays: Mapping[str, Any]) -> dict[str, OutputEstimate]:
    """The outputs with values in `estimate.csv`, and their covariances."""
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


def _read_sensors(folder: Path, document: ResultDocument) -> dict[str, SavedSensor]:
    """NIS of all sensors with samples: to the last bit, or from the tables of earlier versions."""
    names = [name for name in document.innovation_units if document.mean_nis.get(name) is not None]
    if isinstance(document.innovations, UnsetType):
        return {name: _read_table(_existing(folder / f"innovations_{name}.csv")) for name in names}
    columns = ("time_ns", "nis", "used", "gated")
    needed = [f"sensors/{name}/{column}" for name in names for column in columns]
    arrays = _read_arrays(folder / document.innovations.file, needed)
    return {name: _sensor(*(arrays[f"sensors/{name}/{c}"] for c in columns)) for name in names}


def _read_table(file: Path) -> SavedSensor:
    """`innovations_SENSOR.csv`."""
    table = read_table(file)
    used = [name for name in table.columns if name.split("_")[0] == "used"]
    gated = [name for name in table.columns if name.split("_")[0] == "gated"]
    if "nis" not in table.columns or not used or len(used) != len(gated):
        raise RecordingError(file, "other columns", "those of jaxekf estimate", _AGAIN)
    nis = numbers(table, ("nis",), blank=True)[:, 0]
    return _sensor(read_times(table), nis, numbers(table, used) > 0, numbers(table, gated) > 0)


def _sensor(time_ns: Times, nis: Floats, used: Flags, gated: Flags) -> SavedSensor:
    """NIS of one sensor, its rows (N, rows) used and gated."""
    refused = np.asarray(gated.any(axis=1) & ~used.any(axis=1))
    return SavedSensor(time_ns, nis, (used | gated).sum(axis=1).astype(float), refused)


def _read_settings(folder: Path) -> tuple[Setting, ...]:
    """Noise, initial belief and calibration."""
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
