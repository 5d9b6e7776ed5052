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
from jaxekf.io.importers._ros_messages import IMU, JOINT, POSES, TRANSFORM, TREES, UNREAD, Source
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
    """Read one recording of a bag.

    Parameters
    ----------
    path : path
        A ``.bag`` of ROS 1, the folder of a ROS 2 bag, an ``.mcap`` or a ``.db3``.
    imu, pose, joint : str, optional
        Topics. The only topic of a suitable type is the default; without one, the stream is left out. A
        transform tree (``/tf``) is read only if it or `child_frame` is given, joint angles only if `joint`,
        `joint_name` or `axis` is given.
    child_frame : str, optional
        One of several transforms on a topic.
    joint_name : str, optional
        One of several joints on a topic.
    axis : array (3,), optional
        Axis of the joint in the tracker's reference frame, needed for joint angles: their attitude is
        ``exp(axis angle)``.
    stamps : {"header", "receive"}
        Stamps of the headers, or times at which the recorder received the messages.
    sort : bool
        Sort messages by time that are out of order.

    Returns
    -------
    Recording
        Times in ns, exact; rates in rad/s, specific forces in m/s^2, positions in m, as the messages'
        definitions state; attitude w, x, y, z, tracked frame to ``header.frame_id``. A field whose
        covariance begins with -1 is absent. `info` holds the topics and frames, and in sentences all
        ``assumptions``; `intake` accounts for every message, counted from 0.

    Raises
    ------
    RecordingError
        For a bag that cannot be read, missing or several suitable topics, stamps that are not set or
        decrease, frames that change, and as `jaxekf.recordings.screening` does.
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
        _assume_times(source)
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
    _assume_body(source)
    return Recording(
        _name(path),
        **streams,
        info={**source.info, "assumptions": source.assumptions},
        path=path,
        intake=accounts,
    )


# ---------------------------------------------------------------------------------------------
# Topics


def _choose(
    source: Source,
    imu: str | None,
    pose: str | None,
    child_frame: str | None,
    joint: str | None,
    joint_name: str | None,
    axis: Floats | None,
) -> Mapping[str, Topic | None]:
    """The topic of each stream, None without one; raises if several are suitable."""
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
        got = "no topic of transforms"
        expected = f"one for the frame '{child_frame}'"
        raise RecordingError(bag.path, got, expected, f"a topic of {_listed(bag)}")
    if not any(chosen.values()):
        got = f"topics of {_listed(bag)}"
        hint = "recording such a topic, or naming one of a transform tree (pose='/tf', --pose /tf)"
        raise RecordingError(bag.path, got, f"at least one of {', '.join((IMU, *POSES))}", hint)
    for label, topic in chosen.items():
        if topic is not None:
            source.info[f"{label}_topic"] = topic.name
    left = [t.name for t in bag.topics if t.type == JOINT and t.stated]
    if left and not wants_joint:
        source.assumptions.append(
            f"joint angles ({', '.join(left)}) are not read: the joint's axis was not given (axis)"
        )
    for topic in bag.topics:
        if topic.type in UNREAD and topic.stated:
            described = f"{topic.name} ({topic.type}, {topic.stated} messages)"
            source.assumptions.append(f"{described} is not read: {UNREAD[topic.type]}")
    return chosen


def _topic(bag: Bag, label: str, types: Sequence[str], name: str | None) -> Topic | None:
    """The topic of a name, or the only one with messages of these types."""
    if name is not None:
        of_name = [t for t in bag.topics if t.name.lstrip("/") == name.lstrip("/")]
        found = [t for t in of_name if t.type in types]
        if not found:
            got = f"type {', '.join(t.type for t in of_name)}" if of_name else "no such topic"
            expected = f"a topic of {' or '.join(types)}"
            raise RecordingError(f"{bag.path}:{name}", got, expected, f"a topic of {_listed(bag)}")
    else:
        # Static transforms are no recording of motion.
        found = [t for t in bag.topics if t.type in types and t.stated and t.name != "/tf_static"]
    if len(found) > 1:
        listed = ", ".join(f"{t.name} ({t.type}, {t.stated})" for t in found)
        hint = f"naming it ({label}='{found[0].name}', --{label} {found[0].name})"
        raise RecordingError(bag.path, f"{len(found)} topics for {label}: {listed}", "one", hint)
    return found[0] if found else None


def _listed(bag: Bag) -> str:
    return ", ".join(f"{t.name} ({t.type}, {t.stated})" for t in bag.topics) or "none"


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


def _assume_times(source: Source) -> None:
    header = "times are the headers' stamps, assumed to be the times of measurement"
    receive = "times are those of receipt by the recorder, which are later than the measurements"
    source.assumptions.append(header if source.stamps == "header" else receive)
    if source.sort:
        source.assumptions.append("messages are sorted by time")


def _assume_body(source: Source) -> None:
    """A bag does not state the rotation between tracked frame and IMU."""
    info = source.info
    if "imu_topic" in info and "pose_topic" in info:
        body = info.get("pose_child_frame") or f"of {info['pose_topic']}"
        source.assumptions.append(
            f"the tracked frame ({body}) is assumed to be the IMU's ({info['imu_frame'] or 'unnamed'});"
            " the bag does not state the rotation between them: `jaxekf align` finds it"
        )


def _name(path: Path) -> str:
    """The name of a recording's file or folder."""
    path = Path(os.path.abspath(path))  # not resolved: a link's name is the one that was given
    return (path.name if path.is_dir() else path.stem) or "recording"
