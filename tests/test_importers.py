"""Files of other programs: NDI, Motive, Vicon and RepoIMU exports written here, and real recordings."""

import gzip
import inspect
import json
import os
from functools import partial

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.io import savemat

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.calibration.alignment import align
from jaxekf.cli import main
from jaxekf.cli.imports import import_run
from jaxekf.io.importers import asl, broad, formats, ndi, optitrack, repoimu, vicon
from jaxekf.recordings.types import Optical

HALF = 0.70710678
LOST = "-3.697314E28"


@pytest.fixture
def write(tmp_path):
    """Write lines to a file of this name, and return its path."""

    def put(lines, name="take.csv", end="\n"):
        path = tmp_path / name
        path.write_text("\n".join(lines) + end, encoding="utf-8")
        return path

    return put


def reasons(account):
    """Lines of what was masked and what was dropped, by reason."""
    return {
        name: reason.numbers.tolist()
        for name, reason in [*account.masked.items(), *account.dropped.items()]
    }


def closes(account, optical):
    """Every row of the source is in the stream, used or masked, or dropped."""
    dropped = sum(reason.count for reason in account.dropped.values())
    masked = sum(reason.count for reason in account.masked.values())
    assert account.rows == len(optical.time_ns) + dropped
    assert optical.valid.sum() == account.rows - dropped - masked


# ---------------------------------------------------------------------------------------------
# NDI

TOOLS = [
    "Tools,Port 1: Probe,Frame,Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,Markers,State,Tx,Ty,Tz,"
    "Port 2: Reference,Frame,Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error",
    *(
        f"2,,{600 + i},0,{state},{pose},1,OK,9,9,9,,{600 + i},0,OK,1,0,0,0,5,6,7,0.2"
        for i, (state, pose) in enumerate(
            [
                ("OK", f"{HALF},0,0,{HALF},10,-20,-1500.5,0.25"),
                ("OK", f"{HALF},0,0,{HALF},11,-20,-1500.5,0.25"),
                ("Missing", ",,,,,,,"),
                ("Partially out of volume", f"{HALF},0,0,{HALF},12,-20,-1500.5,0.3"),
                ("OK", "1,0,0,0,0,0,0,0"),
                ("OK", f"{LOST},{LOST},{LOST},{LOST},{LOST},{LOST},{LOST},{LOST}"),
                ("31", "0,0,0,0,0,0,0,0"),
                ("ok", ",,,,,,,"),
            ]
        )
    ),
]


def test_ndi_tools_side_by_side(write):
    """The other tool's columns or a marker's taken for the tool's, millimetres for metres, a lost tool for
    a pose, and frame numbers for seconds."""
    path = write(TOOLS)
    recording = ndi.load(path, tool="probe")
    optical, account = recording.need_optical(), recording.intake["optical"]
    assert reasons(account) == {
        "status missing": [4],
        "status partially out of volume": [5],
        "identity at the origin": [6],
        "no value (-3.7e28)": [7],
        "status 31 (missing)": [8],
        "blank": [9],
    }
    closes(account, optical)
    np.testing.assert_allclose(optical.q_ref_body[0], [HALF, 0, 0, HALF], atol=1e-8)
    np.testing.assert_allclose(optical.position[1], [0.011, -0.02, -1.5005], rtol=1e-12)
    assert optical.error[0] == pytest.approx(0.25e-3) and np.isnan(optical.error[5])
    assert optical.time_ns.tolist() == [round((600 + i) * 1e9 / 60) for i in range(8)]
    other = ndi.load(path, tool="Port 2", rate_hz=50.0)
    assert other.info["tool"] == "Port 2: Reference" and other.need_optical().valid.all()
    assert other.need_optical().time_ns[0] == 12_000_000_000
    np.testing.assert_allclose(other.need_optical().position[0], [0.005, 0.006, 0.007])
    with pytest.raises(
        RecordingError, match=r"csv:1: got 2 tools \(Port 1: Probe, Port 2: Ref.*--tool"
    ):
        ndi.load(path)
    with pytest.raises(RecordingError, match=r"no one tool 'needle' among Port 1: Probe"):
        ndi.load(path, tool="needle")


def test_ndi_states_can_be_stated(write):
    """A state that the user calls good and is masked all the same."""
    recording = ndi.load(write(TOOLS), tool="Probe", status_ok=("OK", "Partially out of volume"))
    assert recording.need_optical().valid.tolist() == [1, 1, 0, 1, 0, 0, 0, 0]
    assert any("Partially out of volume" in text for text in recording.info["assumptions"])


def test_ndi_stamps_of_the_api_are_exact(write):
    """Stamps that pass through a float, whose steps are 238 ns there, and a lost tool without a stamp that
    is kept at time zero."""
    head = (
        "ToolCount,ToolInfo,Frame#,PortHandle,Face#,timespec_s,timespec_ns,TransformStatus,"
        "Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,#Markers,Marker0.Status,Tx,Ty,Tz"
    )
    row = "1,8700339.rom,{},Port:10,0,{},{},{},{},4,OK,1,2,3"
    pose = "1,0,0,0,1,2,3,0.1"
    lines = [
        head,
        row.format(1, 1_700_000_000, 1, "Enabled", pose),
        row.format(2, 1_700_000_000, 16_666_667, "9", pose),
        row.format(3, 0, 0, "Missing", ",,,,,,,"),
        row.format(4, 1_700_000_000, 50_000_003, "OK", pose),
        row.format(4, 1_700_000_000, 50_000_003, "OK", pose),
        row.format(5, 1_700_000_000, 66_666_670, "OK", pose)[:60],
    ]
    recording = ndi.load(write(lines, end=""))
    optical = recording.need_optical()
    start = 1_700_000_000_000_000_000
    assert optical.time_ns.tolist() == [start + 1, start + 16_666_667, start + 50_000_003]
    assert reasons(recording.intake["optical"]) == {
        "status 9 (out of volume)": [3],
        "repeated": [6],
        "no time": [4],
        "cut short": [7],
    }
    closes(recording.intake["optical"], optical)
    assert recording.info["tool"] == "8700339.rom"


def test_ndi_a_line_for_each_tool(write):
    """Lines of another tool mixed in, decimal commas misread, and dates shifted by the machine's zone."""
    rows = [
        f"{i};2026-01-31 12:00:00,{500 + 20 * i};{tool};OK;0,8;0;0;0,6;{i},5;0;0;0,1"
        for i in range(3)
        for tool in ("Probe", "Pointer")
    ]
    path = write(["Frame;Timestamp;Tool;Status;Q0;Qx;Qy;Qz;Tx [mm];Ty [mm];Tz [mm];Error", *rows])
    recording = ndi.load(path, tool="Pointer")
    optical = recording.need_optical()
    assert (optical.time_ns // 10**6).tolist() == [1769860800500 + 20 * i for i in range(3)]
    np.testing.assert_allclose(optical.position[:, 0], [5e-4, 15e-4, 25e-4])
    np.testing.assert_allclose(optical.q_ref_body[0], [0.8, 0, 0, 0.6])
    notes = recording.intake["optical"].notes
    assert notes == ("cells are separated by semicolons", "numbers have decimal commas")
    assert any("UTC" in text for text in recording.info["assumptions"])


@pytest.mark.parametrize(("mark", "other"), [(".", ","), (",", ".")])
def test_commas_in_names_are_no_decimal_marks(write, mark, other):
    """Would catch a name cut at its comma, points in names that make decimal commas doubtful, a mixture of
    marks that is guessed at, and blank cells with spaces that are no numbers."""
    head = "Frame;Time [s];Tool;Q0;Qx;Qy;Qz;Tx;Ty;Tz"
    row = "{i};1700000000{m}{i}23456789;Probe, v1.rom;0{m}8;0;0;0{m}6;{i}{m}5;0;0"
    lines = [head, *(row.format(i=i, m=mark) for i in range(1, 4))]
    blank = [*lines[:3], lines[3].replace(";0;0;0", "; ; ;0")]
    recording = ndi.load(write(blank), tool="Probe, v1.rom")
    optical = recording.need_optical()
    assert optical.time_ns[1] == 1_700_000_000_223_456_789
    assert np.flatnonzero(~optical.valid).tolist() == [2]
    np.testing.assert_allclose(optical.position[1, 0], 2.5e-3)
    mixed = [*lines[:3], lines[3].replace(f"0{mark}8", f"0{other}8")]
    with pytest.raises(RecordingError, match="decimal commas beside points"):
        ndi.load(write(mixed))


# ---------------------------------------------------------------------------------------------
# Motive

MOTIVE = [
    "Format Version,1.23,Take Name,probe 1,Capture Frame Rate,120.000000,Export Frame Rate,120.000000,"
    "Capture Start Time,2026-01-31 02.15.30.123 PM,Total Frames in Take,5,Rotation Type,Quaternion,"
    "Length Units,Millimeters,Coordinate Space,Global",
    "",
    ",Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,"
    "Rigid Body Marker,Rigid Body Marker,Rigid Body Marker",
    ',Name,"Probe","Probe","Probe","Probe","Probe","Probe","Probe","Probe",Probe:M1,Probe:M1,Probe:M1',
    ",ID,a,a,a,a,a,a,a,a,b,b,b",
    ",,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,"
    "Position,Position,Position",
    "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z",
    f"0,0.000000,0,0,{HALF},{HALF},100,200,-300,0.4,1,2,3",
    f"1,0.008333,0,0,{HALF},{HALF},101,200,-300,0.5,1,2,3",
    "2,0.016667,,,,,,,,,1,2,3",
    f"3,0.025000,0,0,{HALF},{HALF},102,200,-300,0.5,1,2,3",
]


def test_motive_rigid_body(write):
    """Quaternions read w first, a marker's position for the body's, wrong units, and occlusions filled."""
    recording = optitrack.load(write(MOTIVE))
    optical = recording.need_optical()
    np.testing.assert_allclose(optical.q_ref_body[0], [HALF, 0, 0, HALF], atol=1e-8)
    np.testing.assert_allclose(optical.position[1], [0.101, 0.2, -0.3])
    np.testing.assert_allclose(optical.error[[0, 1, 3]], [4e-4, 5e-4, 5e-4])
    assert optical.time_ns.tolist() == [0, 8_333_000, 16_667_000, 25_000_000]
    assert reasons(recording.intake["optical"]) == {"blank": [10]}
    assert recording.info["capture_start_time"] == "2026-01-31 02.15.30.123 PM"
    short = [*MOTIVE, f"4,0.033333,0,0,{HALF}"]
    assert reasons(optitrack.load(write(short, end="")).intake["optical"])["cut short"] == [12]


def test_motive_one_of_two_bodies(write):
    """A body chosen by chance, and columns that follow no order of their own."""
    lines = [*MOTIVE[:2], *(line.split(",") for line in MOTIVE[2:])]
    lines[3] = [cell.replace("Probe:M1", "Ball").replace('"', "") for cell in lines[3]]
    lines[2] = [cell.replace("Rigid Body Marker", "Rigid Body") for cell in lines[2]]
    wide = [*lines[:2], *(",".join(line) for line in lines[2:])]
    # A second body without a rotation is none.
    assert optitrack.load(write(wide)).info["tool"] == "Probe"
    double = [*MOTIVE[:2], *(f"{line},{','.join(line.split(',')[2:10])}" for line in MOTIVE[2:])]
    double[3] = f"{MOTIVE[3]}{',Ball' * 8}"
    path = write(double)
    assert optitrack.load(path, tool="ball").info["tool"] == "Ball"
    with pytest.raises(RecordingError, match=r"csv:4: got 2 tools \(Probe, Ball\)"):
        optitrack.load(path)


# ---------------------------------------------------------------------------------------------
# Vicon

VICON = [
    "Devices",
    "1000",
    ",,Force",
    "Frame,Sub Frame,Fx",
    ",,N",
    "1,0,0.5",
    "",
    "Segments",
    "100",
    ",,Arm:Upper,,,,,,Arm:Lower,,,,,",
    "Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ,RX,RY,RZ,TX,TY,TZ",
    ",,deg,deg,deg,mm,mm,mm,deg,deg,deg,mm,mm,mm",
    "5,0,0,0,90,1,2,3,0,90,0,4,5,6",
    "6,0,,,,,,,0,90,0,4,5,6",
    "7,0,0,0,0,0,0,0,0,90,0,4,5,6",
    "8,0,0,0,90,1,2,3,0,90,0,4,5,6",
    "",
    "Trajectories",
    "100",
]
QUATERNIONS = [
    "Objects",
    "200",
    ",,tool:tool",
    "Frame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ",
    ",,,,,,mm,mm,mm",
    *(f"{i},0,{HALF},0,0,{HALF},1000,0,0" for i in range(1, 5)),
]


def test_vicon_segments(write):
    """Rotation vectors taken for Euler angles or radians, another section's or segment's columns, and zeros
    of a lost segment taken for a pose."""
    path = write(VICON)
    recording = vicon.load(path, tool="Upper")
    optical = recording.need_optical()
    np.testing.assert_allclose(optical.q_ref_body[0], [HALF, 0, 0, HALF], atol=1e-8)
    np.testing.assert_allclose(optical.position[3], [0.001, 0.002, 0.003])
    assert optical.time_ns.tolist() == [50_000_000, 60_000_000, 70_000_000, 80_000_000]
    assert reasons(recording.intake["optical"]) == {"identity at the origin": [15], "blank": [14]}
    lower = vicon.load(path, tool="Arm:Lower").need_optical()
    np.testing.assert_allclose(lower.q_ref_body[0], [HALF, 0, HALF, 0], atol=1e-8)
    with pytest.raises(RecordingError, match=r"csv:10: got 2 tools \(Arm:Upper, Arm:Lower\)"):
        vicon.load(path)
    assert any("not Euler" in text for text in recording.info["assumptions"])
    radians = [line.replace("deg", "rad").replace(",90", ",0.5") for line in VICON]
    turned = vicon.load(write(radians), tool="Lower").need_optical().q_ref_body[0]
    np.testing.assert_allclose(turned, [np.cos(0.25), 0, np.sin(0.25), 0], atol=1e-12)


def test_vicon_quaternions(write):
    """A quaternion with its scalar last read as if it came first."""
    recording = vicon.load(write(QUATERNIONS))
    np.testing.assert_allclose(
        recording.need_optical().q_ref_body[2], [HALF, HALF, 0, 0], atol=1e-8
    )
    np.testing.assert_allclose(recording.need_optical().position[0], [1.0, 0, 0])
    assert any("x, y, z, w" in text for text in recording.info["assumptions"])


@pytest.mark.parametrize(
    ("load", "lines"),
    [(partial(ndi.load, tool="Probe"), TOOLS), (vicon.load, QUATERNIONS), (optitrack.load, MOTIVE)],
)
def test_rows_out_of_order_are_refused_or_sorted(write, load, lines):
    """A row that came late, refused with advice that the command does not take, or put where it stands."""
    whole = load(write(lines)).need_optical()
    late = write([*lines[:-2], lines[-1], lines[-2]])
    with pytest.raises(RecordingError, match="--sort"):
        load(late)
    optical = load(late, sort=True).need_optical()
    np.testing.assert_array_equal(optical.time_ns, whole.time_ns)
    np.testing.assert_array_equal(optical.position, whole.position)


# ---------------------------------------------------------------------------------------------
# RepoIMU

REPO = [
    "Time (s);Vicon Orientation;;;;IMU Acceleration;;;IMU Gyroscope;;;IMU Magnetometer;;;",
    ";W;X;Y;Z;X;Y;Z;X;Y;Z;X;Y;Z;",
    "0.08;1;0;1.6232e-035;0;-0.07;0.21;9.79;0.1;0.2;0.3;-0.3;0.2;-0.9",
    "0.09;0;0;0;0;-0.07;0.21;9.79;0.1;0.2;0.3;-0.3;0.2;-0.9",
    "0.1;1;0;0;0;-0.07;0.21;9.79;0.1;NaN;0.3;-0.3;0.2;-0.9",
    "0.11;0.8;0.6;0;0;-0.07;0.21;9.79;0.1;0.2;0.3;-0.3;0.2;-0.9",
]


def test_repoimu(write, tmp_path):
    """Columns shifted by one, the gyroscope taken for the accelerometer, and rows lost unsaid."""
    recording = repoimu.load(write(REPO, "a.csv"))
    optical, imu = recording.need_optical(), recording.need_imu()
    assert optical.time_ns.tolist() == [80_000_000, 90_000_000, 100_000_000, 110_000_000]
    np.testing.assert_allclose(optical.q_ref_body[3], [0.8, 0.6, 0, 0])
    np.testing.assert_allclose(imu.gyroscope[0], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(imu.accelerometer[0], [-0.07, 0.21, 9.79])
    np.testing.assert_allclose(imu.magnetometer[0], [-0.3, 0.2, -0.9])
    assert reasons(recording.intake["optical"]) == {"missing tool (zero quaternion)": [4]}
    assert reasons(recording.intake["imu"]) == {"not finite": [5]} and len(imu.time_ns) == 3
    # Gzipped, cut short, and static.
    still = [*REPO[:2], REPO[3], "0.10" + REPO[3][4:], "0.11;0;0"]
    (tmp_path / "b.csv.gz").write_bytes(gzip.compress("\n".join(still).encode()))
    static = repoimu.load(tmp_path / "b.csv.gz")
    assert static.optical is None and len(static.need_imu().time_ns) == 2
    assert static.name == "b" and reasons(static.intake["imu"]) == {"cut short": [5]}


# ---------------------------------------------------------------------------------------------
# Faults


def changed(lines, number, old, new):
    """Lines with a text put for another in the line of this number, counted from 1."""
    assert old in lines[number - 1]
    return [*lines[: number - 1], lines[number - 1].replace(old, new, 1), *lines[number:]]


@pytest.mark.parametrize(
    ("load", "lines", "message"),
    [
        (ndi.load, changed(TOOLS, 3, "11,-20", "11"), r"csv:3: got 29 cells, expected 30"),
        (ndi.load, changed(TOOLS, 3, "11,-20", "x,-20"), r"csv:3:Tx: got 'x', expected a number"),
        (ndi.load, changed(TOOLS, 1, "Tx,Ty", "Tx [in],Ty"), r"csv:1:Tx \[in\]: .* length 'in'"),
        (ndi.load, changed(TOOLS, 1, "Qx,Qy", "Rx,Qy"), r"csv:1: got no column Qx"),
        (ndi.load, changed(TOOLS, 3, "601,0,OK,0", "600,0,OK,0"), r"csv:3:time: .* twice with other"),
        (ndi.load, changed(TOOLS, 3, "601,0,OK,0", "60,0,OK,0"), r"csv:3:time: .* times that increase"),
        (ndi.load, TOOLS[:1], r"csv:1: got 0 samples"),
        (ndi.load, ["a,b", "1,2"], r"no line with q0, qx"),
        (optitrack.load, changed(MOTIVE, 9, "101,200", "101"), r"csv:9: got 12 cells, expected 13"),
        (optitrack.load, changed(MOTIVE, 9, "101,", "1o1,"), r"csv:9:Position X: got '1o1'"),
        (optitrack.load, changed(MOTIVE, 1, "Millimeters", "Inches"), r"csv:1:Length Units: got .*Inches"),
        (optitrack.load, changed(MOTIVE, 1, "Quaternion", "XYZ"), r"csv:1:Rotation Type: got .*XYZ"),
        (optitrack.load, changed(MOTIVE, 1, "Global", "Local"), r"csv:1:Coordinate Space: got .*Local"),
        (optitrack.load, changed(MOTIVE, 7, "Z,W", "Z,V"), r"csv:7: got a rigid body without rotation w"),
        (optitrack.load, VICON, r"begins with 'Devices'"),
        (optitrack.load, MOTIVE[:7], r"csv:7: got 0 samples"),
        (vicon.load, changed(VICON, 14, "6,0,", "6,"), r"csv:14: got 13 cells, expected 14"),
        (vicon.load, changed(VICON, 13, "90", "9o"), r"csv:13:RZ: got '9o'"),
        (vicon.load, changed(VICON, 12, "deg", "grad"), r"csv:12:RX: got the unit of rotation 'grad'"),
        (vicon.load, changed(VICON, 12, "mm", "in"), r"csv:12:TX: got the unit of length 'in'"),
        (vicon.load, changed(VICON, 9, "100", "fast"), r"csv:9: got 'fast', expected the rate in Hz"),
        (vicon.load, changed(VICON, 8, "Segments", "Bones"), r"begins with 'Devices'"),
        (vicon.load, VICON[7:11], r"csv:1: got 3 lines below 'Segments'"),
        (repoimu.load, changed(REPO, 4, ";9.79", ""), r"csv:4: got 13 cells, expected 14"),
        (repoimu.load, changed(REPO, 4, "9.79", "g"), r"csv:4:IMU Acceleration Z: got 'g'"),
        (repoimu.load, changed(REPO, 4, "0.09", "soon"), r"csv:4:Time \(s\): got 'soon'"),
        (repoimu.load, changed(REPO, 1, "Gyroscope", "Gyro"), r"csv:1: got a header Time"),
        (repoimu.load, REPO[:2], r"csv:2: got 0 samples"),
    ],
)  # fmt: skip
def test_faults_are_named_by_place(write, load, lines, message):
    """A library's own traceback, a wrong line, and a fault that is passed over."""
    tool = (
        {"tool": "Port 1"} if load is ndi.load else {"tool": "Upper"} if load is vicon.load else {}
    )
    with pytest.raises(RecordingError, match=message):
        load(write(lines), **tool)


@pytest.mark.parametrize("load", [ndi.load, optitrack.load, vicon.load, repoimu.load])
def test_files_that_are_none(load, tmp_path):
    """A traceback for what is empty, no text, a folder or not there."""
    path = tmp_path / "x.csv"
    told = {
        "no such file": None,
        "an empty file": b"",
        "UTF-16": "Frame,Q0".encode("utf-16"),
        "0xff, which is not UTF-8": b"a,\xff\n",
        "cannot be read": gzip.compress(b"Frame,Q0\n" * 99)[:30],
    }
    for message, content in told.items():
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(RecordingError, match=message):
            load(path)
    with pytest.raises(RecordingError, match=r"a folder that holds x\.csv"):
        load(tmp_path)


# ---------------------------------------------------------------------------------------------
# Published sets


def test_asl_accounts_for_lines(tmp_path):
    """Duplicates counted by the rows that are left, and a download that broke off refused for its end."""
    imu = [f"{10**9 + 5_000_000 * i},0,0,{i},0,0,9.81" for i in range(8)]
    pose = [f"{10**9 + 8_000_000 * i},{i},0,0,1,0,0,0" for i in range(5)]
    pose[3] = f"{10**9 + 24_000_000},3,0,0,0,0,0,0"
    header = "#timestamp [ns],wx,wy,wz,ax,ay,az"
    (tmp_path / "a_imu.txt").write_text("\n".join([header, *imu[:3], imu[1], *imu[3:], "1040"]))
    (tmp_path / "a_mocap.csv").write_text("\n".join([*pose, pose[0]]))
    recording = asl.load(tmp_path / "a")
    assert reasons(recording.intake["imu"]) == {"repeated": [5], "cut short": [11]}
    assert recording.intake["imu"].rows == 10 and len(recording.need_imu().time_ns) == 8
    assert reasons(recording.intake["optical"]) == {
        "missing tool (zero quaternion)": [4],
        "repeated": [6],
    }
    closes(recording.intake["optical"], recording.need_optical())


def test_broad_accounts_for_samples(tmp_path):
    """Truth and tracker of which only one is told of, and samples counted as lines."""
    quaternion = np.tile([1.0, 0, 0, 0], (6, 1))
    quaternion[2:4] = np.nan
    data = {
        "imu_gyr": np.zeros((6, 3)),
        "imu_acc": np.ones((6, 3)),
        "opt_quat": quaternion,
        "opt_pos": np.zeros((6, 3)),
        "movement": np.ones(6),
        "sampling_rate": 100.0,
    }
    savemat(tmp_path / "01_x.mat", data)
    recording = broad.load(tmp_path / "01_x.mat")
    for label in ("optical", "encoder"):
        assert reasons(recording.intake[label]) == {"blank": [2, 3]}
        assert recording.intake[label].unit == "sample"
    assert recording.need_encoder().scored.tolist() == [1, 1, 0, 0, 1, 1]
    assert recording.intake["imu"].rows == 6


# ---------------------------------------------------------------------------------------------
# The command


def call(*arguments):
    return CliRunner().invoke(main, ["import", *(str(a) for a in arguments)])


def test_command_writes_a_run_and_says_what_became_of_rows(write, tmp_path):
    """A run that cannot be read again, one whose assumptions are lost, an output replaced unasked, and
    rows that are masked unsaid."""
    path, out = write(TOOLS), tmp_path / "run"
    done = call("ndi", path, "-o", out, "--tool", "Probe")
    assert done.exit_code == 0, done.output
    for text in (
        "1 row is masked, status 31 (missing) (line 8)",
        "Assumptions:",
        "frame numbers over 60 Hz",
    ):
        assert text in done.output
    run, made = jaxekf.load(out), ndi.load(path, tool="Probe")
    assert list(run.info["assumptions"]) == made.info["assumptions"]
    assert run.info["imported"]["account"]["optical"]["masked"]["blank"]["first"] == 9
    assert run.info["imported"]["source"] == "take.csv" and run.info["imported"]["tool"] == "Probe"
    np.testing.assert_array_equal(run.need_optical().time_ns, made.need_optical().time_ns)
    np.testing.assert_array_equal(run.need_optical().valid, made.need_optical().valid)
    seen = made.need_optical().valid
    np.testing.assert_allclose(
        run.need_optical().q_ref_body[seen], made.need_optical().q_ref_body[seen], atol=1e-15
    )
    again = call("ndi", path, "-o", out, "--tool", "Probe")
    assert again.exit_code == 1 and "exists" in again.output
    states = ("--status-ok", "ok", "--status-ok", "Partially out of volume")
    more = call("ndi", path, "-o", out, "--tool", "Probe", "--overwrite", "--json", *states)
    assert more.exit_code == 0, more.output
    told = json.loads(more.stdout)["streams"]["optical"]
    assert (told["rows"], told["used"]) == (8, 3)
    for wrong, message in (
        (("vicon", path, "-o", tmp_path / "x", "--rate", "50"), "expected it with ndi only"),
        (("ndi", path, "-o", tmp_path / "x"), "got 2 tools"),
        (("vicon", path, "-o", tmp_path / "x"), "expected a CSV export of Vicon"),
    ):
        refused = call(*wrong)
        assert refused.exit_code != 0 and message in refused.output
        assert not (tmp_path / "x").exists()


def test_several_recordings_are_named(tmp_path):
    """The first of several taken for the one that was meant."""
    for name in ("one", "two"):
        for label in ("imu0", "vicon0"):
            (tmp_path / name / "mav0" / label).mkdir(parents=True)
            (tmp_path / name / "mav0" / label / "data.csv").write_text("1,0,0,0,0,0,0\n")
        (tmp_path / f"{name}.mat").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"2 recordings \(one, two\).*naming it: .*one"):
        formats.read("asl", tmp_path)
    with pytest.raises(RecordingError, match=r"2 trials \(one\.mat, two\.mat\)"):
        formats.read("broad", tmp_path)
    with pytest.raises(RecordingError, match=r"got the format 'c3d', expected one of ndi"):
        formats.read("c3d", tmp_path)


@pytest.mark.parametrize("name", formats.FORMATS)
def test_options_are_those_of_the_loader(name, tmp_path):
    """An option of the command that a loader does not know, which would end in a traceback; and a file that
    is not there."""
    known = inspect.signature(formats.FORMATS[name].load)
    offered = {option.name for option in import_run.params}
    for option in formats.FORMATS[name].options:
        assert option.name in known.parameters and option.name in offered
    refused = call(name, tmp_path / "nothing", "-o", tmp_path / "x")
    assert refused.exit_code == 1 and "nothing" in refused.output
    assert "expected" in refused.output and isinstance(refused.exception, SystemExit)


# ---------------------------------------------------------------------------------------------
# Real recordings

LONG = "JAXEKF_LONG" in os.environ


@pytest.fixture(scope="module")
def repo(data_dir):
    if not (data_dir / "repoimu").is_dir():
        pytest.skip("no RepoIMU trials beside the project")
    return data_dir / "repoimu"


def test_repoimu_trials_are_read_whole(repo):
    """Rows of the published files lost, and the gyroscope in another unit or the quaternion in another
    direction: with either the frames do not lie within 3 deg. All trials tell one frame."""
    files = sorted(repo.glob("*.csv.gz"))
    frames = []
    for file in files if LONG else [files[0], files[2], files[-1]]:
        recording = repoimu.load(file)
        with gzip.open(file, "rb") as text:
            assert recording.intake["imu"].rows == len(text.readlines()) - 2
        if "Static" in file.name:
            assert recording.optical is None
            continue
        found = align(recording.need_optical(), recording.need_imu(), file)
        frames.append(np.rad2deg(found.alignment))
        assert -7e-3 < found.latency_s < -3e-3
        assert 1.9 < np.linalg.norm(frames[-1]) < 2.8
    # About x, about which the stick mostly turns in Test02, it is known worst.
    assert np.ptp(frames, axis=0)[0] < 0.9 and np.all(np.ptp(frames, axis=0)[1:] < 0.3)


@pytest.mark.long
@pytest.mark.parametrize(
    "trial",
    [
        pytest.param(
            t,
            marks=()
            if t in (7, 35)
            else pytest.mark.skipif(not LONG, reason="all trials: set JAXEKF_LONG=1"),
        )
        for t in (1, 2, 5, 7, 10, 12, 16, 24, 28, 32, 35)
    ],
)
def test_broad_lag(data_dir, trial):
    """Stamps of the importer that are off: the gyroscope lags the motion capture by some 4 ms."""
    if not (data_dir / "broad").is_dir():
        pytest.skip("no BROAD trials beside the project")
    recording = broad.load(broad.find(data_dir / "broad", trial))
    optical = recording.need_optical()
    step = 1 if LONG else 5
    few = Optical(optical.time_ns[::step], optical.q_ref_body[::step], optical.valid[::step])
    found = align(few, recording.need_imu(), trial)
    assert -5e-3 < found.latency_s < -3.5e-3
    assert np.linalg.norm(found.alignment) < np.deg2rad(0.6)
