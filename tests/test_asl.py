"""The importer of the ASL layout: EuRoC folders written here, and TUM-VI's real rooms."""

import re

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.io.importers import asl
from jaxekf.recordings.types import to_scipy

IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
POSE_HEADER = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m],"
    " q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)
# Odd, and above 2^53: through a float they would be even.
START = 1_520_530_308_181_901_469
ROOMS = {
    "room1": (28122, 16541, 28),
    "room3": (28124, 15200, 80),
    "room4": (22212, 13075, 36),
}


def transform(vector, translation):
    """A 4x4 matrix by rotation vector and translation."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    matrix[:3, 3] = translation
    return matrix


SENSOR = transform([0.4, -1.1, 2.0], [0.069, -0.0278, -0.124])
IMUS = {"the body": np.eye(4), "elsewhere": transform([-0.7, 0.2, 0.5], [0.02, 0.3, -0.05])}


def sensor_yaml(matrix, sensor_type, more=""):
    rows = ",\n         ".join(", ".join(repr(float(v)) for v in row) for row in matrix)
    return (
        f"#Default sensor yaml file\nsensor_type: {sensor_type}\ncomment: made up\n\nT_BS:\n"
        f"  cols: 4\n  rows: 4\n  data: [{rows}]\n{more}"
    )


def table(header, times, values, separator=","):
    lines = [header] if header else []
    lines += [
        separator.join([str(t), *(repr(float(v)) for v in row)])
        for t, row in zip(times, values, strict=True)
    ]
    return "\n".join(lines) + "\n"


def stream(root, name, text, description=None):
    (root / name).mkdir(parents=True)
    (root / name / "data.csv").write_text(text, encoding="utf-8")
    if description is not None:
        (root / name / "sensor.yaml").write_text(description, encoding="utf-8")
    return root / name


class Motion:
    """A moving IMU (frame I) in the reference R, and what sensors on it report."""

    def __init__(self, count=40):
        rng = np.random.default_rng(7)
        self.time_ns = [START + 5_000_001 * i for i in range(count)]
        self.pose_ns = [START + 3 + 8_333_334 * i for i in range(count)]
        self.imu = rng.normal(size=(count, 6))
        self.matrix = np.array(
            [transform(a, b) for a, b in rng.normal(size=(count, 2, 3))]
        )  # T_R_I at the pose stamps

    def poses(self, sensor=None, imu=None):
        """x y z qw qx qy qz of a sensor with `T_BS`, on a body B in which the IMU has another."""
        t_imu_sensor = np.linalg.inv(np.eye(4) if imu is None else imu) @ (
            np.eye(4) if sensor is None else sensor
        )
        placed = self.matrix @ t_imu_sensor
        q = Rotation.from_matrix(placed[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
        return np.c_[placed[:, :3, 3], q]

    def pose_table(self, header=POSE_HEADER, **frames):
        return table(header, self.pose_ns, self.poses(**frames))

    def imu_table(self):
        return table(IMU_HEADER, self.time_ns, self.imu)

    def write(self, folder, sensor=None, imu=None, pose="vicon0", more=""):
        """A folder in EuRoC's layout, with a sensor.yaml where a frame is given."""
        root = folder / "mav0"
        about = None if imu is None else sensor_yaml(imu, "imu", more)
        stream(root, "imu0", self.imu_table(), about)
        about = None if sensor is None else sensor_yaml(sensor, "pose")
        stream(root, pose, self.pose_table(sensor=sensor, imu=imu), about)
        return folder


@pytest.fixture
def motion():
    return Motion()


@pytest.fixture
def euroc(motion, tmp_path):
    """A good recording, to be spoilt."""
    return motion.write(tmp_path / "V1_01", SENSOR, IMUS["the body"])


def replace_line(file, number, text):
    """Put another text for a line, counted from 1."""
    lines = file.read_text().splitlines()
    lines[number - 1] = text
    file.write_text("\n".join(lines) + "\n")


def angle(q, rotation):
    return (to_scipy(q).inv() * rotation).magnitude()


# ---------------------------------------------------------------------------------------------
# Frames


@pytest.mark.parametrize("imu", IMUS.values(), ids=IMUS)
def test_poses_become_the_imus(motion, tmp_path, imu):
    """Would catch T_BS taken the wrong way round or left out, a tracked point that was moved, and
    extrinsics of the IMU that were ignored."""
    record = asl.load(motion.write(tmp_path / "run", SENSOR, imu))
    optical = record.need_optical()
    assert optical.valid.all()
    assert angle(optical.q_ref_body, Rotation.from_matrix(motion.matrix[:, :3, :3])).max() < 1e-12
    np.testing.assert_array_equal(optical.position, motion.poses(SENSOR, imu)[:, :3])
    assert optical.p_body_tool is not None
    body = motion.matrix[:, :3, 3]
    turned = to_scipy(optical.q_ref_body).apply(optical.p_body_tool)
    np.testing.assert_allclose(optical.position, body + turned, atol=1e-12)
    # What the IMU measured is in its own frame already.
    np.testing.assert_array_equal(record.need_imu().gyroscope, motion.imu[:, :3])
    np.testing.assert_array_equal(record.need_imu().accelerometer, motion.imu[:, 3:])


def test_tracked_point_is_the_translation_of_the_matrix(euroc):
    """Would catch p_body_tool of the inverse transform, which the closed loop above cannot see if
    the attitude is inverted with it."""
    optical = asl.load(euroc).need_optical()
    np.testing.assert_allclose(optical.p_body_tool, SENSOR[:3, 3], atol=1e-15)


def test_matrix_of_five_digits_is_a_rotation(motion, tmp_path):
    """Would catch a tolerance that refuses EuRoC's own calibration."""
    matrix = np.eye(4)
    matrix[:3] = [
        [0.33638, -0.01749, 0.94156, 0.06901],
        [-0.02078, -0.99972, -0.01114, -0.02781],
        [0.94150, -0.01582, -0.33665, -0.12395],
    ]
    optical = asl.load(motion.write(tmp_path / "run", matrix, np.eye(4))).need_optical()
    attitude = Rotation.from_matrix(motion.matrix[:, :3, :3])
    assert angle(optical.q_ref_body, attitude).max() < 1e-4
    np.testing.assert_allclose(np.linalg.norm(optical.q_ref_body, axis=1), 1.0, atol=1e-12)


def test_without_sensor_yaml_every_frame_is_the_body_and_is_said_to_be(motion, tmp_path):
    """Would catch an assumption that is made without saying so."""
    record = asl.load(motion.write(tmp_path / "run"))
    attitude = Rotation.from_matrix(motion.matrix[:, :3, :3])
    assert angle(record.need_optical().q_ref_body, attitude).max() < 1e-12
    np.testing.assert_array_equal(record.need_optical().p_body_tool, np.zeros(3))
    said = "\n".join(record.info["assumptions"])
    for stated in (
        "vicon0: no sensor.yaml",
        "imu0: no sensor.yaml",
        "Hamilton",
        "rad/s",
        "points up",
    ):
        assert stated in said, stated
    described = asl.load(motion.write(tmp_path / "described", SENSOR, np.eye(4)))
    assert "no sensor.yaml" not in "\n".join(described.info["assumptions"])
    assert record.info["gravity_ref"] == [0.0, 0.0, -9.81]


def test_sensor_yaml_without_extrinsics_is_said_to_lack_them(euroc):
    """Would catch a KeyError, or an identity nobody hears of."""
    (euroc / "mav0/vicon0/sensor.yaml").write_text("sensor_type: pose\n")
    record = asl.load(euroc)
    assert any("vicon0: no T_BS" in line for line in record.info["assumptions"])
    np.testing.assert_array_equal(record.need_optical().p_body_tool, np.zeros(3))


# ---------------------------------------------------------------------------------------------
# Columns


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z,q_RS_x [],q_RS_y [],q_RS_z [],q_RS_w []",
         [0, 1, 2, 4, 5, 6, 3]),
        ("# timestamp[ns] qw qx qy qz tx ty tz", [3, 4, 5, 6, 0, 1, 2]),
        ("timestamp,qz,qy,qx,qw,z,y,x", [6, 5, 4, 3, 2, 1, 0]),
    ],
    ids=["w last", "spaces", "backwards"],
)  # fmt: skip
def test_header_gives_the_order(motion, tmp_path, header, order):
    """Would catch quaternions read in EuRoC's order when the file says another."""
    folder = motion.write(tmp_path / "run")
    separator = "," if "," in header else " "
    text = table(header, motion.pose_ns, motion.poses()[:, order], separator)
    (folder / "mav0/vicon0/data.csv").write_text(text)
    record = asl.load(folder)
    attitude = Rotation.from_matrix(motion.matrix[:, :3, :3])
    assert angle(record.need_optical().q_ref_body, attitude).max() < 1e-12
    np.testing.assert_array_equal(record.need_optical().position, motion.poses()[:, :3])


def test_imu_header_gives_the_order(motion, euroc):
    """Would catch an accelerometer taken for the gyroscope."""
    header = (
        "#timestamp [ns],a_x [m s^-2],a_y [m s^-2],a_z [m s^-2],w_x [rad/s],w_y [rad/s],w_z [rad/s]"
    )
    values = motion.imu[:, [3, 4, 5, 0, 1, 2]]
    (euroc / "mav0/imu0/data.csv").write_text(table(header, motion.time_ns, values))
    imu = asl.load(euroc).need_imu()
    np.testing.assert_array_equal(imu.gyroscope, motion.imu[:, :3])
    np.testing.assert_array_equal(imu.accelerometer, motion.imu[:, 3:])


@pytest.mark.parametrize("header", [None, "# the q_w of a test", "# one,two,three,four,5,6,7,8"])
def test_without_names_the_order_is_eurocs_and_is_said_to_be(motion, euroc, header):
    """Would catch a remark taken for column names, or an assumed order nobody hears of."""
    text = table(header, motion.pose_ns, motion.poses(SENSOR))
    (euroc / "mav0/vicon0/data.csv").write_text(text)
    record = asl.load(euroc)
    attitude = Rotation.from_matrix(motion.matrix[:, :3, :3])
    assert angle(record.need_optical().q_ref_body, attitude).max() < 1e-12
    said = [line for line in record.info["assumptions"] if "no header names them" in line]
    assert len(said) == 1 and "vicon0" in said[0] and "qw qx qy qz" in said[0]


def test_headers_between_the_rows(motion, euroc):
    """Would catch files put one after the other whose rows are read by a header not their own."""
    file = euroc / "mav0/vicon0/data.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:9], POSE_HEADER, "# a remark", *lines[9:]]))
    assert asl.load(euroc).need_optical().time_ns.tolist() == motion.pose_ns
    other = "#timestamp,qw,qx,qy,qz,px,py,pz"
    file.write_text("\n".join([*lines[:9], other, *lines[9:]]))
    with pytest.raises(RecordingError, match=r"data.csv:10: got a second header"):
        asl.load(euroc)


def test_estimate_with_velocity_and_biases(motion, tmp_path):
    """Would catch a bias or a velocity taken for a pose, and an estimate passed off as measured."""
    header = POSE_HEADER.replace("#timestamp [ns]", "#timestamp") + "".join(
        f", {name}_{axis} [x]" for name in ("v_RS_R", "b_w_RS_S", "b_a_RS_S") for axis in "xyz"
    )
    folder = motion.write(tmp_path / "run", pose="state_groundtruth_estimate0")
    values = np.c_[motion.poses(), np.random.default_rng(1).normal(size=(40, 9))]
    file = folder / "mav0/state_groundtruth_estimate0/data.csv"
    file.write_text(table(header, motion.pose_ns, values))
    record = asl.load(folder)
    attitude = Rotation.from_matrix(motion.matrix[:, :3, :3])
    assert angle(record.need_optical().q_ref_body, attitude).max() < 1e-12
    assert record.info["pose_kind"] == "estimate"
    assert any("is an estimate" in line for line in record.info["assumptions"])


def test_missing_poses_are_not_valid(motion, euroc):
    """Would catch a hidden tool taken for a pose, or a NaN that reaches the quaternions."""
    rows = [[repr(float(v)) for v in row] for row in motion.poses(SENSOR)]
    rows[2][3:] = ["0"] * 4
    rows[3] = ["nan"] * 7
    rows[5] = [""] * 7
    rows[7][1] = "NaN"
    rows[11][3:] = [str(0.5 * float(v)) for v in rows[11][3:]]
    rows[13][4] = "inf"
    lines = [",".join([str(t), *row]) for t, row in zip(motion.pose_ns, rows, strict=True)]
    (euroc / "mav0/vicon0/data.csv").write_text("\n".join([POSE_HEADER, *lines]))
    optical = asl.load(euroc).need_optical()
    np.testing.assert_array_equal(np.flatnonzero(~optical.valid), [2, 3, 5, 7, 11, 13])
    np.testing.assert_array_equal(optical.q_ref_body[~optical.valid], [[1, 0, 0, 0]] * 6)
    attitude = Rotation.from_matrix(motion.matrix[:, :3, :3])
    assert angle(optical.q_ref_body, attitude)[optical.valid].max() < 1e-12


# ---------------------------------------------------------------------------------------------
# Times


def test_stamps_are_exact(motion, euroc):
    """Would catch stamps that pass through a float, whose nearest ones are 256 ns apart."""
    record = asl.load(euroc)
    assert record.need_imu().time_ns.tolist() == motion.time_ns
    assert record.need_optical().time_ns.tolist() == motion.pose_ns


def test_stamps_with_a_point_are_read_where_they_are_whole(motion, euroc):
    """Would catch a refusal of what is exact, or a detour by a float for it."""
    file = euroc / "mav0/imu0/data.csv"
    row = "," + ",".join(map(str, range(6)))
    replace_line(file, 2, f"{START}.000{row}")
    replace_line(file, 3, f"1.520530308186901470e18{row}")
    assert asl.load(euroc).need_imu().time_ns[:2].tolist() == [START, START + 5_000_001]


@pytest.mark.parametrize(
    ("cell", "hint"),
    [
        ("1520530308.1819015", "without a fraction"),
        ("1520530308181901469.5", "without a fraction"),
        ("1.5205303081819e+18", "was rounded"),
        ("nan", "without a fraction"),
        ("", "correcting the cell"),
        ("yesterday", "correcting the cell"),
        ("99999999999999999999", "removing the row"),
    ],
)
def test_stamps_that_are_not_whole_nanoseconds(euroc, cell, hint):
    """Would catch seconds, rounded stamps or words taken for nanoseconds."""
    replace_line(euroc / "mav0/imu0/data.csv", 4, f"{cell},0,0,0,0,0,9.8")
    with pytest.raises(RecordingError, match=rf"data.csv:4:time: got '{re.escape(cell)}'.*{hint}"):
        asl.load(euroc)


def test_repeated_rows_are_dropped_and_counted(motion, euroc):
    """Would catch a duplicate that stops the import, is kept, or is dropped in silence."""
    file = euroc / "mav0/vicon0/data.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:6], lines[5], lines[5], *lines[6:], lines[2]]))
    record = asl.load(euroc)
    assert record.info["duplicate_rows"] == {"imu": 0, "optical": 3}
    assert record.need_optical().time_ns.tolist() == motion.pose_ns


@pytest.mark.parametrize(("line", "other"), [(6, 5), (9, 4)], ids=["same stamp", "backwards"])
def test_stamps_that_do_not_increase(euroc, line, other):
    """Would catch a second value for one time, or time running backwards; and a line number that
    forgets the header and the duplicates dropped before it."""
    file = euroc / "mav0/imu0/data.csv"
    lines = file.read_text().splitlines()
    stamp = lines[other - 1].split(",")[0]
    lines[line - 1] = f"{stamp},9,9,9,9,9,9"
    file.write_text("\n".join([lines[0], lines[1], "", *lines[1:]]))
    with pytest.raises(RecordingError, match=rf"data.csv:{line + 2}:time: got {stamp} after"):
        asl.load(euroc)


# ---------------------------------------------------------------------------------------------
# Which streams


def layout(motion, root, names):
    """Streams with poses that tell which is which: x is the number of the stream."""
    stream(root, "imu0", motion.imu_table())
    for number, (name, sensor_type) in enumerate(names):
        poses = motion.poses()
        poses[:, 0] = number
        about = sensor_type and f"sensor_type: {sensor_type}\n"
        stream(root, name, table(POSE_HEADER, motion.pose_ns, poses), about)


PREFERENCES = [
    [("vicon0", "pose"), ("mocap0", None), ("state_groundtruth_estimate0", None)],
    [("mocap0", "visual-inertial"), ("another0", "pose"), ("state_groundtruth_estimate0", None)],
    [("tracker2", "pose"), ("tracker10", "pose"), ("another", "visual-inertial")],
    [("vicon1", None), ("state_groundtruth_estimate0", "visual-inertial")],
    [("state_groundtruth_estimate0", "camera"), ("a_slam0", "visual-inertial")],
    [("slam0", "visual-inertial"), ("leica0", "position"), ("cam0", "camera")],
]


@pytest.mark.parametrize("names", PREFERENCES, ids=lambda names: names[0][0])
def test_measured_poses_are_preferred(motion, tmp_path, names):
    """Would catch an estimate taken where poses were measured, or the alphabet deciding."""
    layout(motion, tmp_path / "run/mav0", names)
    record = asl.load(tmp_path / "run")
    assert record.info["pose_stream"] == names[0][0]
    np.testing.assert_array_equal(record.need_optical().position[:, 0], 0.0)
    named = asl.load(tmp_path / "run", pose=names[1][0])
    assert named.info["pose_stream"] == names[1][0]
    np.testing.assert_array_equal(named.need_optical().position[:, 0], 1.0)


def test_any_name_of_the_imu(motion, tmp_path):
    """Would catch a sensor_type that is not read."""
    folder = motion.write(tmp_path / "run", SENSOR, np.eye(4))
    (folder / "mav0/imu0").rename(folder / "mav0/adis")
    record = asl.load(folder)
    assert record.info["imu_stream"] == "adis"
    np.testing.assert_array_equal(record.need_imu().gyroscope, motion.imu[:, :3])


def test_ways_to_name_a_recording(motion, euroc, tmp_path):
    """Would catch a layout that cannot be given, or a run that is called mav0 or data."""
    names = {path: asl.load(path).name for path in (euroc, euroc / "mav0", str(euroc))}
    assert set(names.values()) == {"V1_01"}
    flat = tmp_path / "flat"
    flat.mkdir()
    (flat / "room1_imu.txt").write_text(motion.imu_table())
    (flat / "room1_mocap.csv").write_text(motion.pose_table())
    for path in (flat, flat / "room1"):
        assert asl.load(path).need_optical().time_ns.tolist() == motion.pose_ns
        assert asl.load(path).name == "room1"
    mixed = asl.load(imu=flat / "room1_imu.txt", pose=euroc / "mav0/vicon0")
    assert mixed.name == "room1"
    attitude = Rotation.from_matrix(motion.matrix[:, :3, :3])
    assert angle(mixed.need_optical().q_ref_body, attitude).max() < 1e-12
    assert asl.load(imu=euroc / "mav0/imu0", pose=flat / "room1_mocap.csv").name == "V1_01"
    assert asl.load("other", imu=euroc / "mav0/imu0", pose=flat / "room1_mocap.csv").name == "other"


def test_find_lists_what_load_takes(motion, tmp_path):
    """Would catch room10 before room2, an overlooked layout, and what has no poses or no IMU."""
    for name in ("room10", "room2"):
        (tmp_path / f"{name}_imu.txt").write_text(motion.imu_table())
        (tmp_path / f"{name}_mocap.csv").write_text(motion.pose_table())
    (tmp_path / "room3_imu.txt").write_text(motion.imu_table())
    motion.write(tmp_path / "machine" / "MH_2")
    motion.write(tmp_path / "machine" / "MH_11")
    motion.write(tmp_path / "bare")
    for child in (tmp_path / "bare/mav0").iterdir():
        child.rename(tmp_path / "bare" / child.name)
    (tmp_path / "bare/mav0").rmdir()
    stream(tmp_path / "no_poses/mav0", "imu0", motion.imu_table())
    stream(tmp_path / "no_poses/mav0", "leica0", "0,0,0,0\n")
    stream(tmp_path / "no_imu/mav0", "vicon0", motion.pose_table())
    stream(tmp_path, "notes", "not,a,stream\n")
    found = asl.find(tmp_path)
    wanted = ["bare", "machine/MH_2", "machine/MH_11", "room2", "room10"]
    assert [path.relative_to(tmp_path).as_posix() for path in found] == wanted
    assert [asl.load(path).name for path in found] == [name.split("/")[-1] for name in wanted]


# ---------------------------------------------------------------------------------------------
# sensor.yaml


def test_noise_and_opencv_dialect(motion, tmp_path):
    """Would catch numbers that YAML takes for text (2e-3), OpenCV's first line and its tags."""
    more = (
        "rate_hz: 200\ngyroscope_noise_density: 1.6968e-04 # rad/s/sqrt(Hz)\n"
        "gyroscope_random_walk: 2e-5\naccelerometer_noise_density: 0.0\n"
    )
    folder = motion.write(tmp_path / "run", SENSOR, np.eye(4), more=more)
    noise = asl.load(folder).info["imu_noise"]
    expected = {"gyroscope_noise_density": 1.6968e-4, "gyroscope_random_walk": 2e-5}
    assert noise == expected | {"accelerometer_noise_density": 0.0}
    file = folder / "mav0/vicon0/sensor.yaml"
    text = "%YAML:1.0\n---\n" + file.read_text().replace("T_BS:", "T_BS: !!opencv-matrix")
    file.write_text(text.replace("0.069", "69e-3"))
    optical = asl.load(folder).need_optical()
    np.testing.assert_allclose(optical.p_body_tool, SENSOR[:3, 3], atol=1e-15)
    plain = motion.write(tmp_path / "plain", SENSOR, np.eye(4))
    assert "imu_noise" not in asl.load(plain).info


def spoilt(change):
    matrix = SENSOR.copy()
    change(matrix)
    return matrix


def _mirror(matrix):
    matrix[:, 0] *= -1


def _stretch(matrix):
    matrix[:3, :3] *= 1.01


def _perspective(matrix):
    matrix[3, 0] = 0.1


def _lose(matrix):
    matrix[0, 3] = np.nan


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_mirror, "a reflection"),
        (_stretch, "0.02 from it, expected a rotation"),
        (_perspective, r"last row \[0.1"),
        (_lose, "not finite"),
    ],
)
@pytest.mark.parametrize("name", ["imu0", "vicon0"])
def test_extrinsics_that_are_no_rigid_motion(euroc, name, change, message):
    """Would catch a calibration that mirrors, scales or loses the frame it describes."""
    text = sensor_yaml(spoilt(change), "any").replace("nan", ".nan")
    (euroc / "mav0" / name / "sensor.yaml").write_text(text)
    with pytest.raises(RecordingError, match=rf"{name}.sensor.yaml:T_BS: got .*{message}"):
        asl.load(euroc)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("T_BS:\n  data: [1, 0, 0, 0]\n", "T_BS: got .*16 numbers"),
        ("T_BS:\n  cols: 4\n", "T_BS: got .*16 numbers"),
        ("T_BS: none\n", "T_BS: got 'none'.*16 numbers"),
        ("a: 1\nb: [1, 2\nc: 3\n", "sensor.yaml:3: got text that is not YAML"),
        ("when: 2020-13-45\n", "text that is not YAML"),
        ("- a\n- b\n", "expected keys and values"),
        ("gyroscope_random_walk: -1.0\n", "gyroscope_random_walk: got -1.0"),
        ("accelerometer_noise_density: small\n", "accelerometer_noise_density: got 'small'"),
        ("gyroscope_noise_density: .inf\n", "gyroscope_noise_density: got inf"),
    ],
)
def test_sensor_yaml_that_cannot_be_used(euroc, text, message):
    """Would catch PyYAML's or NumPy's own traceback, and noise that cannot be."""
    (euroc / "mav0/imu0/sensor.yaml").write_text(text)
    with pytest.raises(RecordingError, match=message):
        asl.load(euroc)


# ---------------------------------------------------------------------------------------------
# Faults


@pytest.mark.parametrize(
    ("name", "line", "text", "message"),
    [
        ("imu0", 5, f"{START + 15_000_003},0,0,oops,0,0,0", r"csv:5:w_RS_S_z: got 'oops'"),
        ("imu0", 5, f"{START + 15_000_003},0,0,0,0,0", r"csv:5: got 6 cells, expected 7"),
        ("imu0", 5, f"{START + 15_000_003},0,0,0,0,,0", r"csv:5:a_RS_S_y: got ''"),
        ("imu0", 5, f"{START + 15_000_003},0,0,0,inf,0,0", r"csv:5:a_RS_S_x: got inf"),
        ("vicon0", 5, f"{START + 25_000_005},0,0,0,?,0,0,0", r"csv:5:q_RS_w: got '\?'"),
        ("vicon0", 1, POSE_HEADER.replace("q_RS_w", "s"), "csv:1: got a header without qw"),
        ("vicon0", 1, POSE_HEADER.replace("q_RS_w", "q_RS_x"), "q_RS_x and q_RS_x.*one for qx"),
        ("vicon0", 1, POSE_HEADER + ",error", "csv:1: got a header of 9 columns over rows of 8"),
        ("vicon0", 1, POSE_HEADER.replace("[m]", "[mm]"), "csv:1:px: got the unit mm"),
        ("vicon0", 1, POSE_HEADER.replace("[ns]", "[s]"), "csv:1:time: got the unit s"),
        ("imu0", 1, IMU_HEADER.replace("rad", "deg"), "csv:1:wx: got the unit degs"),
        ("imu0", 1, IMU_HEADER.replace("m s^-2", "g"), "csv:1:ax: got the unit g"),
    ],
)
def test_faults_are_named_by_their_place(euroc, name, line, text, message):
    """Would catch a fault that is swallowed, or found without its line and column."""
    replace_line(euroc / "mav0" / name / "data.csv", line, text)
    with pytest.raises(RecordingError, match=message):
        asl.load(euroc)


def test_files_that_are_no_tables(euroc):
    """Would catch NumPy's own traceback for an empty or a binary file."""
    file = euroc / "mav0/vicon0/data.csv"
    file.write_text(POSE_HEADER + "\n\n")
    with pytest.raises(RecordingError, match="0 samples"):
        asl.load(euroc)
    file.write_bytes(b"\xff\xfe\x00#\x81")
    with pytest.raises(RecordingError, match="UTF-16"):
        asl.load(euroc)


def test_position_alone_is_not_enough(motion, tmp_path):
    """Would catch a laser tracker's positions taken for poses, or a message that does not help."""
    root = tmp_path / "MH_01/mav0"
    stream(root, "imu0", motion.imu_table())
    header = POSE_HEADER[: POSE_HEADER.index(", q_RS_w")].rstrip(",")
    text = table(header, motion.pose_ns, motion.poses()[:, :3])
    stream(root, "leica0", text, "sensor_type: position\n")
    with pytest.raises(RecordingError, match=r"leica0 \(position\).*vicon0.*pose=PATH"):
        asl.load(tmp_path / "MH_01")
    with pytest.raises(
        RecordingError, match=r"leica0.data.csv:2: got 4 cells, expected at least 8"
    ):
        asl.load(tmp_path / "MH_01", pose="leica0")


def test_places_that_hold_no_recording(motion, tmp_path):
    """Would catch a traceback, or a guess, where nothing or too much is found."""
    with pytest.raises(RecordingError, match=r"no such folder.*asl.find"):
        asl.load(tmp_path / "nothing")
    with pytest.raises(RecordingError, match="no stream"):
        asl.load(tmp_path)
    with pytest.raises(RecordingError, match="no such folder"):
        asl.find(tmp_path / "nothing")
    assert asl.find(tmp_path) == []
    for name in ("a", "b"):
        (tmp_path / f"{name}_imu.csv").write_text(motion.imu_table())
        (tmp_path / f"{name}_mocap.txt").write_text(motion.pose_table())
    with pytest.raises(RecordingError, match=r"2 recordings \(a, b\)"):
        asl.load(tmp_path)
    with pytest.raises(RecordingError, match="got a file"):
        asl.load(tmp_path / "a_imu.csv")
    with pytest.raises(RecordingError, match="both imu= and pose="):
        asl.load(imu=tmp_path / "a_imu.csv")
    with pytest.raises(RecordingError, match="no such stream"):
        asl.load(tmp_path / "a", pose="vicon0")
    stream(tmp_path / "c/mav0", "vicon0", motion.pose_table())
    with pytest.raises(RecordingError, match=r"only vicon0 \(measured\).*imu0.*imu=PATH"):
        asl.load(tmp_path / "c")


def test_can_be_saved(motion, euroc, tmp_path):
    """Would catch facts in `info` that recording.toml cannot hold."""
    record = asl.load(euroc)
    again = jaxekf.load(jaxekf.save(record, tmp_path / "saved"))
    assert again.info["assumptions"] == record.info["assumptions"]
    assert again.info["pose_stream"] == "vicon0"
    np.testing.assert_array_equal(again.need_optical().time_ns, motion.pose_ns)


# ---------------------------------------------------------------------------------------------
# Real recordings


@pytest.fixture(scope="module", params=ROOMS)
def room(request, data_dir):
    if not (data_dir / "tumvi").is_dir():
        pytest.skip("no TUM-VI rooms beside the project")
    return asl.load(data_dir / "tumvi" / request.param)


def seconds(time_ns, first):
    return (time_ns - first) * 1e-9


def test_rooms_are_read_whole(room):
    """Would catch rows lost or added, times not in nanoseconds, and gaps that were filled."""
    imu, optical = room.need_imu(), room.need_optical()
    samples, poses, gaps = ROOMS[room.name]
    assert (len(imu.time_ns), len(optical.time_ns)) == (samples, poses)
    assert optical.valid.all()
    assert room.info["duplicate_rows"] == {"imu": 0, "optical": 0}
    step = np.diff(optical.time_ns)
    assert 1e9 / np.median(np.diff(imu.time_ns)) == pytest.approx(200.0, rel=0.01)
    assert 1e9 / np.median(step) == pytest.approx(120.0, rel=0.01)
    assert np.sum(step > 1.5e9 / 120.0) == gaps
    assert not any("no header" in line for line in room.info["assumptions"])


def test_rooms_turn_as_the_gyroscope_says(room):
    """Would catch another order of the quaternion (correlations below 0.3), or its conjugate."""
    imu, optical = room.need_imu(), room.need_optical()
    first, lag = imu.time_ns[0], 6
    at, time = seconds(optical.time_ns, first), seconds(imu.time_ns, first)
    swept = cumulative_trapezoid(imu.gyroscope, time, axis=0, initial=0.0)
    swept = np.stack([np.interp(at, time, column) for column in swept.T], axis=1)
    begin, end = at[:-lag], at[lag:]
    good = (end - begin < (lag + 0.5) / 120.0) & (begin > 0.0) & (end < time[-1])
    attitude = to_scipy(optical.q_ref_body)
    turned = (attitude[:-lag].inv() * attitude[lag:]).as_rotvec()[good]
    rated = (swept[lag:] - swept[:-lag])[good]
    for axis in range(3):
        assert np.corrcoef(turned[:, axis], rated[:, axis])[0, 1] > 0.95
    residual, motion = (
        np.median(np.linalg.norm(value, axis=1)) for value in (turned - rated, rated)
    )
    assert residual < 0.1 * motion


def test_rooms_weigh_upwards(room):
    """Would catch a reference whose z is not up, an accelerometer of other columns or frame."""
    imu, optical = room.need_imu(), room.need_optical()
    first = imu.time_ns[0]
    at, time = seconds(optical.time_ns, first), seconds(imu.time_ns, first)
    force = np.stack([np.interp(at, time, column) for column in imu.accelerometer.T], axis=1)
    mean = to_scipy(optical.q_ref_body).apply(force).mean(axis=0)
    np.testing.assert_allclose(mean + room.info["gravity_ref"], 0.0, atol=0.2)


def test_find_lists_the_rooms(data_dir):
    """Would catch a pair of real files that goes unnoticed."""
    if not (data_dir / "tumvi").is_dir():
        pytest.skip("no TUM-VI rooms beside the project")
    assert [path.name for path in asl.find(data_dir / "tumvi")] == list(ROOMS)


@pytest.mark.parametrize("up", [[0.0, 0.0, 9.81], [0.0, 9.81, 0.0], [0.0, 0.0, 1.0]])
def test_gravity_is_as_assumed(tmp_path, up):
    """A reference whose y points up, or an accelerometer in g, taken for what the layout assumes: the
    estimate would fall by metres."""
    times = [START + 5_000_000 * i for i in range(400)]
    root = tmp_path / "V1_01" / "mav0"
    stream(root, "imu0", table(IMU_HEADER, times, np.tile([0.0, 0.0, 0.0, *up], (400, 1))))
    still = np.tile([1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0], (200, 1))
    stream(root, "vicon0", table(POSE_HEADER, times[::2], still))
    if up[2] > 9.0:
        assert asl.load(root).info["gravity_ref"] == [0.0, 0.0, -9.81]
        return
    with pytest.raises(RecordingError, match=r"gravity vector of .* z points up"):
        asl.load(root)
