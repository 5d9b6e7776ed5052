"""Noise densities of what rests: against another implementation, planted values, and a real log."""

import json
from dataclasses import replace

import allantools
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import jaxekf
from jaxekf._support.constants import STANDARD_GRAVITY
from jaxekf._support.errors import RecordingError
from jaxekf.calibration import allan, static_interval
from jaxekf.calibration.noise_densities import fit
from jaxekf.calibration.static_noise import start_for, static_noise
from jaxekf.cli import main
from jaxekf.estimation import parameters
from jaxekf.io.importers import adis
from jaxekf.recordings.types import Imu, Recording, from_scipy, to_scipy
from jaxekf.reporting.plots.deviations import allan as draw
from jaxekf.simulation import attitude_runs, marker_runs

PERIOD_S = 0.01


def samples(seed, count, white, walk):
    """White noise and a random walk of given densities."""
    rng = np.random.default_rng([seed, count])
    steps = walk * np.sqrt(PERIOD_S) * rng.standard_normal(count)
    return white / np.sqrt(PERIOD_S) * rng.standard_normal(count) + np.cumsum(steps)


def still(seed, duration_s=20.0, grade=None, rest_s=1e3, motion=None):
    """A run of a tracker and a gyroscope that rests, at first or throughout."""
    chosen = motion or attitude_runs.free_motion(seed, rest_s=rest_s)
    return attitude_runs.recording("still", chosen, seed=seed, duration_s=duration_s, grade=grade)


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.mark.parametrize("walk", [0.0, 0.5])
def test_deviation_is_that_of_allantools(walk):
    """An overlap, a factor or an averaging length lost."""
    values = 3.0 + samples(0, 3000, 1.0, walk)
    lengths = allan.averaging_lengths(len(values))
    assert lengths[0] == 1.0 and 250.0 < lengths[-1] <= 300.0
    tau, other, _, _ = allantools.oadev(
        values, rate=1.0 / PERIOD_S, data_type="freq", taus=lengths * PERIOD_S
    )
    np.testing.assert_allclose(lengths * PERIOD_S, tau, rtol=1e-12)
    np.testing.assert_allclose(allan.overlapping_deviation(values, lengths), other, rtol=1e-9)


def test_degrees_of_freedom_are_those_of_allantools():
    """A misprint in the formulas of any of the four kinds of noise. That of flicker at m = 1 lacks a square
    in allantools; about a degree of freedom a sample is plain there."""
    for exponent in (2, 0, -1, -2):
        for m in (1, 2, 7, 50):
            found = allan.degrees_of_freedom(1001, m, exponent)
            if (exponent, m) == (-1, 1):
                assert 0.8 * 1001 < found < 1001
            else:
                assert found == pytest.approx(allantools.edf_simple(1001, m, exponent), rel=1e-9)


def test_intervals_of_the_deviation_hold_the_truth():
    """Degrees of freedom of samples where those of averages were needed, or bounds turned round."""
    held = []
    for seed in range(50):
        values = np.stack([samples(10 * seed + i, 600, 1.0, 0.0) for i in range(3)], axis=1)
        curve = allan.sensor_noise(values, PERIOD_S, "rad/s").curve
        truth = 1.0 / np.sqrt(curve.tau)[:, None]
        held.append((curve.low <= truth) & (truth <= curve.high))
    share = np.mean(held, axis=(0, 2))
    assert np.all((share > 0.89) & (share < 0.99)), share


def test_planted_densities_are_found():
    """A biased estimate, and intervals that are too narrow or too wide: over 120 axes 95 % of intervals
    hold the truth, give or take 2 %."""
    white, walk = 0.05, 0.015
    found = [fit(samples(seed, 20000, white, walk), PERIOD_S) for seed in range(120)]
    for truth, made in ((white, [f.white for f in found]), (walk, [f.walk for f in found])):
        assert np.mean([m.value for m in made]) == pytest.approx(truth, rel=0.1)
        assert 0.90 <= np.mean([m.low <= truth <= m.high for m in made]) <= 0.99
    assert np.mean([f.walk.significant for f in found]) > 0.9
    assert np.mean([f.flicker > 0.0 for f in found]) < 0.05
    assert np.median([f.deviation(np.ones(1))[0] for f in found]) == pytest.approx(
        np.sqrt(white**2 + walk**2 / 3.0), rel=0.05
    )


def test_flicker_is_told_from_a_walk():
    """A scale of the flicker that is off: its deviation is flat, at sqrt(2 ln 2 / pi) B. Made of many
    first-order processes, one third of an octave from the other."""
    rng = np.random.default_rng(5)
    count, values = 200_000, 0.0
    for corner in 2.0 ** np.arange(-13.0, 5.1, 1.0 / 3.0):
        decay = np.exp(-2.0 * np.pi * corner * PERIOD_S)
        # Each has the same variance, so that they sum to 1/f: B^2 ln(2) / (3 pi) a third of an octave.
        drive = np.sqrt((1.0 - decay**2) * np.log(2.0) / (3.0 * np.pi)) * rng.standard_normal(count)
        values = values + lfilter([1.0], [1.0, -decay], drive)
    found = fit(values + samples(6, count, 0.2, 0.0), PERIOD_S)
    assert found.flicker == pytest.approx(1.0, rel=0.12)
    assert found.white.value == pytest.approx(0.2, rel=0.1)
    assert not found.walk.significant or found.walk.value < 0.1 * found.walk_alone.value
    assert found.walk_alone.significant


def test_low_pass_and_vibration_do_not_count():
    """The density that matters over many samples taken from what a sensor's filter leaves at the highest
    frequencies, or from a fan."""
    values = samples(1, 100_000, 0.05, 0.002)
    passed = lfilter([0.4], [1.0, -0.6], values)
    hum = 0.05 * np.sin(2.0 * np.pi * 3.1 * PERIOD_S * np.arange(len(values)))
    found = fit(passed + hum, PERIOD_S)
    assert found.band_hz < 15.0
    assert found.white.value == pytest.approx(0.05, rel=0.06)
    assert found.walk_alone.value == pytest.approx(0.002, rel=0.4)


def test_a_short_rest_does_not_tell_a_walk():
    """A random walk made up from 20 s, or a default kept that the data refuse."""
    found = static_noise(still(0))
    model = jaxekf.get_model("loose")
    start = start_for(model, found)
    assert set(start.taken) == {"gyroscope", "optical"}
    assert "too short to estimate a random walk" in start.sentences[0]
    assert start.params.noise.bias_walk == model.parameters.noise.bias_walk
    np.testing.assert_allclose(start.params.noise.gyroscope, np.deg2rad(0.05), rtol=0.06)
    wide = model.parameters.noise._replace(bias_walk=np.deg2rad(1.0))
    bold = replace(model, parameters=model.parameters._replace(noise=wide))
    limit = start_for(bold, found).params.noise.bias_walk
    assert np.all(limit < np.deg2rad(0.3)) and np.all(limit > np.deg2rad(0.005))


def test_missing_samples_are_bridged_and_gaps_cut():
    """Time that shrinks where samples are lost, or a jump in time taken for noise."""
    imu = still(1, duration_s=60.0).need_imu()
    whole = allan.imu_noise(imu)
    lost = np.ones(len(imu.time_ns), bool)
    lost[[100, 101, 2000]] = False
    gap = lost.copy()
    gap[3000:3200] = False

    def without(kept):
        return allan.imu_noise(Imu(imu.time_ns[kept], imu.gyroscope[kept]))

    assert without(lost).missing == 3
    assert without(lost).duration_s == pytest.approx(whole.duration_s, abs=1e-6)
    np.testing.assert_allclose(without(lost).gyroscope.white, whole.gyroscope.white, rtol=0.01)
    assert without(gap).samples == len(imu.time_ns) - 3200
    with pytest.raises(RecordingError, match="at rest, without gaps"):
        without(np.arange(len(imu.time_ns)) < 200)


@pytest.mark.parametrize("rest_s", [4.0, 12.0])
def test_the_rest_is_found(rest_s):
    """Motion counted as noise, or rest thrown away."""
    for seed in range(3):
        assert (
            rest_s - 1.1 <= static_interval.quiet_s(still(seed, rest_s=rest_s).need_imu()) <= rest_s
        )


def test_what_does_not_rest_is_refused():
    """Noise of a motion: one that begins at once, and a steady turn, which looks like a bias."""
    with pytest.raises(RecordingError, match="of rest at the start"):
        static_interval.static_head(still(0, rest_s=1.0))
    with pytest.raises(RecordingError, match="tracker that rotates by"):
        static_interval.static_head(still(0, motion=attitude_runs.constant_rate_motion(-1.0, 0.0)))
    with pytest.raises(RecordingError, match="stretch from 30"):
        static_noise(still(0), 30.0, 40.0)


def test_scatter_of_the_tracker():
    """The factor of two in differences, drift taken for noise, and one wrong pose that rules all."""
    run = still(2)
    optical = run.need_optical()
    t = (optical.time_ns - optical.time_ns[0])[:, None] / 1e9
    drifting = to_scipy(optical.q_ref_body) * Rotation.from_rotvec(
        np.deg2rad(0.05) * t * np.ones(3)
    )
    q = from_scipy(drifting)
    q[500] = [0.0, 1.0, 0.0, 0.0]
    found = static_interval.tracker_noise(
        run.replace(optical=replace(optical, q_ref_body=q)), 0.0, 20.0, 20.0
    )
    assert found.optical is not None and found.position is not None
    for scatter, truth in ((found.optical, np.deg2rad(0.3)), (found.position, 0.2e-3)):
        np.testing.assert_allclose(scatter.value, truth, rtol=0.06)
        assert np.all((scatter.low < truth * 1.02) & (scatter.high > truth * 0.98))
    assert found.optical.samples == 1248
    # A second of drift is 0.05 deg; over 20 s it is as large as the noise.
    assert found.optical.wander > 1.1


@pytest.fixture(scope="module")
def tool():
    """A tool with markers that lies still."""
    free = marker_runs.free_tool_motion(0)
    lying = replace(free, attitude=attitude_runs.Motion(), amplitude=0.0 * free.amplitude)
    return marker_runs.tool_recording("lying", lying, seed=0, duration_s=20.0)


def test_command_writes_a_start_for_tuning(tool, tmp_path):
    """A noise.toml that other commands do not read, units mixed up, JSON that is none."""
    jaxekf.save(tool, tmp_path / "lying")
    result = call("allan", tmp_path / "lying", "--model", "tight", "-o", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["gyroscope"]["x"]["white"]["found"] is True
    model = jaxekf.get_model("tight")
    noise = parameters.load(model, tmp_path / "out").noise
    np.testing.assert_allclose(noise.gyroscope, np.deg2rad(0.05), rtol=0.06)
    np.testing.assert_allclose(noise.accelerometer, 1.85e-3 * STANDARD_GRAVITY, rtol=0.06)
    np.testing.assert_allclose(noise.marker, 0.231e-3, rtol=0.06)
    table = np.genfromtxt(tmp_path / "out" / "allan.csv", delimiter=",", names=True)
    assert table.dtype.names[:3] == ("tau_s", "gyroscope_x_rad_s", "gyroscope_x_low_rad_s")
    near = np.argmin(np.abs(table["tau_s"] - 0.1))
    expected = 1.85e-3 * STANDARD_GRAVITY / np.sqrt(table["tau_s"][near])
    assert table["accelerometer_z_m_s2"][near] == pytest.approx(expected, rel=0.15)
    assert (tmp_path / "out" / "allan.png").stat().st_size > 20_000
    assert not (tmp_path / "out" / "calibration.toml").exists()
    again = call("allan", tmp_path / "lying", "-o", tmp_path / "out")
    assert again.exit_code == 1 and "exists" in again.output


def test_command_takes_a_plain_log(tool, tmp_path):
    """Columns in another order, and a stretch that is not the one asked for."""
    jaxekf.save(tool, tmp_path / "lying")
    log = tmp_path / "lying" / "imu.csv"
    result = call("allan", log, "--from", 2, "--to", 12, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "static from 2.0 to 12.0 s of 20.0 s, 5001 samples" in result.output
    assert "Gyroscope at rest" in result.output and "below" in result.output
    short = call("allan", log, "--to", 1, "-o", tmp_path / "other")
    assert short.exit_code == 1 and "at rest, without gaps" in short.output
    assert not (tmp_path / "other").exists()


def test_real_static_log(data_dir):
    """An ADIS16405 at rest for 2.8 h: its known deviation, and the same curve as another implementation."""
    file = data_dir / "adis16405_static" / "adis_16405_imu1.npz"
    if not file.is_file():
        pytest.skip(f"There is no {file.name} in {file.parent}; fetch it.")
    run = adis.load(file)
    found = static_noise(run)
    assert found.end_s == pytest.approx(9999.99)
    curve = found.imu.gyroscope.curve
    second = np.argmin(np.abs(curve.tau - 1.0))
    deg = np.rad2deg(curve.deviation[second] * np.sqrt(curve.tau[second]))
    assert np.all((deg > 0.038) & (deg < 0.045)), deg
    white = np.rad2deg(found.imu.gyroscope.white)
    assert np.all((white > 0.036) & (white < 0.044)), white
    floor = np.rad2deg(found.imu.gyroscope.floor()[0])
    assert np.all((floor > 0.004) & (floor < 0.009)), floor
    for i in range(3):
        _, other, _, _ = allantools.oadev(
            run.need_imu().gyroscope[:, i], rate=100.0, data_type="freq", taus=curve.tau[::4]
        )
        np.testing.assert_allclose(curve.deviation[::4, i], other, rtol=0.01)


def test_a_file_that_is_no_log_is_refused(tmp_path):
    """A library's traceback for a wrong file."""
    np.savez(tmp_path / "a.npz", data=np.zeros((10, 5)))
    (tmp_path / "b.npz").write_text("no archive")
    for name in ("a", "b", "c"):
        with pytest.raises(RecordingError, match="got"):
            adis.load(tmp_path / f"{name}.npz")


def test_constant_output_is_no_noise():
    """A zero deviation, which no filter takes, written as a start."""
    imu = still(3).need_imu()
    stuck = Recording("stuck", imu=replace(imu, gyroscope=np.zeros_like(imu.gyroscope)))
    start = start_for(jaxekf.get_model("loose"), static_noise(stuck))
    assert start.taken == ()
    assert "gyroscope is zero" in start.sentences[0]


def test_the_figure_of_constant_output_does_not_warn():
    """A logarithmic axis without a positive value, of which matplotlib warns (and warnings are errors)."""
    imu = still(3, duration_s=10.0).need_imu()
    stuck = Recording("stuck", imu=replace(imu, gyroscope=np.zeros_like(imu.gyroscope)))
    assert draw(static_noise(stuck)).axes[0].get_yscale() == "linear"


def test_the_part_of_a_log_is_stated(tmp_path):
    """A user who takes the numbers for those of the whole log."""
    run = still(4, duration_s=16.0, motion=attitude_runs.free_motion(4, rest_s=8.0))
    result = call("allan", jaxekf.save(run, tmp_path / "run"), "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert " s of 16.0 s, " in result.output
    assert "this is the rest at the start; --from and --to choose another" in result.output


def rest_last(head_s):
    """A run that rests at first, moves for 8 s, and rests for 20 s."""
    run = still(4, duration_s=28.0 + head_s, motion=attitude_runs.free_motion(4, rest_s=head_s))
    imu = run.need_imu()
    t = (imu.time_ns - imu.time_ns[0]) / 1e9
    rng = np.random.default_rng(1)
    noise = 4e-3 * rng.standard_normal(imu.gyroscope.shape)
    rests = (t < head_s) | (t > head_s + 8.0)
    gyroscope = np.where(rests[:, None], noise, imu.gyroscope)
    return Recording("late", imu=replace(imu, gyroscope=gyroscope))


def test_a_longer_rest_is_named(tmp_path):
    """Noise of the four seconds before a motion, where the log rests for twenty after it; and a motion that
    is named as rest."""
    for head_s in (1.0, 5.0):
        begin, end = static_interval.longest_rest(rest_last(head_s).imu)
        assert head_s + 8.0 <= begin <= head_s + 9.1
        assert end == pytest.approx(head_s + 28.0, abs=1.1)
    begin, end = static_interval.longest_rest(still(0, rest_s=1.0).need_imu())
    assert end - begin < 5.0
    result = call("allan", jaxekf.save(rest_last(5.0), tmp_path / "run"), "-o", tmp_path / "out")
    assert "this is the rest at the start; a longer one is from" in result.output
    with pytest.raises(
        RecordingError, match=r"try --from \S+ --to \S+, the longest rest of the run"
    ):
        static_interval.static_head(rest_last(1.0))
