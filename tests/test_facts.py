"""Facts of a run whose meaning is fixed, in a folder, HDF5 and NPZ: `field_ref` beside `gravity_ref`."""

import tomllib

import h5py
import numpy as np
import pytest
import tomli_w

import jaxekf
from jaxekf._support.errors import RecordingError
from jaxekf.recordings.types import Imu, Recording

FORMS = ["run", "run.h5", "run.npz"]
NORTH_WEST_UP = {"gravity_ref": [0.0, 0.0, -9.81], "field_ref": [19.8, 0.1, -44.7]}


def run(**info):
    """Half a second at rest."""
    still = np.zeros((50, 3))
    force, field = (np.tile(vector, (50, 1)) for vector in ([0.0, 0.0, 9.81], [19.8, 0.1, -44.7]))
    return Recording("run", imu=Imu(np.arange(50) * 10_000_000, still, force, field), info=info)


def state(path, text, **entries):
    """Puts entries among the facts of a saved run, `text` of it as it stands in TOML."""
    if path.is_dir():
        file = path / "recording.toml"
        file.write_text(tomli_w.dumps(entries) + text + "\n" + file.read_text())
    elif path.suffix == ".h5":
        with h5py.File(path, "a") as file:
            file.attrs["info"] = tomli_w.dumps(entries) + text
            del file.attrs["sha256"]
    else:
        with np.load(path) as old:
            arrays = dict(old)
        del arrays["sha256"]
        np.savez(path, **arrays | {"info": tomli_w.dumps(entries) + text})


@pytest.mark.parametrize("form", FORMS)
def test_facts_come_back_exactly(tmp_path, form):
    """A field lost on disk, made a unit vector, or turned to whole numbers on its way."""
    known = run(**NORTH_WEST_UP)
    again = jaxekf.load(jaxekf.save(known, tmp_path / form))
    assert {key: again.info[key] for key in NORTH_WEST_UP} == NORTH_WEST_UP
    for other in FORMS:
        path = jaxekf.save(again, tmp_path / f"again_{other}")
        assert {key: jaxekf.load(path).info[key] for key in NORTH_WEST_UP} == NORTH_WEST_UP
    assert "field_ref" not in jaxekf.load(jaxekf.save(run(), tmp_path / f"bare_{form}")).info


@pytest.mark.parametrize("form", FORMS)
def test_facts_are_lists_of_floats(tmp_path, form):
    """Whole numbers or arrays that what reads them, or TOML, does not take."""
    path = jaxekf.save(run(), tmp_path / form)
    state(path, "", field_ref=[1, 0, -2])
    found = jaxekf.load(path).info["field_ref"]
    assert found == [1.0, 0.0, -2.0] and all(type(number) is float for number in found)
    array = run(field_ref=np.array([0.0, 1.0, -2.0]), gravity_ref=(0, 0, -10))
    info = jaxekf.load(jaxekf.save(array, tmp_path / f"array_{form}")).info
    assert (info["field_ref"], info["gravity_ref"]) == ([0.0, 1.0, -2.0], [0.0, 0.0, -10.0])


WRONG = {
    "no direction": "[0.0, 0.0, 0.0]",
    "a number": "48.0",
    "two numbers": "[1.0, 0.0]",
    "four numbers": "[1.0, 0.0, 0.0, 0.0]",
    "a word": '"north"',
    "words": '["1", "0", "0"]',
    "truth": "[true, false, false]",
    "infinite": "[inf, 0.0, 0.0]",
    "not a number": "[nan, 0.0, 0.0]",
    "nested": "[[1.0, 0.0, 0.0]]",
}


@pytest.mark.parametrize("key", NORTH_WEST_UP)
@pytest.mark.parametrize("form", FORMS)
def test_wrong_facts_are_refused(tmp_path, form, key):
    """A value that gives NaN far away, or a traceback without the entry's name and place."""
    for name, text in WRONG.items():
        path = jaxekf.save(run(), tmp_path / name.replace(" ", "_") / form)
        state(path, f"{key} = {text}")
        with pytest.raises(RecordingError, match="3 finite numbers, not all 0") as caught:
            jaxekf.load(path)
        message = str(caught.value)
        assert f"{key} = {tomllib.loads(f'x = {text}')['x']!r}" in message and "\n" not in message
        assert caught.value.column == key
        assert str(path) in message


@pytest.mark.parametrize("form", FORMS)
def test_no_wrong_fact_is_saved(tmp_path, form):
    """A run that could not be read again, or half of one left behind."""
    for value in ([0.0, 0.0, 0.0], [1.0, np.nan, 0.0], "north", None):
        with pytest.raises(RecordingError, match="field_ref"):
            jaxekf.save(run(field_ref=value), tmp_path / form)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("misspelt", "meant"),
    [("field_rf", "field_ref"), ("fieldref", "field_ref"), ("gravity_reff", "gravity_ref")],
)
def test_a_misspelt_name_is_told(tmp_path, misspelt, meant):
    """North taken for y because nobody read what is stated, or a folder written that is not read again."""
    path = jaxekf.save(run(), tmp_path / "run")
    state(path, "", **{misspelt: [1.0, 0.0, 0.0]})
    with pytest.raises(RecordingError) as caught:
        jaxekf.load(path)
    assert f"got {misspelt}, expected {meant};" in str(caught.value)
    assert caught.value.column == misspelt
    with pytest.raises(RecordingError, match=f"got {misspelt}, expected {meant};"):
        jaxekf.save(run(**{misspelt: [1.0, 0.0, 0.0]}), tmp_path / "never")
    assert not (tmp_path / "never").exists()


def test_a_fact_of_ones_own_is_none_of_these(tmp_path):
    """A name that is forbidden for being somewhat alike."""
    own = {"field_site": "yard", "reference": [1, 2]}
    info = jaxekf.load(jaxekf.save(run(**own), tmp_path / "run")).info
    assert {key: info[key] for key in own} == own
