"""Schemas of streams: a stream of plain columns is one file, and everything else follows from it."""

import dataclasses
import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxekf
import jaxekf.io
from jaxekf import Euclidean, Model, Output, Parameters, RecordingError, Sensor
from jaxekf.geometry import linalg
from jaxekf.io.schema import Field, StreamSchema
from jaxekf.io.streams import SCHEMAS
from jaxekf.recordings.types import NANOSECONDS, PlainStream
from jaxekf.simulation import attitude_runs

SECONDS = np.arange(40) * 0.01


def force_at(t):
    return np.stack([2.0 + np.sin(t), 3.0 * t, -0.5 * t**2], axis=1)


@pytest.fixture
def run():
    """Forces and torques, one of them missing, without an IMU."""
    time_ns = np.round(SECONDS * NANOSECONDS).astype(np.int64)
    force = force_at(SECONDS)
    force[7] = np.nan
    stream = PlainStream(time_ns, {"force": force, "torque": 0.1 * force_at(-SECONDS)}, 2_000_000)
    return jaxekf.Recording("pushed", others={"force_torque": stream})


@pytest.mark.parametrize("name", ["pushed", "pushed.h5", "pushed.npz"])
def test_a_plain_stream_comes_back(run, tmp_path, name):
    """Would catch a field, the latency, a missing row or the account lost on the way to a file and back."""
    again = jaxekf.load(jaxekf.save(run, tmp_path / name))
    one, other = run.others["force_torque"], again.others["force_torque"]
    for key, value in one.arrays.items():
        np.testing.assert_array_equal(value, other.arrays[key])
    assert other.latency_ns == one.latency_ns
    assert again.intake["force_torque"].rows == 40
    taken = again.samples("force_torque", "force")
    np.testing.assert_array_equal(taken.time_ns, one.time_ns - 2_000_000)
    assert not taken.mask[7] and taken.mask.sum() == 39


def test_its_file_is_read_as_its_section_says(tmp_path):
    """Would catch units, renamed columns and time units that only built-in streams understand."""
    (tmp_path / "recording.toml").write_text(
        "schema_version = 1\n[force_torque]\nunit = 'mN, N mm'\ntime_unit = 'ms'\nfile = 'ft.csv'\n"
        "columns = { time = 't', fx = 'Fx', fy = 'Fy', fz = 'Fz', tx = 'Tx', ty = 'Ty', tz = 'Tz' }\n"
    )
    (tmp_path / "ft.csv").write_text("t,Fx,Fy,Fz,Tx,Ty,Tz\n0,1000,0,0,5,0,0\n10,2000,0,0,,,\n")
    stream = jaxekf.load(tmp_path).others["force_torque"]
    np.testing.assert_allclose(stream.values["force"][:, 0], [1.0, 2.0])
    np.testing.assert_allclose(stream.values["torque"][0], [5e-3, 0.0, 0.0])
    assert np.isnan(stream.values["torque"][1]).all()
    np.testing.assert_array_equal(stream.time_ns, [0, 10_000_000])


def test_wrong_files_are_named(run, tmp_path):
    """Would catch a plain stream whose faults are not found where those of others are."""
    place = jaxekf.save(run, tmp_path / "run")
    text = (place / "force_torque.csv").read_text()
    (place / "force_torque.csv").write_text(text.replace("time,fx", "time,force"))
    with pytest.raises(RecordingError, match=r"force_torque\.csv.*expected time,fx,fy,fz,tx,ty,tz"):
        jaxekf.load(place)
    (place / "force_torque.csv").write_text(text)
    told = (place / "recording.toml").read_text()
    (place / "recording.toml").write_text(told.replace("latency", "latncy"))
    with pytest.raises(RecordingError, match=r"force_torque\.latncy.*force_torque\.latency"):
        jaxekf.load(place)
    with pytest.raises(RecordingError, match=r"no field lift.*one of force, torque"):
        run.samples("force_torque", "lift")
    with pytest.raises(RecordingError, match="no pressure stream"):
        run.samples("pressure", "pressure")


def test_it_goes_through_everything_that_streams_go_through(tmp_path):
    """Would catch a cut at a gap, the check or the picture of samples that forgets plain streams."""
    made = attitude_runs.recording("run", attitude_runs.free_motion(0), seed=0, duration_s=3.0)
    imu = made.need_imu()
    kept = np.abs((imu.time_ns - imu.time_ns[0]) / NANOSECONDS - 1.5) > 0.2
    time_ns = imu.time_ns[::4]
    seconds = (time_ns - time_ns[0]) / NANOSECONDS
    forces = {"force": force_at(seconds), "torque": force_at(seconds)}
    whole = made.with_streams({"imu": imu.take(kept), "force_torque": PlainStream(time_ns, forces)})
    place = jaxekf.save(whole, tmp_path / "run")
    parts, left = jaxekf.split_at_gaps(jaxekf.load(place))
    assert len(parts) == 2 and not left
    assert sum(len(p.others["force_torque"].time_ns) for p in parts) == len(time_ns)
    from click.testing import CliRunner

    from jaxekf.cli import main

    done = CliRunner().invoke(main, ["check", str(place), "--json"])
    assert done.exit_code in (0, 3), done.output  # 3: it has warnings, of so short a run
    document = json.loads(done.stdout)
    assert document["runs"][0]["streams"]["force_torque"]["samples"] == len(time_ns)


def level_model():
    """The level of a stream that this test adds, as a random walk."""
    return Model(
        name="level",
        summary="a level",
        space=Euclidean(1, "m"),
        transition=lambda x, u, dt, w, params: x + w,
        process_noise=lambda params, dt: linalg.covariance(params.noise["walk"], 1) * dt,
        sensors=(
            Sensor(
                "level",
                Euclidean(1, "m"),
                predict=lambda x, u, params, aux: x,
                noise=lambda params, aux, dt: linalg.covariance(params.noise["level"], 1),
                source=lambda recording: recording.samples("water", "level"),
            ),
        ),
        parameters=Parameters({"walk": 1.0, "level": 0.1}, calibration=(), initial={"level": 1.0}),
        units=Parameters(
            {"walk": "m/sqrt(s)", "level": "m"}, calibration=(), initial={"level": "m"}
        ),
        noise_dims={"walk": 1, "level": 1},
        initial_mean=lambda first: jnp.asarray(first["level"]),
        initial_covariance=lambda params: linalg.covariance(params.initial["level"], 1),
        start_with=("level",),
        outputs=(Output("level", Euclidean(1, "m"), "tank", lambda x, u, params: x),),
    )


def test_a_stream_of_ones_own_drives_a_model_of_ones_own(tmp_path):
    """Would catch a stream that can be registered and not be estimated with."""
    column = {"level": Field(shape=("N", 1), unit="m", needed=True, columns=("level",))}
    schema = StreamSchema("water", "Level of a tank.", column)
    with pytest.raises(RecordingError, match="a name that is taken"):
        jaxekf.io.register(replace(schema, name="imu"))
    with pytest.raises(RecordingError, match="the name 'two words'"):
        jaxekf.io.register(replace(schema, name="two words"))
    jaxekf.io.register(schema)
    try:
        (tmp_path / "recording.toml").write_text("schema_version = 1\n[water]\nunit = 'mm'\n")
        rows = "".join(f"{t:.2f},{1000 + 1000 * t:.1f}\n" for t in SECONDS)
        (tmp_path / "water.csv").write_text("time,level\n" + rows)
        run = jaxekf.load(tmp_path)
        made = jaxekf.estimate(run, level_model())
        level = made.outputs["level"].value[:, 0]
        np.testing.assert_allclose(level, 1.0 + SECONDS, atol=0.05)
        assert made.account["level"]["used"] == 40
    finally:
        del SCHEMAS["water"]


def test_schemas_describe_what_the_streams_are():
    """Would catch a field of a stream that no schema has, so that files lose it without a word."""
    for label, schema in SCHEMAS.items():
        if label == "force_torque":
            continue
        named = jaxekf.recordings.types.__dict__[label.capitalize()]
        fields = {one.name for one in dataclasses.fields(named)}
        assert {name for name, one in schema.fields.items() if one.stored} == fields, label
        assert all(one.about for one in schema.fields.values()), label
