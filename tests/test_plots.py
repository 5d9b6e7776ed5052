"""Pictures: drawn without a warning, with units, legends and bands, for runs with and without truth."""

import pytest

import jaxekf
from jaxekf.reporting import plots
from jaxekf.simulation import demo


@pytest.fixture(scope="module")
def made():
    record = jaxekf.load(demo.FOLDER / "constant-rate")
    return jaxekf.estimate(record), record


LOOSE = ("attitude", "bias", "occlusion", "path", "rate")


def test_what_a_model_of_attitude_shows(made):
    """Would catch a figure of what the model does not have, or one that is left out."""
    assert plots.available_figures(*made) == LOOSE
    alone = tuple(name for name in LOOSE if name != "occlusion")
    assert plots.available_figures(made[0], made[1].replace(optical=None)) == alone


@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.parametrize("name", LOOSE)
def test_figures_are_drawn(made, tmp_path, name, truth):
    """Would catch a figure that breaks without an encoder, or lacks units, legend or band."""
    estimate, record = made
    if not truth:
        record = record.replace(encoder=None)
    figure = plots.figure_functions()[name](estimate, record)
    file = plots.save(figure, tmp_path / f"{name}.png")
    assert file.read_bytes().startswith(b"\x89PNG")
    axes = figure.axes
    labels = [axis.get_ylabel() for axis in axes]
    assert all("(deg" in label or "(mm)" in label for label in labels)
    drawn = [*figure.legends, *(axis.get_legend() for axis in axes if axis.get_legend())]
    legends = [text.get_text() for legend in drawn for text in legend.get_texts()]
    assert "estimate" in legends
    assert ("encoder" in legends) == (truth and name != "bias")
    if name != "path":
        assert any(axis.collections for axis in axes)


def test_longest_gap_is_found(made):
    """Would catch a close-up of the wrong stretch."""
    begin, end = plots.longest_gap(made[1], made[0])
    assert begin == pytest.approx(15.984, abs=0.01)
    assert end == pytest.approx(16.512, abs=0.01)
