"""Messages of a bag's topics as streams: stamps, numbers and frames, screened by
`jaxekf.recordings.screening`."""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers._bags import Bag, Topic
from jaxekf.io.streams import encoder as encoder_storage
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Intake, Place, Reason
from jaxekf.recordings.types import NANOSECONDS, Encoder, Flags, Floats, Imu, Optical, Times

IMU = "sensor_msgs/msg/Imu"
JOINT = "sensor_msgs/msg/JointState"
POSE, POSE_COVARIANCE, TRANSFORM = (
    f"geometry_msgs/msg/{name}"
    for name in ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
)
TREES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSES = (POSE, POSE_COVARIANCE, TRANSFORM)
UNREAD = {
    "nav_msgs/msg/Odometry": "a pose to read is needed as PoseStamped or PoseWithCovarianceStamped",
    "sensor_msgs/msg/MagneticField": "the magnetometer can be added to imu.csv as mx,my,mz",
}
"""Types with data that models could use, but that are not read, and a remedy."""
SET_CLOCK_NS = 10**18
"""Later times (September 2001) are those of a clock that was set; a stamp of 0 among them is missing."""
_FEW_UNSET = 0.01
"""Share of messages without a stamp that are dropped; more of them are a fault of the driver."""


@dataclass(frozen=True)
class Source:
    """An open bag with the options of the import, and the facts and assumptions collected on the way."""

    bag: Bag
    stamps: str
    sort: bool
    info: dict[str, Any] = field(default_factory=dict)
    assumptions: list[str] = field(default_factory=list)


class TopicSamples:
    """Samples of a topic: times, numbers, and frames that may not change."""

    def __init__(
        self, source: Source, topic: Topic, part: str = "", *, one_frame: bool = True
    ) -> None:
        self._one_frame = one_frame
        self.place = Place(source.bag.place(topic) + (f":{part}" if part else ""))
        self.frame = ""
        self._times, self._values = array("q"), array("d")
        self._receive = source.stamps == "receive"
        self._unset: Reason | None = None

    def __len__(self) -> int:
        return len(self._times)

    def add(self, header: Any, received: int, values: Sequence[float]) -> None:
        """One sample."""
        frame = header.frame_id
        if frame != self.frame:
            if self._times and self._one_frame:
                got = f"'{frame}' after '{self.frame}'"
                hint = "recording each on a topic of its own"
                raise self.place.error(len(self), "frame_id", got, "one frame", hint)
            self.frame = frame
        stamp = header.stamp
        self._times.append(received if self._receive else stamp.sec * NANOSECONDS + stamp.nanosec)
        self._values.extend(values)

    def arrays(self, width: int) -> tuple[Times, Floats]:
        """Times (N,) and numbers (N, width) of the messages with a stamp; raises without samples, or if
        more than a few stamps were not set."""
        if not self._times:
            raise self.place.error(None, None, "0 messages", "at least one", "recording again")
        time_ns = np.array(self._times, np.int64)
        values = np.array(self._values, float).reshape(len(time_ns), width)
        unset = time_ns == 0
        if self._receive or not unset.any() or (not unset.all() and time_ns.max() <= SET_CLOCK_NS):
            return time_ns, values
        count, every = int(unset.sum()), bool(unset.all())
        if count > _FEW_UNSET * len(time_ns):
            raise self.place.error(
                None if every else int(np.argmax(unset)),
                "header.stamp",
                "stamps of 0 in every header" if every else f"a stamp of 0, one of {count}",
                "stamps that are set",
                "stamps='receive' (--stamps receive) for the times of receipt by the recorder",
            )
        good = np.flatnonzero(~unset)
        # In an account a message has the time of the one after it.
        after = good[np.minimum(np.searchsorted(good, np.flatnonzero(unset)), len(good) - 1)]
        self._unset = screening.reasoned(self.place, np.flatnonzero(unset), time_ns[after])
        self.place = self.place.take(good)
        return time_ns[~unset], values[~unset]

    def closed(self, account: Intake) -> Intake:
        """The account of the stream with the messages that were dropped for their stamp."""
        if self._unset is None:
            return account
        dropped = {**account.dropped, "stamp of 0": self._unset}
        return replace(account, rows=account.rows + self._unset.count, dropped=dropped)


def imu(source: Source, topic: Topic) -> tuple[Imu, Intake]:
    """Gyroscope and accelerometer of a topic of `IMU`."""
    rows = TopicSamples(source, topic)
    for received, message in source.bag.messages(topic):
        rate, force = message.angular_velocity, message.linear_acceleration
        known = message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0]
        rows.add(
            message.header, received, (rate.x, rate.y, rate.z, force.x, force.y, force.z, *known)
        )
    time_ns, values = rows.arrays(8)
    rate, force, absent = values[:, :3], values[:, 3:6], values[:, 6:] == -1.0
    if absent[:, 0].all():
        got = "messages without it (their covariance begins with -1)"
        expected = "angular rates"
        raise rows.place.error(None, "angular_velocity", got, expected, "the topic of another IMU")
    rate[absent[:, 0]] = np.nan
    source.info["imu_frame"] = rows.frame
    name = f"{topic.name}: "
    if absent[:, 1].all():
        force = None
        source.assumptions.append(
            f"{name}the messages state that they hold no linear acceleration (covariance -1)"
        )
    else:
        force[absent[:, 1]] = np.nan
    _assume_absent(source, topic, absent)
    source.assumptions.append(
        f"{name}angular_velocity is rad/s and linear_acceleration m/s^2, gravity included, in"
        f" '{rows.frame}'; orientation and covariances are not read"
    )
    stream, account = screening.imu(rows.place, time_ns, rate, force, sort=source.sort)
    return stream, rows.closed(account)


def _assume_absent(source: Source, topic: Topic, absent: Flags) -> None:
    for column, quantity in enumerate(("angular velocity", "linear acceleration")):
        count = int(absent[:, column].sum())
        if 0 < count < len(absent):
            source.assumptions.append(
                f"{topic.name}: {count} messages state that they hold no {quantity} (covariance -1) and are"
                " left out"
            )


def _poses(message: Any, kind: str) -> list[tuple[Any, str, Any, Any]]:
    """Header, child frame ('' without one), position and quaternion of each pose in a message."""
    if kind == POSE:
        return [(message.header, "", message.pose.position, message.pose.orientation)]
    if kind == POSE_COVARIANCE:
        pose = message.pose.pose
        return [(message.header, "", pose.position, pose.orientation)]
    several = [message] if kind == TRANSFORM else message.transforms
    return [
        (t.header, t.child_frame_id, t.transform.translation, t.transform.rotation) for t in several
    ]


def optical(source: Source, topic: Topic, child: str | None) -> tuple[Optical, Intake]:
    """Poses of a topic of `POSES` or `TREES`, of one child frame."""
    rows = TopicSamples(source, topic, child or "")
    frames: dict[str, None] = {}
    for received, message in source.bag.messages(topic):
        for header, name, p, q in _poses(message, topic.type):
            frames[name] = None
            if child is not None and name.lstrip("/") != child.lstrip("/"):
                continue
            if child is None and len(frames) > 1:
                continue
            rows.add(header, received, (q.w, q.x, q.y, q.z, p.x, p.y, p.z))
    if (child is None and len(frames) > 1) or (child is not None and frames and not len(rows)):
        got = f"{len(frames)} frames: {', '.join(sorted(frames))}"
        expected = "one" if child is None else f"'{child}' among them"
        hint = f"naming it (child_frame='{min(frames)}', --child-frame {min(frames)})"
        raise rows.place.error(None, "child_frame_id", got, expected, hint)
    time_ns, values = rows.arrays(7)
    source.info["pose_frame"] = rows.frame
    if tracked := child or "".join(frames):
        source.info["pose_child_frame"] = tracked
    source.assumptions.append(
        f"{topic.name}: positions are m; orientations turn the tracked frame"
        f"{f' {tracked!r}' if tracked else ''} to '{rows.frame}', the reference; x, y, z, w in the"
        " messages; covariances are not read"
    )
    pose = values[:, :4], values[:, 4:]
    stream, account = screening.optical(rows.place, time_ns, *pose, sort=source.sort)
    return stream, rows.closed(account)


def encoder(
    source: Source, topic: Topic, name: str | None, axis: Floats | None
) -> tuple[Encoder, Intake]:
    """Attitude by the angle of one joint of a topic of `JOINT`."""
    bag = source.bag
    if axis is None:
        got = "joint angles without the axis they turn about"
        expected = "its direction in the tracker's reference frame"
        raise RecordingError(bag.place(topic), got, expected, "axis=[x, y, z] (--axis X Y Z)")
    rows = TopicSamples(source, topic, name or "", one_frame=False)  # a joint is in none
    joints: dict[str, None] = {}
    for received, message in bag.messages(topic):
        joints.update(dict.fromkeys(message.name))
        chosen = name if name is not None else next(iter(joints), None)
        if chosen not in message.name:
            continue
        at = message.name.index(chosen)
        angle = message.position[at] if at < len(message.position) else np.nan
        rows.add(message.header, received, (angle,))
    if name not in joints if name is not None else len(joints) > 1:
        got = f"{len(joints)} joints: {', '.join(joints) or 'none'}"
        expected = "one" if name is None else f"'{name}' among them"
        hint = "naming one of them (joint_name=, --joint-name)"
        raise rows.place.error(None, "name", got, expected, hint)
    time_ns, values = rows.arrays(1)
    turned = name or next(iter(joints))
    source.info.update(joint=turned, joint_axis=axis.tolist())
    source.assumptions.append(
        f"{topic.name}: position of '{turned}' is rad about the axis {axis.tolist()}, fixed in the"
        " tracker's reference frame; at angle 0 body and reference agree"
    )
    known = np.isfinite(values[:, 0])
    if not known.any():
        raise rows.place.error(
            None, "position", "no finite angle", "angles in rad", "the topic of another joint"
        )
    angle = np.where(known, values[:, 0], 0.0)
    q = encoder_storage.joint_attitude(angle, {"axis": axis.tolist()}, bag.path)
    q[~known] = np.nan
    stream, account = screening.encoder(rows.place, time_ns, q, sort=source.sort)
    return stream, rows.closed(account)
