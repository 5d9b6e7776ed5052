"""Importer of ROS 1 bags, ROS 2 bags and single MCAP files: IMU, tracked pose and a joint's angle.

    sensor_msgs/Imu                                                    imu
    geometry_msgs/PoseStamped, PoseWithCovarianceStamped,
    geometry_msgs/TransformStamped, tf2_msgs/TFMessage                 optical
    sensor_msgs/JointState                                             encoder

ROS itself is not needed, but the library `rosbags` is: ``pip install 'jaxekf[ros]'``.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers import _ros_messages as ros_messages
from jaxekf.io.importers._bags import Bag, Topic, opened
from jaxekf.io.importers._ros_messages import IMU, JOINT, POSES, TRANSFORM, TREES, Source
from jaxekf.recordings.accounts import Intake
from jaxekf.recordings.types import Floats, Recording

STAMPS = ("header", "receive")


def load(
    path: Path | str,
    *,
    imu: str | None = None,
    pose: str | None = None,
    child_frame: str | None = None,
    joint: str | None = None,
    joint_name: str | None = None,
    axis: Sequence[float] | None = None,
    stamps: str = "header",
    sort: bool = False,
) -> Recording:
    """One recording of a bag: a ``.bag`` of ROS 1, the folder of a ROS 2 bag, an ``.mcap`` or a ``.db3``.

    `imu`, `pose` and `joint` are topics; None finds the only one of a suitable type, and a stream of which
    there is none is left out. `child_frame` chooses one of several transforms on a topic; a transform tree
    (``/tf``) is read only where it or the topic is given. Of a joint's angle the attitude is
    ``exp(axis angle)`` in the tracker's reference frame, so `axis` (3,) is needed: without it, and without
    `joint` or `joint_name` (one of several joints), joint angles are left out.

    Times are the headers' stamps, exact; `stamps` "receive" takes when the recorder got a message
    instead. `sort` puts messages in order that are not. Rates are rad/s, specific forces m/s^2, positions
    m, as the messages' definitions say; quaternions x, y, z, w become w, x, y, z, body to reference: the
    pose of the tracked frame in ``header.frame_id``. A covariance that begins with -1 says that the
    field is not there.

    `info` holds the topics and frames, and in sentences all ``assumptions``; `Recording.intake` what
    became of every message (samples are counted from 0). Raises `RecordingError`: for a file that cannot
    be read, topics that are missing or not the only ones, stamps that are not set or run backwards, frames
    that change, and what `jaxekf.recordings.screening` finds.
    """
    path = Path(path)
    if stamps not in STAMPS:
        raise RecordingError(path, f"stamps = {stamps!r}", "'header' or 'receive'", "one of these")
    turning = None if axis is None else _axis(path, axis)
    streams: dict[str, Any] = {}
    accounts: dict[str, Intake] = {}
    with opened(path) as bag:
        source = Source(bag, stamps, sort)
        topics = _choose(source, imu, pose, child_frame, joint, joint_name, turning)
        _say_times(source)
        if (topic := topics["imu"]) is not None:
            streams["imu"], accounts["imu"] = ros_messages.imu(source, topic)
        if (topic := topics["pose"]) is not None:
            streams["optical"], accounts["optical"] = ros_messages.optical(
                source, topic, child_frame
            )
        if (topic := topics["joint"]) is not None:
            streams["encoder"], accounts["encoder"] = ros_messages.encoder(
                source, topic, joint_name, turning
            )
    _say_body(source)
    return Recording(
        _name(path),
        **streams,
        info={**source.info, "assumptions": source.assumptions},
        path=path,
        intake=accounts,
    )


# ---------------------------------------------------------------------------------------------
# Which topics


def _choose(
    source: Source,
    imu: str | None,
    pose: str | None,
    child_frame: str | None,
    joint: str | None,
    joint_name: str | None,
    axis: Floats | None,
) -> Mapping[str, Topic | None]:
    """The topic of each stream, None where there is none; raises where it is not clear which."""
    bag = source.bag
    wants_joint = joint is not None or joint_name is not None or axis is not None
    poses = POSES if pose is None else (*POSES, *TREES)
    if child_frame is not None:
        poses = (TRANSFORM, *TREES)
    chosen = {
        "imu": _topic(bag, "imu", (IMU,), imu),
        "pose": _topic(bag, "pose", poses, pose),
        "joint": _topic(bag, "joint", (JOINT,), joint) if wants_joint else None,
    }
    if wants_joint and chosen["joint"] is None:
        raise RecordingError(
            bag.path, f"no topic of {JOINT}", "one for the joint", f"a topic of {_listed(bag)}"
        )
    if child_frame is not None and chosen["pose"] is None:
        raise RecordingError(
            bag.path,
            "no topic of transforms",
            f"one for the frame '{child_frame}'",
            f"a topic of {_listed(bag)}",
        )
    if not any(chosen.values()):
        raise RecordingError(
            bag.path,
            f"topics of {_listed(bag)}",
            f"at least one of {', '.join((IMU, *POSES))}",
            "recording such a topic, or naming one of a transform tree (pose='/tf', --pose /tf)",
        )
    for label, topic in chosen.items():
        if topic is not None:
            source.info[f"{label}_topic"] = topic.name
    left = [t.name for t in bag.topics if t.type == JOINT and t.stated]
    if left and not wants_joint:
        source.assumptions.append(
            f"joint angles ({', '.join(left)}) are not read: the joint's axis was not given (axis)"
        )
    return chosen


def _topic(bag: Bag, label: str, types: Sequence[str], name: str | None) -> Topic | None:
    """The topic of a name, or the only one with messages of these types."""
    if name is not None:
        of_name = [t for t in bag.topics if t.name.lstrip("/") == name.lstrip("/")]
        found = [t for t in of_name if t.type in types]
        if not found:
            got = f"type {', '.join(t.type for t in of_name)}" if of_name else "no such topic"
            raise RecordingError(
                f"{bag.path}:{name}",
                got,
                f"a topic of {' or '.join(types)}",
                f"a topic of {_listed(bag)}",
            )
    else:
        # Static transforms are no recording of motion.
        found = [t for t in bag.topics if t.type in types and t.stated and t.name != "/tf_static"]
    if len(found) > 1:
        told = ", ".join(f"{t.name} ({t.type}, {t.stated})" for t in found)
        raise RecordingError(
            bag.path,
            f"{len(found)} topics for {label}: {told}",
            "one",
            f"naming it ({label}='{found[0].name}', --{label} {found[0].name})",
        )
    return found[0] if found else None


def _listed(bag: Bag) -> str:
    told = ", ".join(f"{t.name} ({t.type}, {t.stated})" for t in bag.topics)
    return told or "none"


def _axis(path: Path, axis: Sequence[float]) -> Floats:
    try:
        direction = np.asarray(axis, float)
    except (TypeError, ValueError):
        direction = np.zeros(0)
    if direction.shape != (3,) or not np.isfinite(direction).all() or not direction.any():
        raise RecordingError(
            path, f"axis = {axis!r}", "3 finite numbers, not all 0", "axis=[0, 0, 1] (--axis 0 0 1)"
        )
    return direction


def _say_times(source: Source) -> None:
    header = "times are the headers' stamps, taken as when each sample was measured"
    receive = (
        "times are when the recorder got each message, which is later than when it was measured"
    )
    source.assumptions.append(header if source.stamps == "header" else receive)
    if source.sort:
        source.assumptions.append("messages are put in the order of their times")


def _say_body(source: Source) -> None:
    """Nothing in a bag says how the tracked frame lies in the IMU's."""
    info = source.info
    if "imu_topic" in info and "pose_topic" in info:
        body = info.get("pose_child_frame") or f"of {info['pose_topic']}"
        source.assumptions.append(
            f"the tracked frame ({body}) is taken for the IMU's ({info['imu_frame'] or 'unnamed'}); how it"
            " lies in it is not in the bag: `jaxekf align` finds it"
        )


def _name(path: Path) -> str:
    """A recording's name by its file or folder."""
    path = Path(os.path.abspath(path))  # not resolved: a link's name is the one that was given
    return (path.name if path.is_dir() else path.stem) or "recording"
