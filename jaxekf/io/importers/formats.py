"""Files of other programs and published data sets, by the name of their format."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers import adis, asl, broad, ndi, optitrack, repoimu, vicon
from jaxekf.recordings.types import Recording

_SHOWN = 12


class Format(NamedTuple):
    """How files of one kind are read."""

    load: Callable[..., Recording]
    """Takes a path, and the options below by name."""
    about: str
    options: tuple[str, ...] = ()
    """What `load` may be told besides the path."""


def _one_asl(path: Path | str, **options: Any) -> Recording:
    """One recording; a folder of several is refused by their names."""
    place = Path(path)
    if place.is_dir():
        found = asl.find(place)
        if len(found) > 1 and place not in found:
            told = [one.relative_to(place).as_posix() for one in found]
            more = ", ..." if len(told) > _SHOWN else ""
            raise RecordingError(
                place,
                f"{len(told)} recordings ({', '.join(told[:_SHOWN])}{more})",
                "one",
                f"naming it: {place / told[0]}",
            )
        # Where it stands deeper, it is still the only one that can be meant.
        place = found[0] if len(found) == 1 else place
    return asl.load(place, **options)


def _one_trial(path: Path | str) -> Recording:
    """One trial of BROAD; a folder of several is refused by their names."""
    place = Path(path)
    if place.is_dir():
        told = sorted(file.name for file in place.rglob("*.mat"))
        more = ", ..." if len(told) > _SHOWN else ""
        raise RecordingError(
            place,
            f"a folder that holds {len(told)} trials ({', '.join(told[:_SHOWN])}{more})",
            "one BROAD .mat file",
            "naming it",
        )
    return broad.load(place)


def _bag(path: Path | str, **options: Any) -> Recording:
    """A ROS bag; its readers are loaded only when there is one."""
    from jaxekf.io.importers import ros

    return ros.load(path, **options)


FORMATS: Mapping[str, Format] = {
    "ndi": Format(
        ndi.load,
        "NDI tracker, CSV export (tool by --tool): a tracker alone",
        ("tool", "rate_hz", "status_ok", "sort"),
    ),
    "optitrack": Format(
        optitrack.load,
        "OptiTrack Motive, CSV export of rigid bodies: a tracker alone",
        ("tool", "sort"),
    ),
    "vicon": Format(
        vicon.load,
        "Vicon Nexus or Tracker, CSV export of segments or objects: a tracker alone",
        ("tool", "sort"),
    ),
    "asl": Format(
        _one_asl, "EuRoC, TUM-VI and others in the ASL layout: tracker and IMU", ("imu", "pose")
    ),
    "ros": Format(
        _bag,
        "ROS 1 bag, ROS 2 bag, .mcap or .db3: tracker, IMU and a joint's angle",
        ("imu", "pose", "child_frame", "joint", "joint_name", "axis", "stamps", "sort"),
    ),
    "broad": Format(_one_trial, "BROAD trial (.mat): tracker, IMU and truth"),
    "repoimu": Format(repoimu.load, "RepoIMU T-stick trial (.csv, .csv.gz): tracker and IMU"),
    "adis": Format(adis.load, "static log of the R package imudata (.npz): an IMU alone"),
}
"""Formats by name."""


def read(name: str, path: Path | str, **options: Any) -> Recording:
    """A recording of a format, its origin and the account of its rows in ``info["imported"]``.

    Raises `RecordingError` for a format that is not known, and what its loader raises.
    """
    if name not in FORMATS:
        raise RecordingError(
            path, f"the format '{name}'", f"one of {', '.join(FORMATS)}", "one of these"
        )
    recording = FORMATS[name].load(path, **options)
    told = {
        key: list(value) if isinstance(value, tuple) else value for key, value in options.items()
    }
    imported = {
        "format": name,
        "source": Path(path).name,
        **told,
        "account": {label: account.as_dict() for label, account in recording.intake.items()},
    }
    return recording.replace(info={**recording.info, "imported": imported})
