"""Bags written here with `rosbags`, of ROS 1 and 2, whole and spoilt, and what is read of them."""

import re
import shutil
import sqlite3
import sys

import numpy as np
import pytest

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.io.importers import ros
from jaxekf.io.streams import encoder
from jaxekf.recordings import screening
from jaxekf.recordings.accounts import Place
from jaxekf.recordings.types import to_scipy
from jaxekf.simulation import attitude_runs

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

# Odd, and above 2^53: through a float it would be even.
START = 1_520_530_308_181_901_469
KINDS = ("bag", "sqlite3", "mcap", "mcap file", "db3 file")
IMU, POSE, POSE_COVARIANCE = (
    "sensor_msgs/msg/Imu",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
TRANSFORM, TREE, JOINT = (
    "geometry_msgs/msg/TransformStamped",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/JointState",
)
TREE_FIELDS = "geometry_msgs/TransformStamped[] transforms\n"


class Maker:
    """Messages of one version of ROS."""

    def __init__(self, kind):
        self.ros1 = kind == "bag"
        stores = typesys.Stores
        self.store = typesys.get_typestore(stores.ROS1_NOETIC if self.ros1 else stores.ROS2_HUMBLE)
        if self.ros1:
            self.store.register(typesys.get_types_from_msg(TREE_FIELDS, TREE))

    def new(self, name, *fields):
        return self.store.types[name](*fields)

    def header(self, time_ns, frame):
        stamp = self.new("builtin_interfaces/msg/Time", *divmod(int(time_ns), 10**9))
        return self.new("std_msgs/msg/Header", *([0] if self.ros1 else []), stamp, frame)

    def vector(self, xyz, name="Vector3"):
        return self.new(f"geometry_msgs/msg/{name}", *map(float, xyz))

    def quaternion(self, q):
        return self.vector(np.roll(q, -1), "Quaternion")

    def imu(self, time_ns, rate, force, frame="imu", absent=()):
        covariance = np.zeros((3, 9))
        covariance[list(absent), 0] = -1.0
        nothing = self.vector((0.0, 0.0, 0.0, 0.0), "Quaternion")
        fields = nothing, covariance[0], self.vector(rate), covariance[1]
        rest = self.vector(force), covariance[2]
        return self.new(IMU, self.header(time_ns, frame), *fields, *rest)

    def pose(self, kind, time_ns, q, p, frame="world", child="tool"):
        header, q = self.header(time_ns, frame), self.quaternion(q)
        if kind in (TRANSFORM, TREE):
            transform = self.new("geometry_msgs/msg/Transform", self.vector(p), q)
            one = self.new(TRANSFORM, header, child, transform)
            return one if kind == TRANSFORM else self.new(TREE, [one])
        pose = self.new("geometry_msgs/msg/Pose", self.vector(p, "Point"), q)
        if kind == POSE_COVARIANCE:
            pose = self.new("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
        return self.new(kind, header, pose)

    def joint(self, time_ns, names, angles):
        none = np.zeros(0)
        return self.new(JOINT, self.header(time_ns, ""), names, np.array(angles), none, none)


def write(folder, kind, topics, make=None):
    """A bag of ``{topic: (type, messages)}``, received 7 ns after their stamps; where it is."""
    make = make or Maker(kind)
    path = folder / ("run.bag" if kind == "bag" else "run")
    if kind == "bag":
        writer = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin["SQLITE3" if kind in ("sqlite3", "db3 file") else "MCAP"]
        writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
    with writer:
        for topic, (name, messages) in topics.items():
            connection = writer.add_connection(topic, name, typestore=make.store)
            for i, message in enumerate(messages):
                serialize = make.store.serialize_ros1 if make.ros1 else make.store.serialize_cdr
                writer.write(connection, START + 7 + 1_000_000 * i, serialize(message, name))
    if kind.endswith("file"):
        suffix = kind.split()[0]
        return shutil.move(path / f"run.{suffix}", folder / f"alone.{suffix}")
    return path


@pytest.fixture(scope="module")
def run():
    motion = attitude_runs.constant_rate_motion(rest_s=0.3)
    record = attitude_runs.recording(
        "run", motion, seed=1, duration_s=1.0, start_ns=START, occlusions=[(0.5, 0.6)]
    )
    force = np.random.default_rng(3).normal(size=record.imu.gyroscope.shape)
    return record.replace(imu=jaxekf.Imu(record.imu.time_ns, record.imu.gyroscope, force))


def angles(run):
    return to_scipy(run.encoder.q_ref_body).as_rotvec()[:, 0]


def topics(run, make, pose=POSE):
    """The run as messages; where the tracker did not see, the quaternion is zero."""
    o, i = run.optical, run.imu
    seen = np.where(o.valid[:, None], o.q_ref_body, 0.0)
    rows = list(zip(i.time_ns, i.gyroscope, i.accelerometer, strict=True))
    poses = list(zip(o.time_ns, seen, o.position, strict=True))
    turned = zip(run.encoder.time_ns, angles(run), strict=True)
    return {
        "/imu/data": (IMU, [make.imu(*row, absent=[0]) for row in rows]),
        "/tracker": (pose, [make.pose(pose, *row) for row in poses]),
        "/joints": (JOINT, [make.joint(t, ["wrist", "elbow"], [9.0, a]) for t, a in turned]),
    }


def imu_bag(folder, count=20, kind="bag", name="/imu", spoil=None):
    """A bag of an IMU alone, 5 ms apart; `spoil` changes the fields of a message by its number."""
    make = Maker(kind)
    messages = []
    for i in range(count):
        said = {"time_ns": START + 5_000_000 * i, "rate": [0.1 * i, 0, 0], "force": [0, 0, 9.8]}
        messages.append(make.imu(**{**said, **(spoil(i) if spoil else {})}))
    return write(folder, kind, {name: (IMU, messages)}, make)


@pytest.mark.parametrize("kind", KINDS)
def test_round_trip(run, tmp_path, kind):
    """Would catch a time through a float, another order of the quaternion, its conjugate, or rows lost."""
    make = Maker(kind)
    path = write(tmp_path, kind, topics(run, make), make)
    again = ros.load(path, joint_name="elbow", axis=[1.0, 0.0, 0.0])
    assert again.name == ("alone" if kind.endswith("file") else "run")
    np.testing.assert_array_equal(again.imu.time_ns, run.imu.time_ns)
    np.testing.assert_array_equal(again.imu.gyroscope, run.imu.gyroscope)
    np.testing.assert_array_equal(again.imu.accelerometer, run.imu.accelerometer)
    o = run.optical
    # Quaternions are scaled to unit norm as of every source.
    expected, _ = screening.optical(Place("run"), o.time_ns, o.q_ref_body, o.position)
    np.testing.assert_array_equal(again.optical.time_ns, o.time_ns)
    np.testing.assert_array_equal(again.optical.valid, o.valid)
    np.testing.assert_array_equal(again.optical.q_ref_body[o.valid], expected.q_ref_body[o.valid])
    np.testing.assert_array_equal(again.optical.position, o.position)
    np.testing.assert_array_equal(again.encoder.time_ns, run.encoder.time_ns)
    q = encoder.joint_attitude(angles(run), {"axis": [1.0, 0.0, 0.0]}, "run")
    turned, _ = screening.encoder(Place("run"), run.encoder.time_ns, q)
    np.testing.assert_array_equal(again.encoder.q_ref_body, turned.q_ref_body)
    np.testing.assert_allclose(turned.q_ref_body, run.encoder.q_ref_body, atol=1e-15)
    account = again.intake["optical"]
    hidden = account.masked["missing tool (zero quaternion)"]
    assert account.rows == len(o.time_ns) and hidden.count == (~o.valid).sum()
    assert account.unit == "sample" and again.intake["imu"].rows == len(run.imu.time_ns)
    assert again.info["pose_frame"] == "world" and again.info["imu_frame"] == "imu"
    said = " ".join(again.info["assumptions"])
    for word in ("header", "rad/s", "m/s^2", "'world'", "x, y, z, w", "elbow"):
        assert word in said
    if kind == "bag":
        saved = jaxekf.load(jaxekf.save(again, tmp_path / "saved"))
        assert saved.info["assumptions"] == again.info["assumptions"]


@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize("pose", [POSE_COVARIANCE, TRANSFORM, TREE])
def test_kinds_of_poses(run, tmp_path, kind, pose):
    """Would catch a field of the wrong name, and a transform tree taken where none was asked for."""
    make = Maker(kind)
    said = topics(run, make, pose)
    if pose == TREE:
        # The tool is one of two frames, in turn.
        other = make.pose(TREE, START, [1.0, 0, 0, 0], [0, 0, 0], child="camera").transforms
        for message in said["/tracker"][1]:
            message.transforms.extend(other)
    path = write(tmp_path, kind, said, make)
    if pose == TREE:
        assert ros.load(path).optical is None
        with pytest.raises(RecordingError, match=r"2 frames: camera, tool.*--child-frame camera"):
            ros.load(path, pose="/tracker")
        with pytest.raises(RecordingError, match=r"expected 'hand' among them"):
            ros.load(path, child_frame="hand")
    again = ros.load(path, child_frame="tool" if pose == TREE else None)
    np.testing.assert_array_equal(again.optical.time_ns, run.optical.time_ns)
    np.testing.assert_array_equal(again.optical.position, run.optical.position)
    assert again.info.get("pose_child_frame", "tool") == "tool"


def test_which_topic(run, tmp_path):
    """Would catch a guess among several topics, or an error that does not say what there is."""
    make = Maker("bag")
    said = topics(run, make)
    path = write(tmp_path, "bag", {**said, "/imu/raw": said["/imu/data"]}, make)
    with pytest.raises(RecordingError, match=r"2 topics for imu: /imu/data .*126\), /imu/raw") as e:
        ros.load(path)
    assert "--imu /imu/data" in str(e.value)
    assert ros.load(path, imu="imu/raw").info["imu_topic"] == "/imu/raw"
    with pytest.raises(RecordingError, match=r"/tracker: got type .*PoseStamped, expected.*Imu"):
        ros.load(path, imu="/tracker")
    with pytest.raises(RecordingError, match=r"/gone: got no such topic.*/joints"):
        ros.load(path, imu="/imu/raw", pose="/gone")
    with pytest.raises(RecordingError, match=r"without the axis.*--axis X Y Z"):
        ros.load(path, imu="/imu/raw", joint="/joints")
    with pytest.raises(RecordingError, match=r"2 joints: wrist, elbow.*--joint-name"):
        ros.load(path, imu="/imu/raw", axis=[1, 0, 0])
    with pytest.raises(RecordingError, match=r"axis = .*not all 0"):
        ros.load(path, axis=[0, 0, 0])
    left = ros.load(path, imu="/imu/raw")
    assert left.encoder is None and "/joints" in " ".join(left.info["assumptions"])
    only = write(tmp_path / "b", "sqlite3", {"/joints": topics(run, Maker("x"))["/joints"]})
    with pytest.raises(RecordingError, match=r"topics of /joints \(.*JointState, 126\), expected"):
        ros.load(only)


@pytest.mark.parametrize("kind", KINDS)
def test_cut_files(tmp_path, kind):
    """Would catch a traceback of the library, or part of a run taken for the whole."""
    path = imu_bag(tmp_path, 2000, kind)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.stem == "run")
    whole = file.read_bytes()
    for share in (0.0, 0.001, 0.02, 0.3, 0.7, 0.99, 0.9999):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(RecordingError, match=r"got .*, expected .*; try ") as found:
            ros.load(path)
        assert "\n" not in str(found.value)
        if share > 0.02:
            assert str(int(share * len(whole))) in str(found.value)
    file.write_text("time,gx\n0.0,1.0\n" * 9)
    with pytest.raises(RecordingError, match=r"cannot be read \(.*(magic|not a database)"):
        ros.load(path)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_cut_description(tmp_path, kind):
    """Would catch a metadata.yaml that still reads, with topics or messages missing."""
    path = imu_bag(tmp_path, kind=kind)
    file = path / "metadata.yaml"
    whole = file.read_text()
    for share in (0.0, 0.2, 0.5, 0.8):
        file.write_text(whole[: int(share * len(whole))])
        with pytest.raises(RecordingError):
            ros.load(path)
    file.write_text(re.sub("message_count: 20", "message_count: 21", whole))
    with pytest.raises(RecordingError, match=r":/imu: got 20 messages.*, expected the 21"):
        ros.load(path)
    file.write_text(re.sub(r"(\n  message_count: )20", r"\g<1>30", whole))
    with pytest.raises(RecordingError, match=r"metadata.yaml: got topics of 20.*the 30"):
        ros.load(path)
    file.unlink()
    with pytest.raises(RecordingError, match=r"without metadata.yaml but with run\..*reindex"):
        ros.load(path)


def test_places_that_hold_no_bag(tmp_path, monkeypatch):
    """Would catch a traceback for what is no bag at all, or where the library is missing."""
    with pytest.raises(RecordingError, match="no such file"):
        ros.load(tmp_path / "run.bag")
    with pytest.raises(RecordingError, match=r"without metadata.yaml, expected"):
        ros.load(tmp_path)
    (tmp_path / "run.csv").write_text("time\n")
    with pytest.raises(RecordingError, match=r"a file 'run.csv', expected a ROS 1 bag"):
        ros.load(tmp_path / "run.csv")
    path = imu_bag(tmp_path)
    with pytest.raises(RecordingError, match="stamps = 'both'"):
        ros.load(path, stamps="both")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(RecordingError, match=r"try pip install 'jaxekf\[ros\]'"):
        ros.load(path)


def test_stamps(tmp_path):
    """Would catch stamps that were never set, or the recorder's times taken without being asked."""
    path = imu_bag(tmp_path, spoil=lambda i: {"time_ns": 0})
    with pytest.raises(
        RecordingError, match=r"run.bag:/imu:header.stamp: got stamps of 0.*--stamps"
    ):
        ros.load(path)
    again = ros.load(path, stamps="receive")
    np.testing.assert_array_equal(again.imu.time_ns, START + 7 + 1_000_000 * np.arange(20))
    assert "recorder" in " ".join(again.info["assumptions"])
    (tmp_path / "b").mkdir()
    path = imu_bag(tmp_path / "b", spoil=lambda i: {"time_ns": 0} if i == 0 else {})
    with pytest.raises(RecordingError, match=r"/imu/header.stamp\[0\]: got a stamp of 0"):
        ros.load(path)


def test_a_few_stamps_that_were_not_set(tmp_path):
    """Would catch a bag of thousands of messages that is refused for one of them, or an account that loses
    it."""
    spoil = lambda i: {"time_ns": 0} if i in (0, 250) else {}  # noqa: E731
    made = ros.load(imu_bag(tmp_path, 400, spoil=spoil))
    kept = np.delete(np.arange(400), [0, 250])
    np.testing.assert_array_equal(made.imu.time_ns, START + 5_000_000 * kept)
    account = made.intake["imu"]
    assert (account.rows, account.dropped["stamp of 0"].count) == (400, 2)
    np.testing.assert_array_equal(account.dropped["stamp of 0"].numbers, [0, 250])
    np.testing.assert_array_equal(account.numbers, kept)
    assert "2 rows are dropped, stamp of 0" in " ".join(account.sentences("imu"))


def test_topics_that_are_not_read(run, tmp_path):
    """Would catch an odometry or a magnetometer that is left out in silence."""
    make = Maker("sqlite3")
    field = "sensor_msgs/msg/MagneticField"
    message = make.new(field, make.header(START, "imu"), make.vector([0, 0.2, 0.4]), np.zeros(9))
    path = write(tmp_path, "sqlite3", {**topics(run, make), "/mag": (field, [message])}, make)
    text = " ".join(ros.load(path).info["assumptions"])
    assert "/mag (sensor_msgs/msg/MagneticField, 1 messages) is not read" in text
    assert "Odometry" not in text


def test_order(tmp_path):
    """Would catch messages sorted in silence, or the wrong one named."""
    path = imu_bag(tmp_path, spoil=lambda i: {"time_ns": START + 5_000_000 * 3.5} if i == 7 else {})
    with pytest.raises(RecordingError, match=r"run.bag:/imu/time\[7\]: got .* s after .*sort"):
        ros.load(path)
    again = ros.load(path, sort=True)
    np.testing.assert_allclose(again.imu.gyroscope[3:6, 0], [0.3, 0.7, 0.4])
    assert "1 rows were out of order" in again.intake["imu"].notes[0]


def test_samples_that_are_not_there(tmp_path):
    """Would catch a NaN, or what a message says to be absent, taken for a measurement."""
    nan = float("nan")
    path = imu_bag(tmp_path, spoil=lambda i: {"rate": [nan, 0, 0]} if i == 3 else {"absent": [0]})
    again = ros.load(path)
    assert again.intake["imu"].masked["not finite"].numbers.tolist() == [3]
    assert len(again.imu.time_ns) == 19
    for folder in "bcd":
        (tmp_path / folder).mkdir()
    path = imu_bag(tmp_path / "b", spoil=lambda i: {"absent": [2]})
    again = ros.load(path)
    assert again.imu.accelerometer is None and len(again.imu.time_ns) == 20
    assert "no linear acceleration" in " ".join(again.info["assumptions"])
    path = imu_bag(tmp_path / "c", spoil=lambda i: {"absent": [2] if i == 5 else []})
    again = ros.load(path)
    assert again.intake["imu"].masked["not finite"].numbers.tolist() == [5]
    assert "1 messages state" in " ".join(again.info["assumptions"])
    path = imu_bag(tmp_path / "d", spoil=lambda i: {"absent": [1]})
    with pytest.raises(RecordingError, match=r"angular_velocity: got messages without it"):
        ros.load(path)


def test_frames_do_not_change(tmp_path):
    """Two sensors on one topic, taken for one."""
    path = imu_bag(tmp_path, spoil=lambda i: {"frame": "other" if i == 4 else "imu"})
    with pytest.raises(RecordingError, match=r"frame_id\[4\]: got 'other' after 'imu'"):
        ros.load(path)


@pytest.mark.parametrize("kind", KINDS)
def test_types_that_nobody_knows(tmp_path, kind):
    """Would catch a bag of which nothing is read because of one type in it."""
    make = Maker(kind)
    own = "lab_msgs/msg/Own"
    make.store.register(typesys.get_types_from_msg("float64 value\n", own))
    imu = [make.imu(START + 5_000_000 * i, [0, 0, 0], [0, 0, 9.8]) for i in range(9)]
    said = {"/own": (own, [make.new(own, 1.0)] * 3), "/imu": (IMU, imu)}
    path = write(tmp_path, kind, said, make)
    file = next(path.glob("*.db3")) if path.is_dir() and kind == "sqlite3" else path
    assert len(ros.load(path).imu.time_ns) == 9
    if file.suffix != ".db3":
        return
    # ROS 2 stores types that it does not find like this.
    with sqlite3.connect(file) as database:
        database.execute(
            "UPDATE message_definitions SET encoding = '', encoded_message_definition = ''"
            " WHERE topic_type = ?",
            (own,),
        )
    database.close()
    again = ros.load(path)
    np.testing.assert_array_equal(again.imu.time_ns, START + 5_000_000 * np.arange(9))


@pytest.mark.parametrize("kind", ["bag", "sqlite3"])
def test_other_definitions(tmp_path, kind):
    """A type of a known name that holds something else, read as if it were the known one."""
    path, store = imu_bag(tmp_path, kind=kind), Maker(kind).store
    known = store.generate_msgdef(IMU)[1] if kind == "bag" else store.hash_rihs01(IMU)
    file = path if kind == "bag" else path / "metadata.yaml"
    other = known[:-8] + "0" * 8
    file.write_bytes(file.read_bytes().replace(known.encode(), other.encode()))
    with pytest.raises(
        RecordingError, match=rf"not the standard one \({other}\), expected {known}"
    ):
        ros.load(path)


def test_poses_that_are_not_there(tmp_path):
    """Would catch a quaternion of NaN or 0, or a position of NaN, taken for a pose."""
    make, nan = Maker("mcap"), float("nan")
    odd = {2: ([nan] * 4, [0] * 3), 5: ([0] * 4, [0] * 3), 6: ([1, 0, 0, 0], [nan, 0, 0])}
    poses = [
        make.pose(POSE, START + 10_000_000 * i, *odd.get(i, ([1, 0, 0, 0], [1, 2, 3])))
        for i in range(9)
    ]
    again = ros.load(write(tmp_path, "mcap", {"/tracker": (POSE, poses)}, make))
    masked = again.intake["optical"].masked
    assert {name: reason.numbers.tolist() for name, reason in masked.items()} == {
        "blank": [2],
        "missing tool (zero quaternion)": [5],
        "position not finite": [6],
    }
    assert np.flatnonzero(~again.optical.valid).tolist() == [2, 5, 6]
    assert again.imu is None and again.encoder is None


def test_last_messages_beside_the_database(tmp_path):
    """A recorder that was killed leaves messages in the write-ahead log: a run that ends early."""
    path = imu_bag(tmp_path, kind="db3 file")
    path.with_name("alone.db3-wal").write_bytes(b"x" * 99)
    with pytest.raises(RecordingError, match=r"still in alone.db3-wal"):
        ros.load(path)
