"""What a user holds can be pickled and copied, as `multiprocessing`, joblib and caches do."""

import copy
import pickle
from dataclasses import replace

import jax
import numpy as np
import pytest
from scenario import recording

import jaxekf
import tuning
from jaxekf.models import REGISTRY

RUN = recording(1)


def again(thing):
    return pickle.loads(pickle.dumps(thing))


def assert_same(a, b):
    """Two results hold the same models, arrays and texts."""
    assert type(a) is type(b)
    if isinstance(a, jaxekf.Model):
        assert a is b
    elif isinstance(a, np.ndarray | jax.Array):
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, dict):
        assert_same(list(a.items()), list(b.items()))
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    elif hasattr(a, "__dict__") and not isinstance(a, type) and not callable(a):
        assert_same(dict(vars(a)), dict(vars(b)))
    elif isinstance(a, float | int | str | None):
        assert a == b or a != a


@pytest.mark.parametrize("name", REGISTRY)
def test_a_model_stays_the_same_object(name):
    """Would catch a lambda of a model that cannot be pickled, and a second object of the same model, for
    which everything is compiled anew."""
    model = jaxekf.get_model(name)
    assert again(model) is model
    assert copy.deepcopy([model])[0] is model
    weighted = jaxekf.robust(name, "huber")
    assert again(weighted) is weighted
    if model.adapt is not None and name != "visual":
        made = model.adapt([RUN])
        assert again(made) is made
        assert again(jaxekf.robust(made, "gate")) is jaxekf.robust(made, "gate")
    changed = replace(model, name="mine")
    if not any(sensor.copies > 1 for sensor in model.sensors):
        restored = again([changed])[0]
        assert (restored.name, restored.sensors[0].name) == ("mine", changed.sensors[0].name)


HELD = replace(jaxekf.get_model("loose"), process_noise=lambda params, dt: 0.0)


def test_a_model_of_ones_own():
    """Would catch a model with lambdas that is refused although a module holds it, and a PicklingError that
    names neither the model nor a way out."""
    assert again(HELD) is HELD
    mine = replace(HELD, name="mine")
    with pytest.raises(
        jaxekf.ModelError, match=r"model 'mine'.*process_noise.*name of a module"
    ) as caught:
        pickle.dumps(mine)
    assert "\n" not in str(caught.value)
    assert copy.deepcopy(mine) is mine


def test_errors_pass_from_a_worker():
    """Would catch an error of a worker process that cannot be unpickled and hangs the pool."""
    error = jaxekf.RecordingError("run", "no file", "one", "another", line=3, column="time")
    found = again(error)
    assert (str(found), found.path, found.line, found.column) == (
        str(error),
        error.path,
        3,
        "time",
    )
    for cls in (jaxekf.ModelError, jaxekf.ArgumentError, jaxekf.TuningError):
        assert str(again(cls("got"))) == "got"


def test_results_can_be_pickled_and_copied():
    """Would catch a lambda, a lock or a view of a device in what an estimate, a diagnosis or a tuning
    holds."""
    estimate = jaxekf.estimate(RUN, "loose", at=RUN.imu.time_ns[5:9])
    encoder = jaxekf.Encoder(
        RUN.imu.time_ns, np.tile([1.0, 0.0, 0.0, 0.0], (31, 1)), *np.ones((2, 31), bool)
    )
    run = RUN.replace(encoder=encoder)
    tuned = tuning.tune(
        [run], objective="likelihood", free=["noise.optical"], iterations=1, rescale=False
    )
    things = [run, estimate, estimate.attitude, estimate.sensors["optical"], tuned]
    things += [
        jaxekf.score(estimate, run),
        jaxekf.diagnose(estimate),
        tuned.layout,
        HELD.parameters,
    ]
    for thing in things:
        assert_same(again(thing), thing)
        assert_same(copy.deepcopy(thing), thing)
