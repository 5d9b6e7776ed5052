"""An estimate as one file that other programs read: NPZ, HDF5, or a trajectory in the TUM format.

NPZ and HDF5 hold the same entries by the same paths, ``outputs/attitude/value`` for instance, to the last
bit. Unit, frame and labels of an entry are attributes in HDF5; NPZ has no attributes, so it
is an entry of its own there, ``outputs/attitude/value@unit``.
"""

import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.csv_table import format_seconds
from jaxekf.io.description import SCHEMA_VERSION
from jaxekf.recordings.types import Floats, Times

KIND = "jaxekf estimate"
"""Attribute `kind` of the root of an NPZ or HDF5 file."""
FILES = {"npz": "estimate.npz", "hdf5": "estimate.h5", "tum": "trajectory.tum"}
"""Format and name of each file that a result folder may hold besides its own."""
_SUFFIXES = {".csv": "csv", ".npz": "npz", ".h5": "hdf5", ".hdf5": "hdf5", ".tum": "tum"}


class Entry(NamedTuple):
    """One entry of an NPZ or HDF5 file."""

    value: Any
    """Array, number, text or list of texts; None at the root, path ``""``, which has attributes only."""
    about: Mapping[str, Any] = {}
    """Attributes: texts, lists of texts or numbers."""


def format_of(path: Path | str) -> str:
    """The format of a file by its suffix: csv, npz, hdf5 or tum.

    Examples
    --------
    >>> from jaxekf.io import export
    >>> export.format_of("estimate.npz"), export.format_of("estimate.h5")
    ('npz', 'hdf5')
    """
    suffix = Path(path).suffix
    if suffix.lower() not in _SUFFIXES:
        raise RecordingError(
            path, f"the suffix '{suffix}'", ".csv, .npz, .h5 (or .hdf5) or .tum", "one of these"
        )
    return _SUFFIXES[suffix.lower()]


def files_of(folder: Path | str, formats: Iterable[str]) -> dict[str, str]:
    """Format and file name of each export that a result folder shall have besides its own files."""
    wanted = list(dict.fromkeys(formats))
    for name in wanted:
        if name not in FILES:
            expected = f"one of {', '.join(FILES)}"
            hint = "one of these (estimate.csv is always there)"
            raise RecordingError(folder, f"the format '{name}'", expected, hint)
    return {name: FILES[name] for name in wanted}


def write_npz(path: Path, entries: Mapping[str, Entry]) -> None:
    """A compressed NPZ file."""
    arrays = {name: _array(entry.value) for name, entry in entries.items() if name}
    for name, entry in entries.items():
        head = f"{name}@" if name else ""
        arrays |= {f"{head}{key}": _array(attribute) for key, attribute in entry.about.items()}
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def _array(value: Any) -> Any:
    # Without its type a list of no texts would become numbers.
    return np.array(value, str) if isinstance(value, list | tuple) else np.asarray(value)


def write_hdf5(path: Path, entries: Mapping[str, Entry]) -> None:
    """A compressed HDF5 file."""
    with h5py.File(path, "w") as file:
        for name, entry in entries.items():
            node: Any = _add(file, name, entry.value) if name else file
            for key, attribute in entry.about.items():
                node.attrs[key] = attribute


def _add(file: Any, name: str, value: Any) -> Any:
    if isinstance(value, str | list):
        return file.create_dataset(name, data=value, dtype=h5py.string_dtype())
    array = np.asarray(value)
    # A scalar or empty data set has no chunks to compress.
    packed = {"compression": "gzip", "shuffle": True} if array.ndim and array.size else {}
    return file.create_dataset(name, data=array, **packed)


def write_tum(
    path: Path,
    time_ns: Times,
    q_ref_body: Floats,
    position: Floats | None = None,
    comments: Iterable[str] = (),
) -> None:
    """A trajectory in the TUM format, ``timestamp tx ty tz qx qy qz qw``: body to reference, scalar last.

    `q_ref_body` (N, 4) is w, x, y, z and `position` (N, 3) in metres, zero where there is none. Times are
    seconds with nine decimals, exact; other numbers have 17 digits, which lose nothing. Instants whose
    pose is not finite have no line; a comment at the head has their number.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from jaxekf.io import export
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "trajectory.txt"
    ...     export.write_tum(file, np.array([1_500_000_000]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    ...     print(file.read_text("utf-8").splitlines()[-1])
    1.500000000 0 0 0 0 0 0 1
    """
    notes = ["timestamp tx ty tz qx qy qz qw (s, m, body to reference)", *comments]
    if position is None:
        position = np.zeros((len(time_ns), 3))
        notes.append("no position was estimated: tx ty tz are zero")
    poses = np.column_stack([position, q_ref_body[:, [1, 2, 3, 0]]])
    known = np.asarray(np.isfinite(poses).all(axis=1))
    if not known.all():
        notes.append(
            f"left out: {np.sum(~known)} of {len(known)} instants, whose pose is not finite"
        )
    lines = [f"# {' '.join(note.split())}" for note in notes]
    for time, pose in zip(time_ns[known], poses[known], strict=True):
        numbers = " ".join(f"{value:.17g}" for value in pose)
        lines.append(f"{format_seconds(int(time), decimals=9)} {numbers}")
    path.write_text("\n".join(lines) + "\n", "utf-8", newline="\n")


def read_export(path: Path | str) -> dict[str, Any]:
    """Content of an NPZ or HDF5 file of `Estimate.export`: a dict by paths, equal for both formats.

    Arrays have the bits that were written; single numbers are Python's, texts `str` and lists of `str`.
    ``time_ns`` and ``state/bias`` are entries, ``state/bias@unit`` an attribute of one, ``model`` an
    attribute of the root.

    Parameters
    ----------
    path
        A file with the suffix ``.npz``, ``.h5`` or ``.hdf5``.

    Raises
    ------
    RecordingError
        For a file that `Estimate.export` has not written.

    Examples
    --------
    >>> import tempfile
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> estimate = jaxekf.estimate(jaxekf.demo.FOLDER / "free-5")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     found = jaxekf.read_export(estimate.export(folder + "/estimate.npz"))
    >>> found["model"], found["state/bias"].shape, found["state/bias@unit"]
    ('loose', (3001, 3), 'rad/s')
    >>> bool((found["time_ns"] == estimate.time_ns).all())
    True
    """
    form = format_of(path)
    if form not in ("npz", "hdf5"):
        raise RecordingError(path, f"the format {form}", "NPZ or HDF5", "an export in one of these")
    if not Path(path).is_file():
        raise RecordingError(path, "no such file", "an export of an estimate", "another path")
    try:
        found = _read_npz(path) if form == "npz" else _read_hdf5(path)
    except (OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise RecordingError(
            path, f"a file that is not {form} ({error})", "an export", "exporting again"
        ) from error
    attribute = (found.get("kind"), found.get("schema_version"))
    if attribute != (KIND, SCHEMA_VERSION):
        got, expected = f"kind and schema_version {attribute}", str((KIND, SCHEMA_VERSION))
        raise RecordingError(path, got, expected, "exporting again with this version")
    return found


def _read_npz(path: Path | str) -> dict[str, Any]:
    if not zipfile.is_zipfile(path):
        raise zipfile.BadZipFile("no archive")
    with np.load(path, allow_pickle=False) as file:
        return {name: _plain(file[name]) for name in file.files}


def _read_hdf5(path: Path | str) -> dict[str, Any]:
    found: dict[str, Any] = {}

    def take(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset):
            text = h5py.check_string_dtype(node.dtype) is not None
            found[name] = _plain(node.asstr()[()] if text else node[()])
        found.update({f"{name}@{key}": _plain(attribute) for key, attribute in node.attrs.items()})

    with h5py.File(path, "r") as file:
        found |= {key: _plain(attribute) for key, attribute in file.attrs.items()}
        file.visititems(take)
    return found


def _plain(value: Any) -> Any:
    array = np.asarray(value)
    return array.tolist() if array.ndim == 0 or array.dtype.kind in "OU" else array
