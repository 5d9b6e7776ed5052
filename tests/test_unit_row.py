"""A row of units below the header of a CSV file: used, stated, and never against the description."""

import numpy as np
import pytest

import jaxekf
from jaxekf._support.errors import RecordingError

TIME = 0.01 * np.arange(300)
RATE = np.stack([np.sin(TIME + i) for i in range(3)], axis=1)


def folder(path, units, about="", *, factor=1.0, time_factor=1.0, separator=","):
    """A run with only a gyroscope, whose second line is `units`."""
    path.mkdir(exist_ok=True)
    lines = [
        "time,gx,gy,gz",
        units,
        *(
            ",".join(f"{v:.9g}" for v in (time_factor * t, *(factor * rate)))
            for t, rate in zip(TIME, RATE, strict=True)
        ),
    ]
    text = "\n".join(line.replace(",", separator) for line in lines if line)
    (path / "imu.csv").write_text(text + "\n")
    (path / "recording.toml").write_text(f"schema_version = 1\n{about}\n")
    return path


@pytest.mark.parametrize(
    ("units", "factor", "time_factor"),
    [
        ("s,deg/s,deg/s,deg/s", 180.0 / np.pi, 1.0),
        ("ms,rad/s,rad/s,rad/s", 1.0, 1e3),
        ("[s],[°/s],[°/s],[°/s]", 180.0 / np.pi, 1.0),
        ("(µs),dps,dps,dps", 180.0 / np.pi, 1e6),
    ],
)
def test_the_units_of_the_row_are_used(tmp_path, units, factor, time_factor):
    """Would catch degrees that are read as radians, or a row of units that is taken for a sample."""
    for separator in (",", ";"):
        made = jaxekf.load(
            folder(
                tmp_path / "run", units, factor=factor, time_factor=time_factor, separator=separator
            )
        )
        np.testing.assert_allclose(made.imu.gyroscope, RATE, atol=1e-8)
        np.testing.assert_allclose(made.imu.time_ns, 1e9 * TIME, atol=1)
        notes = made.intake["imu"].notes
        assert any("line 2 holds units, which are used" in note for note in notes)
        assert made.intake["imu"].rows == len(TIME)


def test_other_streams_have_rows_of_units_too(tmp_path):
    """Would catch a row that only one stream knows, and lengths in mm beside a quaternion without unit."""
    run = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    path = jaxekf.save(jaxekf.crop(run, 0.0, 4.0), tmp_path / "run")
    file = path / "optical.csv"
    header, *rows = file.read_text().splitlines()
    unit = {"time": "s", "x": "mm", "y": "mm", "z": "mm"}
    names = header.split(",")
    file.write_text("\n".join([header, ",".join(unit.get(n, "-") for n in names), *rows]) + "\n")
    about = path / "recording.toml"
    about.write_text(about.read_text().replace('unit = "1, m"\n', ""))
    made = jaxekf.load(path)
    seen = made.optical.valid
    np.testing.assert_allclose(
        made.optical.position[seen], 1e-3 * jaxekf.crop(run, 0.0, 4.0).optical.position[seen]
    )


@pytest.mark.parametrize(
    ("units", "about", "words"),
    [
        (
            "s,deg/s,deg/s,deg/s",
            '[imu]\nunit = "rad/s"',
            "imu.csv:2:gx: got the unit 'deg/s', expected that",
        ),
        (
            "ms,deg/s,deg/s,deg/s",
            '[imu]\ntime_unit = "s"',
            "imu.csv:2:time: got the unit 'ms', expected that",
        ),
        (
            "s,deg/s,rad/s,deg/s",
            "",
            "imu.csv:2:gy: got 'rad/s' and 'deg/s' for gx, expected the same",
        ),
        (
            "s,furlong,furlong,furlong",
            "",
            "imu.csv:2:gx: got the unit 'furlong', expected rad/s or deg/s",
        ),
        ("s,deg/s,1.5,deg/s", "", "'s', expected a time"),
        ("when,deg/s,deg/s,deg/s", "", "'when', expected a time"),
    ],
)
def test_contradictions_are_refused(tmp_path, units, about, words):
    """Would catch a description that wins in silence over the file, and text that is taken for units."""
    with pytest.raises(RecordingError) as caught:
        jaxekf.load(folder(tmp_path / "run", units, about))
    assert words in str(caught.value)


def test_equal_units_in_both_places_are_fine(tmp_path):
    """Would catch a refusal of what agrees."""
    about = '[imu]\nunit = "deg/s"\ntime_unit = "s"'
    made = jaxekf.load(folder(tmp_path / "run", "s,deg/s,deg/s,deg/s", about, factor=180.0 / np.pi))
    np.testing.assert_allclose(made.imu.gyroscope, RATE, atol=1e-8)
