"""Files of other programs and published data sets, by the name of their format.

A new importer is a module with a function `load` and an entry in `FORMATS`, from which the command
`jaxekf import` gets its options. Importers are imported when they are first used.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxekf._support.errors import RecordingError

if TYPE_CHECKING:
    from jaxekf.recordings.types import Recording


class Option(NamedTuple):
    """A keyword of an importer's `load`, and its option of the command line."""

    name: str
    """The keyword; the option has its name without the unit: ``rate_hz`` is ``--rate``."""
    help: str
    """A noun phrase."""
    kind: type = str
    """`str`, `float`, or `bool` for a flag."""
    unit: str = ""
    """Suffix of the name, such as ``hz``."""
    default: str | float | None = None
    """Default of the importer, for the help text."""
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None
    """Largest number, and the number that it must exceed."""
    values: tuple[str, ...] = ()
    """Names of its values, if there are several."""
    repeatable: bool = False

    @property
    def flag(self) -> str:
        """Name on the command line."""
        return "--" + self.name.removesuffix(f"_{self.unit}").replace("_", "-")


class Format(NamedTuple):
    """An importer."""

    module: str
    """Its module in this package."""
    summary: str
    options: tuple[Option, ...] = ()

    @property
    def load(self) -> "Callable[..., Recording]":
        """Its function, which takes a path, and its options by name."""
        return import_module(f"{__package__}.{self.module}").load


_TOOL = Option("tool", "name of the tool, rigid body, segment or object, if SRC holds several")
_SORT = Option("sort", "sort rows or messages by time that are out of order", bool)

FORMATS: Mapping[str, Format] = {
    "ndi": Format(
        "ndi",
        "NDI tracker, CSV export (tool by --tool): a tracker alone",
        (
            _TOOL,
            Option(
                "rate_hz",
                "rate of the frame numbers in Hz, for files without time stamps",
                float,
                unit="hz",
                default=60,
                bounds=(0.0, 1e6),
            ),
            Option(
                "status_ok",
                "state of a good pose, a word or a number, instead of the usual ones",
                repeatable=True,
            ),
            _SORT,
        ),
    ),
    "optitrack": Format(
        "optitrack",
        "OptiTrack Motive, CSV export of rigid bodies: a tracker alone",
        (_TOOL, _SORT),
    ),
    "vicon": Format(
        "vicon",
        "Vicon Nexus or Tracker, CSV export of segments or objects: a tracker alone",
        (_TOOL, _SORT),
    ),
    "asl": Format(
        "asl",
        "EuRoC, TUM-VI and others in the ASL layout: tracker and IMU",
        (
            Option("imu", "stream of the IMU, by name or path"),
            Option("pose", "stream of the poses, by name or path"),
        ),
    ),
    "ros": Format(
        "ros",
        "ROS 1 bag, ROS 2 bag, .mcap or .db3: tracker, IMU and a joint's angle",
        (
            Option("imu", "topic of the IMU"),
            Option("pose", "topic of the poses"),
            Option("child_frame", "frame of the poses, if a topic has several"),
            Option("joint", "topic of the joint's angle, for truth; needs --axis"),
            Option("joint_name", "name of the joint, if a topic has several"),
            Option(
                "axis", "the joint's axis in the tracker's frame", float, values=("X", "Y", "Z")
            ),
            Option(
                "stamps",
                "stamps of the headers, or of receipt by the recorder",
                default="header",
                choices=("header", "receive"),
            ),
            _SORT,
        ),
    ),
    "broad": Format("broad", "BROAD trial (.mat): tracker, IMU and truth"),
    "repoimu": Format("repoimu", "RepoIMU T-stick trial (.csv, .csv.gz): tracker and IMU"),
    "adis": Format("adis", "static log of the R package imudata (.npz): an IMU alone"),
}
"""Formats by name."""


def read(name: str, path: Path | str, **options: Any) -> "Recording":
    """Read a recording of any format.

    Parameters
    ----------
    name : str
        A key of `FORMATS`.
    path : path
        The file or folder.
    **options
        Options of the format.

    Returns
    -------
    Recording
        The recording, with its source, options and the account of its rows in ``info["imported"]``.

    Raises
    ------
    RecordingError
        For an unknown format, and as the importer does.
    """
    if name not in FORMATS:
        raise RecordingError(
            path, f"the format '{name}'", f"one of {', '.join(FORMATS)}", "one of these"
        )
    recording = FORMATS[name].load(path, **options)
    given = {key: list(v) if isinstance(v, tuple) else v for key, v in options.items()}
    imported = {
        "format": name,
        "source": Path(path).name,
        **given,
        "account": {label: account.as_dict() for label, account in recording.intake.items()},
    }
    return recording.replace(info={**recording.info, "imported": imported})
