"""Pictures of single markers: everything at the time it was taken, and what became of every sample."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxekf
from jaxekf.pose_solvers import marker_pose
from jaxekf.recordings.truth import encoder_velocity_at
from jaxekf.recordings.types import Encoder, Optical
from jaxekf.reporting import plots
from jaxekf.reporting.plots import _attitudes as attitudes
from jaxekf.reporting.plots import _measurements as measurements
from jaxekf.reporting.plots import _single_markers as single_markers
from jaxekf.simulation import marker_runs
from jaxekf.simulation.marker_runs import ToolGrade

NAMES = (
    "attitude",
    "bias",
    "innovations",
    "occlusion",
    "path",
    "position",
    "rate",
    "velocity",
    "visibility",
)
REFUSED = (20, 40, 60)
"""Frames in which marker 1 is 2 cm off."""


@pytest.fixture(scope="module")
def made():
    """3 s: from 1.5 s on marker 3 is hidden, from 2 s on all, until 2.25 s."""
    recording = marker_runs.tool_recording(
        "tool",
        marker_runs.free_tool_motion(2),
        seed=2,
        duration_s=3.0,
        grade=ToolGrade(imu_s=0.006),
        hidden=[("3", 1.5, 2.25), ("1", 2.0, 2.25), ("2", 2.0, 2.25)],
    )
    position = recording.markers.position.copy()
    position[list(REFUSED), 0, 2] += 0.02
    recording = recording.replace(markers=replace(recording.markers, position=position))
    return jaxekf.estimate(recording, "tight"), recording


@pytest.fixture(scope="module")
def figures(made):
    return {name: plots.figure_functions()[name](*made) for name in NAMES}


def legend(figure):
    drawn = [*figure.legends, *(axes.get_legend() for axes in figure.axes if axes.get_legend())]
    return [text.get_text() for one in drawn for text in one.get_texts()]


def curve(axes, label):
    """The data (t, y) of a curve by its label."""
    line = next(line for line in axes.lines if line.get_label() == label)
    return np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)


def test_what_is_shown(made):
    """Would catch markers of which there is no picture, as when only optical.csv counts."""
    assert plots.available_figures(*made) == NAMES
    lone = replace(made[0], sensors={})
    rest = tuple(name for name in NAMES if name not in ("innovations", "visibility"))
    assert plots.available_figures(lone, made[1]) == rest


@pytest.mark.parametrize("name", NAMES)
def test_figures_are_drawn(figures, tmp_path, name):
    """Would catch a figure that breaks, or lacks units, legend or band."""
    figure = figures[name]
    assert plots.save(figure, tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    for axes in figure.axes:
        labels = [axes.get_ylabel()] if name != "visibility" else [axes.get_xlabel()]
        assert all(label.endswith(")") for label in labels), labels
    if name in ("visibility", "innovations"):
        return
    assert "estimate" in legend(figure)
    assert ("encoder" in legend(figure)) == (name != "bias")
    assert name == "path" or {"2σ of the estimate", "no marker", "fewer than 3 markers"} <= set(
        legend(figure)
    )


@pytest.mark.parametrize("name", ["attitude", "position", "velocity", "rate", "bias", "path"])
def test_figures_without_truth(made, tmp_path, name):
    """Would catch a figure that needs an encoder."""
    figure = plots.figure_functions()[name](made[0], made[1].replace(encoder=None))
    plots.save(figure, tmp_path / "figure.png")
    assert "estimate" in legend(figure)
    assert "encoder" not in legend(figure)


@pytest.mark.parametrize(("name", "unit"), [("attitude", 0.6), ("position", 0.8)])
def test_markers_stand_where_they_were_taken(figures, name, unit):
    """Would catch dots at the time they arrived, 34 ms late: some 5 mm and 2 deg off here."""
    for row in range(3):
        t, error = curve(figures[name].axes[2 * row + 1], "pose of the markers")
        assert len(t) > 100
        assert np.median(np.abs(error)) < 0.5 * unit
    assert t[0] == 0.0
    assert not ((t > 1.5) & (t < 2.25)).any()


def test_what_is_missing_is_left_out(made, tmp_path):
    """Would catch limits that are not numbers: of a tracker's pose without position, of a marker that was
    never seen, of an encoder without positions."""
    estimate, recording = made
    raw = marker_pose.from_markers(recording.markers)
    tracker = replace(raw, position=np.full_like(raw.position, np.nan))
    encoder = replace(recording.encoder, position=None)
    never = estimate.sensors["marker_2"]
    never = jax.tree.map(lambda a: a[:0], vars(never))
    never = type(estimate.sensors["marker_2"])(**never)
    lacking = replace(estimate, sensors=estimate.sensors | {"marker_2": never})
    for name in NAMES:
        figure = plots.figure_functions()[name](
            lacking, recording.replace(optical=tracker, encoder=encoder)
        )
        plots.save(figure, tmp_path / "figure.png")


def test_stretches_without_pose(made):
    """Would catch shading of the wrong stretch, or one that a hole of one frame makes."""
    view = measurements.pose_measurements(*made)
    (lost,), (blind,) = view.lost, view.blind
    np.testing.assert_allclose(lost, (1.494, 2.25), atol=0.01)
    np.testing.assert_allclose(blind, (1.998, 2.25), atol=0.01)
    np.testing.assert_allclose(plots.longest_gap(made[1], made[0]), lost)
    seen = made[1].markers.visible.copy()
    seen[30], seen[130:] = False, False
    ends = made[1].replace(markers=replace(made[1].markers, visible=seen))
    (_, last) = measurements.pose_measurements(made[0], ends).blind
    np.testing.assert_allclose(last, (129 * 0.018, made[0].time[-1]), atol=1e-9)


def test_visibility_accounts_for_every_frame(made, figures):
    """Would catch a refused sample shown as used or hidden, or a frame counted twice."""
    frames = made[1].markers.time_ns - made[1].markers.latency_ns
    for name, record in single_markers.marker_sensors(*made).items():
        usage = single_markers._usage(frames, record)
        assert np.all(np.sum(usage, axis=0) == 1)
        at = made[1].markers.names.index(name)
        np.testing.assert_array_equal(usage.hidden, ~made[1].markers.visible[:, at])
        if name == "1":
            assert usage.refused[list(REFUSED)].all()
        account = made[0].account[f"marker_{name}"]
        assert usage.refused.sum() == account["gated"]
    texts = [text.get_text() for text in figures["visibility"].axes[0].texts]
    hidden = 100.0 * np.mean(~made[1].markers.visible, axis=0)
    assert all(f"{share:.1f} % hidden" in text for share, text in zip(hidden, texts, strict=True))


def test_innovations_show_what_was_refused(made, figures):
    """Would catch refused samples among the used ones, or a gate drawn in the wrong place."""
    axes = figures["innovations"].axes[1]
    t, refused = curve(axes, "NIS, refused")
    assert np.isin(np.round(np.array(REFUSED) * 0.018, 6), np.round(t, 6)).all()
    _, used = curve(axes, "NIS, used")
    gate = curve(axes, "gate")[1][0]
    assert gate == pytest.approx(16.266, abs=1e-3)  # chi-square, 3 degrees of freedom, 99.9 %
    assert used.max() < gate < refused.min()


def test_a_pose_is_told_of_the_origin():
    """Would catch a latency added instead of taken off, or the tool's point taken for the body's origin."""
    turned = np.array([[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]])  # x to y
    raw = Optical(
        np.array([5_000]),
        turned,
        np.ones(1, bool),
        np.array([[1.0, 2.0, 3.0]]),
        p_body_tool=np.array([0.5, 0.0, 0.0]),
        latency_ns=1_000,
    )
    plain = measurements.at_origin(raw)
    assert plain.time_ns[0] == 4_000
    np.testing.assert_allclose(plain.position, [[1.0, 1.5, 3.0]], atol=1e-12)
    assert (plain.latency_ns, plain.p_body_tool) == (0, None)


def test_angles_stay_on_the_turn_of_the_estimate():
    """Would catch dots a whole turn off the curve after a gap in which the tool turned on."""
    t = np.linspace(0.0, 10.0, 101)
    yaw = 100.0 * t
    half = np.deg2rad(yaw) / 2.0
    q = np.stack([np.cos(half), 0.0 * t, 0.0 * t, np.sin(half)], axis=1)
    some = np.r_[0:20, 80:101]
    shown = attitudes.same_turn(q[some], t[some], t, attitudes.euler_deg(q))
    np.testing.assert_allclose(shown[:, 2], yaw[some], atol=1e-9)


def test_true_velocity():
    """Would catch a velocity of one step taken for two, or one across a gap."""
    t = np.r_[0:100, 150:200] * 10_000_000
    s = t / 1e9
    position = np.stack([s**2, np.sin(s), -3.0 * s], axis=1)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    yes = np.ones(len(t), bool)
    asked = t[10:90] + 3_000_000
    got = encoder_velocity_at(Encoder(t, still, yes, yes, position), asked)
    at = asked / 1e9
    np.testing.assert_allclose(got[:, 0], 2.0 * at, atol=1e-9)
    np.testing.assert_allclose(got[:, 1], np.cos(at), atol=1e-4)
    np.testing.assert_allclose(got[:, 2], -3.0, atol=1e-9)
    across = np.array([1_200_000_000])
    assert np.isnan(encoder_velocity_at(Encoder(t, still, yes, yes, position), across)).all()
    assert np.isnan(encoder_velocity_at(Encoder(t, still, yes, yes), asked)).all()
