"""The streams of a recording in the ASL layout: their files and kinds, and which are preferred."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers._asl_sensor_yaml import read_description

_LISTED = 12
_WANTED = {
    "imu": "an IMU: a folder imu0, or one whose sensor.yaml states sensor_type: imu",
    "pose": "poses: a folder vicon0, mocap0 or state_groundtruth_estimate0, or one whose "
    "sensor.yaml states sensor_type: pose or visual-inertial",
}
# A stream's kind by the name of its folder. The sensor_type decides for other names only, because converted
# recordings often carry a sensor.yaml copied from another stream.
_KINDS = (
    ("measured", re.compile(r"(vicon|mocap)\d*")),
    ("estimate", re.compile(r"(state_)?(groundtruth|ground_truth|gt)(_estimate)?\d*")),
    ("imu", re.compile(r"imu\d*")),
    ("position", re.compile(r"leica\d*")),
    ("camera", re.compile(r"cam\d*")),
)
_SENSOR_TYPES = {"pose": "measured", "visual-inertial": "estimate"}
POSES = ("measured", "estimate")
_FIRST = ("imu0", "vicon0", "mocap0", "state_groundtruth_estimate0")
_FLAT = {"imu": ("_imu.txt", "_imu.csv"), "measured": ("_mocap.csv", "_mocap.txt")}


class Stream(NamedTuple):
    """One stream of a recording."""

    file: Path
    kind: str
    """``imu``, ``measured`` or ``estimate`` (of poses), or another sensor type."""
    label: str
    """The folder's name, or the file's if it has no folder of its own."""

    @property
    def sensor_yaml(self) -> Path | None:
        """The file of its extrinsics, if there is one: only a ``data.csv`` has a folder to itself."""
        file = self.file.with_name("sensor.yaml")
        return file if self.file.name == "data.csv" and file.is_file() else None


def find(folder: Path | str) -> list[Path]:
    """Find every recording in a folder and below it.

    Parameters
    ----------
    folder : path
        A folder.

    Returns
    -------
    list of Path
        Recordings with both an IMU and poses, in natural order (``room2`` before ``room10``). `load` takes
        each: a folder that holds ``mav0`` (or its streams directly), or the prefix of a flat pair of files,
        ``.../room1``.

    Raises
    ------
    RecordingError
        If there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RecordingError(folder, "no such folder", "a folder of recordings", "another path")
    found: list[Path] = []
    for place, below, _ in os.walk(folder):
        here = Path(place)
        root = _root(here)
        kinds = {stream.kind for stream in _folder_streams(root)} if root else set()
        if "imu" in kinds and not kinds.isdisjoint(POSES):
            found.append(here)
            # Its streams, with thousands of images, hold no further recording.
            below[:] = [name for name in below if root != here and name != "mav0"]
        found.extend(here / name for name in _flat_pairs(here))
    return sorted(found, key=_natural)


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.as_posix())]


def recording_name(path: Path) -> str:
    """The name of a recording's folder, or the prefix of its files."""
    path = Path(os.path.abspath(path))  # not resolved: a link's name is the one that was given
    if path.is_file():
        if path.name != "data.csv":
            return re.sub(r"_imu$", "", path.stem)
        path = path.parent.parent
    return (path.parent.name if path.name == "mav0" else path.name) or "recording"


def _root(folder: Path) -> Path | None:
    """The folder of the streams: ``mav0`` in a folder, or the folder itself if it holds streams."""
    if (folder / "mav0").is_dir():
        return folder / "mav0"
    return folder if next(folder.glob("*/data.csv"), None) else None


def _folder_streams(root: Path) -> list[Stream]:
    """Streams in order of preference: measured before estimated."""
    files = sorted(root.glob("*/data.csv"), key=_natural)
    streams = [_stream(file) for file in files]
    return sorted(
        streams,
        key=lambda stream: (
            POSES.index(stream.kind) if stream.kind in POSES else -1,
            _FIRST.index(stream.label) if stream.label in _FIRST else len(_FIRST),
        ),
    )


def _stream(file: Path) -> Stream:
    """The stream of a file; its kind follows from the name of its folder or file."""
    if file.name != "data.csv":
        flat = (kind for kind, suffixes in _FLAT.items() if file.name.endswith(suffixes))
        return Stream(file, next(flat, "unknown"), file.name)
    label = Path(os.path.abspath(file)).parent.name
    for kind, pattern in _KINDS:
        if pattern.fullmatch(label):
            return Stream(file, kind, label)
    sensor_yaml = Stream(file, "unknown", label).sensor_yaml
    try:
        description = read_description(sensor_yaml) if sensor_yaml else {}
    except RecordingError:
        description = {}  # read again, and reported, if this stream is used
    word = str(description.get("sensor_type", "unknown")).strip().lower()
    return Stream(file, _SENSOR_TYPES.get(word, word), label)


def _flat_pairs(folder: Path) -> dict[str, tuple[Stream, Stream]]:
    """IMU and poses of every pair of files, by their prefix, in natural order."""
    pairs: dict[str, tuple[Stream, Stream]] = {}
    for file in sorted(folder.glob("*_imu.*"), key=_natural):
        name = file.stem.removesuffix("_imu")
        prefix = folder / name
        if name and name not in pairs and (pair := _flat_pair(prefix)):
            pairs[name] = pair
    return pairs


def _flat_pair(prefix: Path) -> tuple[Stream, Stream] | None:
    found = []
    for kind, suffixes in _FLAT.items():
        files = (prefix.with_name(prefix.name + suffix) for suffix in suffixes)
        file = next((file for file in files if file.is_file()), None)
        if file is None:
            return None
        found.append(Stream(file, kind, file.name))
    return found[0], found[1]


def only_recording(folder: Path) -> Path:
    """The only recording in a folder or below it; the folder itself if none is found.

    Raises `RecordingError` for several, unless the folder itself is one of them.
    """
    found = find(folder)
    if len(found) > 1 and folder not in found:
        names = [one.relative_to(folder).as_posix() for one in found]
        more = ", ..." if len(names) > _LISTED else ""
        got = f"{len(names)} recordings ({', '.join(names[:_LISTED])}{more})"
        raise RecordingError(folder, got, "one", f"naming it: {folder / names[0]}")
    return found[0] if len(found) == 1 else folder


def choose_streams(
    path: Path | None, imu: Path | str | None, pose: Path | str | None
) -> tuple[Stream, Stream]:
    """The streams of the IMU and of the poses, as given or as preferred."""
    if path is None and (imu is None or pose is None):
        raise RecordingError(
            "load", "no path", "a recording, or both imu= and pose=", "giving the missing argument"
        )
    base = (_root(path) or path) if path is not None and path.is_dir() else None
    given = [None if value is None else _given(value, base) for value in (imu, pose)]
    streams = [] if path is None or None not in given else _streams(path)
    return (
        given[0] or _preferred(path, streams, "imu", ("imu",)),
        given[1] or _preferred(path, streams, "pose", POSES),
    )


def _streams(path: Path) -> Sequence[Stream]:
    """All streams of a recording in order of preference."""
    root = _root(path) if path.is_dir() else None
    if root is not None:
        return _folder_streams(root)
    pair = _flat_pair(path) if path.name else None
    if pair is not None:
        return pair
    got = "no stream" if path.is_dir() else "no such folder, and no pair of files"
    expected = "a folder that holds mav0, or the prefix of NAME_imu.txt and NAME_mocap.csv"
    hint = "a recording that asl.find(FOLDER) lists"
    raise RecordingError(path, "a file" if path.is_file() else got, expected, hint)


def _given(value: Path | str, base: Path | None) -> Stream:
    """A stream by its name in the recording, its folder or its file."""
    choices = ([base / value] if base is not None else []) + [Path(value)]
    for choice in choices:
        file = choice / "data.csv" if choice.is_dir() else choice
        if file.is_file():
            return _stream(file)
    raise RecordingError(
        value, "no such stream", "the name or path of a folder with data.csv, or a file", "another"
    )


def _preferred(
    path: Path | None, streams: Sequence[Stream], option: str, kinds: Sequence[str]
) -> Stream:
    for stream in streams:
        if stream.kind in kinds:
            return stream
    listed = ", ".join(f"{stream.label} ({stream.kind})" for stream in streams)
    got = f"only {listed}" if listed else "no stream"
    raise RecordingError(path or option, got, _WANTED[option], f"{option}=PATH")
