"""Importer of an IMU with a pose stream in the ASL layout: EuRoC, TUM-VI and their kin.

A recording is a folder ``FOLDER/mav0`` with one folder a stream, each a ``data.csv`` and mostly a
``sensor.yaml`` (Burri et al. 2016, doi 10.1177/0278364915620033), or, flat, a pair of files
``NAME_imu.txt`` and ``NAME_mocap.csv``. Stamps are nanoseconds; quaternions stand in the order
w, x, y, z unless the header says another.
"""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers._columns import (
    Columns,
    Sheet,
    check_finite,
    locate,
    numbers,
    read_sheet,
    stamps,
)
from jaxekf.pose_solvers.marker_pose import gravity
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Intake, Place, Reason
from jaxekf.recordings.types import Floats, Imu, Optical, Recording, Times, from_scipy, to_scipy

_RATE_AND_FORCE = ("wx", "wy", "wz", "ax", "ay", "az")
_POSE = ("px", "py", "pz", "qw", "qx", "qy", "qz")
_NOISE = (
    "gyroscope_noise_density",
    "gyroscope_random_walk",
    "accelerometer_noise_density",
    "accelerometer_random_walk",
)
_GRAVITY_REF = (0.0, 0.0, -9.81)
_FARTHEST_GRAVITY = 1.0
"""m/s^2: an accelerometer's bias is less, a wrong axis, unit or transform is more."""
_WANTED = {
    "imu": "an IMU: a folder imu0, or one whose sensor.yaml says sensor_type: imu",
    "pose": "poses: a folder vicon0, mocap0 or state_groundtruth_estimate0, or one whose "
    "sensor.yaml says sensor_type: pose or visual-inertial",
}
# What a stream is, by the name of its folder; sensor_type decides on names that are not here,
# because converted recordings often carry a sensor.yaml copied from another stream.
_KINDS = (
    ("measured", re.compile(r"(vicon|mocap)\d*")),
    ("estimate", re.compile(r"(state_)?(groundtruth|ground_truth|gt)(_estimate)?\d*")),
    ("imu", re.compile(r"imu\d*")),
    ("position", re.compile(r"leica\d*")),
    ("camera", re.compile(r"cam\d*")),
)
_SENSOR_TYPES = {"pose": "measured", "visual-inertial": "estimate"}
_POSES = ("measured", "estimate")
_FIRST = ("imu0", "vicon0", "mocap0", "state_groundtruth_estimate0")
_FLAT = {"imu": ("_imu.txt", "_imu.csv"), "measured": ("_mocap.csv", "_mocap.txt")}
_ROTATION_TOLERANCE = 1e-3  # EuRoC writes its matrices with five digits


class _Stream(NamedTuple):
    file: Path
    kind: str
    """``imu``, ``measured`` or ``estimate`` (of poses), or what else the folder says."""
    label: str
    """The folder's name, or the file's where it has no folder of its own."""

    @property
    def description(self) -> Path:
        """Where its extrinsics are: only a ``data.csv`` has a folder to itself."""
        return self.file.parent / "sensor.yaml"

    @property
    def described(self) -> bool:
        return self.file.name == "data.csv" and self.description.is_file()


class _Transform(NamedTuple):
    """The pose of frame b in frame a: takes coordinates of b to a."""

    rotation: Rotation
    translation: Floats

    def inverse(self) -> "_Transform":
        back = self.rotation.inv()
        return _Transform(back, -back.apply(self.translation))

    def then(self, other: "_Transform") -> "_Transform":
        """``T_a_b.then(T_b_c)`` is ``T_a_c``."""
        return _Transform(
            self.rotation * other.rotation,
            self.rotation.apply(other.translation) + self.translation,
        )


_IDENTITY = _Transform(Rotation.identity(), np.zeros(3))


def find(folder: Path | str) -> list[Path]:
    """Every recording in a folder and below it, in natural order (``room2`` before ``room10``).

    Each can be given to `load`: a folder that holds ``mav0`` (or its streams directly), or the
    prefix of a flat pair of files, ``.../room1``. Only what has both an IMU and poses is listed.
    Raises `RecordingError` where there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RecordingError(folder, "no such folder", "a folder of recordings", "another path")
    found: list[Path] = []
    for place, below, _ in os.walk(folder):
        here = Path(place)
        root = _root(here)
        kinds = {stream.kind for stream in _asl_streams(root)} if root else set()
        if "imu" in kinds and not kinds.isdisjoint(_POSES):
            found.append(here)
            # Its streams, with thousands of images, hold no further recording.
            below[:] = [name for name in below if root != here and name != "mav0"]
        found.extend(here / name for name in _flat_pairs(here))
    return sorted(found, key=_natural)


def load(
    path: Path | str | None = None,
    *,
    imu: Path | str | None = None,
    pose: Path | str | None = None,
) -> Recording:
    """One recording: gyroscope and accelerometer, and the tracker's attitude and position.

    `path` is a folder that holds ``mav0``, a ``mav0`` itself, the prefix of a flat pair of files
    (``.../room1`` for ``room1_imu.txt`` and ``room1_mocap.csv``), or a folder with one such pair;
    see `find`. `imu` and `pose` take another stream instead: its folder's name in the recording, a
    folder, or a file. With both, `path` may be left out. Poses as measured are preferred to
    estimates: ``vicon0``, ``mocap0``, others of `sensor_type` pose,
    ``state_groundtruth_estimate0``, others of `sensor_type` visual-inertial.

    The body is the IMU's frame I. With the transforms ``T_BS`` of the two ``sensor.yaml`` (sensor
    to the data set's own body frame B; without one, the identity)::

        T_I_S = inverse(T_B_I) T_B_S        S: the tracked frame, R: the reference
        q_ref_body = q_R_S conj(q_I_S)      unit quaternions (N, 4), w x y z
        p_body_tool = p_I_S                 (3,) m
        position = p_R_S                    (N, 3) m, not moved

    Rates are rad/s and specific forces m/s^2, both (N, 3) in I. A pose is not valid where its
    quaternion is zero or not near unit norm, or where any of its numbers is missing. Rows repeated
    exactly are dropped, and a last line that is cut short. `intake` holds the account of both streams,
    by lines of their files. `info` says what was read: ``imu_stream``, ``pose_stream``, ``pose_kind``
    (measured, estimate or unknown), ``duplicate_rows`` dropped, ``imu_noise`` where ``sensor.yaml``
    has it (rad/s/√Hz, rad/s²/√Hz, m/s²/√Hz, m/s³/√Hz), ``gravity_ref`` (approximate, m/s²) and, in
    sentences, all ``assumptions``.

    Raises `RecordingError`, which names file, line and column: for a stream that is not there,
    cells that are not numbers, stamps that are not whole nanoseconds or do not increase, a ``T_BS``
    that is not a rigid motion, and where gravity, found from both streams, is not as assumed.
    """
    place = None if path is None else Path(path)
    imu_stream, pose_stream = _choose(place, imu, pose)
    inertial, tracked = _read(imu_stream, _RATE_AND_FORCE), _read(pose_stream, _POSE)
    # A flat pair is known by its prefix, however it was given.
    unnamed = place is None or place == imu_stream.file.parent
    optical, seen = _optical(tracked, inertial.body_sensor.inverse().then(tracked.body_sensor))
    read, felt = _imu(inertial)
    recording = Recording(
        _name(imu_stream.file if place is None or unnamed else place),
        optical=optical,
        imu=read,
        info=_info(inertial, tracked),
        path=place or imu_stream.file,
        intake={"optical": seen, "imu": felt},
    )
    _check_gravity(recording, pose_stream)
    return recording


def _check_gravity(recording: Recording, stream: Any) -> None:
    """Raise where the accelerometer, turned by the poses, does not fall as the layout takes for granted."""
    try:
        found = gravity(recording.need_optical(), recording.need_imu(), stream.file)
    except RecordingError:
        return
    if np.linalg.norm(found - _GRAVITY_REF) > _FARTHEST_GRAVITY:
        raise RecordingError(
            stream.file,
            f"free fall of {np.round(found, 2).tolist()} m/s^2 by accelerometer and poses together",
            f"about {list(_GRAVITY_REF)}",
            "checking that the reference's z points up, the units (m/s^2, m, ns), the order of the"
            " quaternion, T_BS and that both streams have one clock",
        )


# ---------------------------------------------------------------------------------------------
# Which files


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.as_posix())]


def _name(path: Path) -> str:
    """A recording's name by its place: of its folder, or of the prefix of its files."""
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


def _asl_streams(root: Path) -> list[_Stream]:
    """Streams in the order in which they are preferred: measured before estimated."""
    files = sorted(root.glob("*/data.csv"), key=_natural)
    streams = [_stream(file) for file in files]
    return sorted(
        streams,
        key=lambda stream: (
            _POSES.index(stream.kind) if stream.kind in _POSES else -1,
            _FIRST.index(stream.label) if stream.label in _FIRST else len(_FIRST),
        ),
    )


def _stream(file: Path) -> _Stream:
    """A stream by its file, its kind by what its folder or file is called."""
    if file.name != "data.csv":
        flat = (kind for kind, suffixes in _FLAT.items() if file.name.endswith(suffixes))
        return _Stream(file, next(flat, "unknown"), file.name)
    label = Path(os.path.abspath(file)).parent.name
    for kind, pattern in _KINDS:
        if pattern.fullmatch(label):
            return _Stream(file, kind, label)
    try:
        about = _description(_Stream(file, "unknown", label))
    except RecordingError:
        about = {}  # read again, and reported, if this stream is the one that is used
    word = str(about.get("sensor_type", "unknown")).strip().lower()
    return _Stream(file, _SENSOR_TYPES.get(word, word), label)


def _flat_pairs(folder: Path) -> dict[str, tuple[_Stream, _Stream]]:
    """IMU and poses of every pair of files, by their prefix, in natural order."""
    pairs: dict[str, tuple[_Stream, _Stream]] = {}
    for file in sorted(folder.glob("*_imu.*"), key=_natural):
        name = file.stem.removesuffix("_imu")
        prefix = folder / name
        if name and name not in pairs and (pair := _flat_pair(prefix)):
            pairs[name] = pair
    return pairs


def _flat_pair(prefix: Path) -> tuple[_Stream, _Stream] | None:
    found = []
    for kind, suffixes in _FLAT.items():
        files = (prefix.with_name(prefix.name + suffix) for suffix in suffixes)
        file = next((file for file in files if file.is_file()), None)
        if file is None:
            return None
        found.append(_Stream(file, kind, file.name))
    return found[0], found[1]


def _choose(
    path: Path | None, imu: Path | str | None, pose: Path | str | None
) -> tuple[_Stream, _Stream]:
    """The two streams that are read."""
    if path is None and (imu is None or pose is None):
        raise RecordingError(
            "load", "no path", "a recording, or both imu= and pose=", "giving what is missing"
        )
    base = (_root(path) or path) if path is not None and path.is_dir() else None
    given = [None if value is None else _given(value, base) for value in (imu, pose)]
    there = [] if path is None or None not in given else _streams(path)
    return (
        given[0] or _pick(path, there, "imu", ("imu",)),
        given[1] or _pick(path, there, "pose", _POSES),
    )


def _streams(path: Path) -> Sequence[_Stream]:
    """All streams of a recording, the preferred first."""
    root = _root(path) if path.is_dir() else None
    if root is not None:
        return _asl_streams(root)
    pair = _flat_pair(path) if path.name else None
    if pair is not None:
        return pair
    if not path.is_dir():
        raise RecordingError(
            path,
            "a file" if path.is_file() else "no such folder, and no pair of files",
            "a folder that holds mav0, or the prefix of NAME_imu.txt and NAME_mocap.csv",
            "asl.find(FOLDER), which lists recordings",
        )
    pairs = _flat_pairs(path)
    if len(pairs) != 1:
        raise RecordingError(
            path,
            f"{len(pairs)} pairs of files ({', '.join(pairs)})" if pairs else "no stream",
            "mav0, or one pair NAME_imu.txt and NAME_mocap.csv",
            "a recording that asl.find(FOLDER) lists",
        )
    return next(iter(pairs.values()))


def _given(value: Path | str, base: Path | None) -> _Stream:
    """A stream by its name in the recording, its folder or its file."""
    choices = ([base / value] if base is not None else []) + [Path(value)]
    for choice in choices:
        file = choice / "data.csv" if choice.is_dir() else choice
        if file.is_file():
            return _stream(file)
    raise RecordingError(
        value, "no such stream", "the name or path of a folder with data.csv, or a file", "another"
    )


def _pick(
    path: Path | None, streams: Sequence[_Stream], what: str, kinds: Sequence[str]
) -> _Stream:
    for stream in streams:
        if stream.kind in kinds:
            return stream
    found = ", ".join(f"{stream.label} ({stream.kind})" for stream in streams)
    raise RecordingError(
        path or what, f"only {found}" if found else "no stream", _WANTED[what], f"{what}=PATH"
    )


# ---------------------------------------------------------------------------------------------
# What a sensor.yaml says


def _description(stream: _Stream) -> Mapping[str, Any]:
    """The stream's sensor.yaml; empty where there is none."""
    if not stream.described:
        return {}
    file = stream.description
    try:
        text = file.read_text("utf-8-sig")
        # OpenCV's "%YAML:1.0" and matrix tags are not YAML; the lines stay, so that they count.
        about = yaml.safe_load(re.sub(r"^%.*$|!!opencv-matrix", "", text, flags=re.MULTILINE))
    except (yaml.YAMLError, ValueError, OSError) as error:  # ValueError: text, dates
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or error
        raise RecordingError(
            file,
            f"text that is not YAML ({reason})",
            "YAML",
            "mending it",
            line=None if mark is None else mark.line + 1,
        ) from error
    if not isinstance(about, dict):
        raise RecordingError(file, f"{about!r}", "keys and values", "mending it")
    return about


def _extrinsics(stream: _Stream, about: Mapping[str, Any]) -> _Transform:
    """``T_BS``, the sensor's pose in the data set's body frame; the identity if not given."""
    if "T_BS" not in about:
        return _IDENTITY
    value = about["T_BS"]
    try:
        # YAML 1.1 takes 1e-3, without a point, for text: NumPy makes it a number again.
        data = np.asarray(value["data"] if isinstance(value, dict) else value, float)
        matrix = data.reshape(4, 4)
    except (KeyError, TypeError, ValueError):
        raise _bad_extrinsics(stream, f"{value!r}", "16 numbers, row by row, under data") from None
    turn = matrix[:3, :3]
    if not np.isfinite(matrix).all():
        raise _bad_extrinsics(stream, "numbers that are not finite", "a rigid motion")
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise _bad_extrinsics(stream, f"the last row {matrix[3].tolist()}", "0, 0, 0, 1")
    off = float(np.max(np.abs(turn.T @ turn - np.eye(3))))
    if off > _ROTATION_TOLERANCE or np.linalg.det(turn) < 0:
        sort = "a reflection" if off <= _ROTATION_TOLERANCE else f"columns {off:.2g} from it"
        raise _bad_extrinsics(stream, sort, "a rotation: orthonormal columns, determinant +1")
    return _Transform(Rotation.from_matrix(turn), matrix[:3, 3].copy())


def _bad_extrinsics(stream: _Stream, got: str, expected: str) -> RecordingError:
    return RecordingError(
        stream.description, got, expected, "correcting the calibration", column="T_BS"
    )


def _noise(stream: _Stream, about: Mapping[str, Any]) -> dict[str, float]:
    """Spectral densities of the IMU's noise and bias walks, SI/√Hz, as far as they are given."""
    noise = {}
    for key in _NOISE:
        if key not in about:
            continue
        try:
            noise[key] = float(about[key])
        except (TypeError, ValueError):
            noise[key] = np.nan
        if not 0.0 <= noise[key] < np.inf:
            raise RecordingError(
                stream.description,
                f"{about[key]!r}",
                "a density of 0 or more",
                "correcting it",
                column=key,
            )
    return noise


# ---------------------------------------------------------------------------------------------
# What the streams hold


class _Source(NamedTuple):
    """A stream as it is read, before its numbers."""

    stream: _Stream
    about: Mapping[str, Any]
    body_sensor: _Transform
    sheet: Sheet
    columns: Columns


def _read(stream: _Stream, wanted: Sequence[str]) -> _Source:
    about = _description(stream)
    sheet = read_sheet(stream.file)
    return _Source(stream, about, _extrinsics(stream, about), sheet, locate(sheet, wanted))


def _imu(source: _Source) -> tuple[Imu, Intake]:
    values = numbers(source.sheet, source.columns)
    check_finite(source.sheet, source.columns, values)
    time_ns = stamps(source.sheet)
    gyroscope, accelerometer = values[:, :3].copy(), values[:, 3:].copy()
    imu, account = screening.imu(_place(source), time_ns, gyroscope, accelerometer)
    return imu, _with_left_out(account, source, time_ns)


def _optical(source: _Source, body_sensor: _Transform) -> tuple[Optical, Intake]:
    """The body's attitude and the tracked point's position, given the tracked frame in the body."""
    values = numbers(source.sheet, source.columns)
    time_ns = stamps(source.sheet)
    sensor, account = screening.optical(
        _place(source),
        time_ns,
        values[:, 3:],
        values[:, :3].copy(),
        p_body_tool=body_sensor.translation.copy(),
    )
    q_ref_body = from_scipy(to_scipy(sensor.q_ref_body) * body_sensor.rotation.inv())
    q_ref_body[~sensor.valid] = (1.0, 0.0, 0.0, 0.0)
    return replace(sensor, q_ref_body=q_ref_body), _with_left_out(account, source, time_ns)


def _place(source: _Source) -> Place:
    return Place(source.sheet.path, np.array(source.sheet.lines, np.intp))


def _with_left_out(account: Intake, source: _Source, time_ns: Times) -> Intake:
    """The account with the lines that the sheet left out: exact duplicates wherever they stood, and a last
    line that is cut short, which has the stamp of the row before it."""
    dropped = dict(account.dropped)
    if source.sheet.repeated:
        lines, rows = np.array(source.sheet.repeated, np.intp).T
        dropped["repeated"] = Reason(lines, time_ns[rows])
    if source.sheet.cut:
        dropped["cut short"] = Reason(np.array(source.sheet.cut, np.intp), time_ns[-1:])
    count = len(source.sheet.repeated) + len(source.sheet.cut)
    return replace(account, rows=account.rows + count, dropped=dropped)


def _info(imu: _Source, pose: _Source) -> dict[str, Any]:
    info: dict[str, Any] = {
        "dataset": "ASL",
        "imu_stream": imu.stream.label,
        "pose_stream": pose.stream.label,
        "pose_kind": pose.stream.kind,
        "duplicate_rows": {"imu": len(imu.sheet.repeated), "optical": len(pose.sheet.repeated)},
        "gravity_ref": list(_GRAVITY_REF),
        "assumptions": list(_assumptions(imu, pose)),
    }
    noise = _noise(imu.stream, imu.about)
    return info | ({"imu_noise": noise} if noise else {})


def _assumptions(imu: _Source, pose: _Source) -> Iterator[str]:
    """What is taken for granted, in sentences."""
    yield f"The body is the frame of the IMU ({imu.stream.label})."
    for source, frame in ((imu, "the IMU's"), (pose, "the tracked")):
        label = source.stream.label
        if "T_BS" not in source.about:
            lack = "T_BS in the sensor.yaml" if source.stream.described else "sensor.yaml"
            yield (
                f"Extrinsics of {label}: no {lack}, so {frame} frame is taken for the data set's "
                "body frame (T_BS = identity)."
            )
        named = source.columns.named
        how = "as its header names them" if named else "no header names them; taken as time"
        yield f"Columns of {label}: {how}, {' '.join(source.columns.labels)}."
    yield "Quaternions are Hamilton and turn the tracked frame's coordinates into the reference's."
    yield "Stamps of both streams are nanoseconds of one clock; a pose was taken at its stamp."
    yield "Units are rad/s, m/s^2 and m."
    yield f"z of the reference points up; gravity_ref = {list(_GRAVITY_REF)} m/s^2 is approximate."
    if pose.stream.kind == "estimate":
        yield (
            f"{pose.stream.label} is an estimate, made with this very IMU: "
            "its errors go with the IMU's."
        )
