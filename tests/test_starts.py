"""Several starts side by side, and Adam on some runs at a time: the same problem, other ways down."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import optax
import pytest

import jaxekf
import tuning
from jaxekf._support.errors import TuningError
from jaxekf.estimation.parameters import as_arrays
from jaxekf.simulation import attitude_runs
from tuning.objective.data import prepare_groups
from tuning.parametrisation.free_vector import layout
from tuning.parametrisation.truth_frame import no_correction
from tuning.persistence import checkpoint
from tuning.results.tuned import Iteration
from tuning.search import _minibatch as minibatch
from tuning.search import multistart, optimisers
from tuning.search._minibatch import MinibatchDescent, cut
from tuning.search.descent import Best, Descent

OPTIONS: dict[str, Any] = {"objective": "likelihood", "free": ["noise"], "iterations": 40}
MODEL = jaxekf.get_model("loose")


@pytest.fixture(scope="module")
def runs():
    """Three short runs; the start that all tests have is far off."""
    return [
        attitude_runs.recording(
            f"run-{i}", attitude_runs.free_motion(i, rest_s=0.2), seed=i, duration_s=6.0
        )
        for i in range(3)
    ]


@pytest.fixture(scope="module")
def start():
    noise = MODEL.parameters.noise
    return as_arrays(
        MODEL.parameters._replace(
            noise=noise._replace(gyroscope=8.0 * noise.gyroscope, optical=0.2 * noise.optical)
        )
    )


@pytest.fixture(scope="module")
def alone(runs, start):
    return tuning.tune(runs, start=start, **OPTIONS)


@pytest.fixture(scope="module")
def race(runs, start):
    return tuning.tune(runs, start=start, starts=4, **OPTIONS)


def test_each_start_goes_its_own_way(alone, race):
    """Would catch runs of one start that come into the objective of another, and a search that depends on
    what runs beside it."""
    assert len(race.starts) == 4
    assert race.best.training <= min(one.value for one in race.starts)
    assert race.best.training == min(one.value for one in race.starts)
    # The given start goes down just as it does alone, until it is dropped or has ended.
    first = race.starts[0]
    best = min(step.training for step in alone.history[: first.iterations])
    assert first.value == pytest.approx(best, abs=1e-6)
    assert race.best.training <= alone.best.training + 1e-4


def test_bad_starts_are_dropped(race):
    """Would catch starts that all run to the end, so that eight cost eight times as much as one."""
    dropped = [one for one in race.starts if one.ending.startswith("dropped after 8")]
    assert dropped
    assert all(one.iterations == 8 for one in dropped)
    # At the end each of the three deviations is tried larger once.
    assert race.evaluations == sum(one.iterations for one in race.starts) + 3


def test_the_worse_half_is_dropped():
    """Would catch the better half being dropped, and one that stopped at a bad place driving out others."""

    def search(value, stopped=""):
        step = Iteration(7, value, float("nan"), False)
        return SimpleNamespace(
            best=Best(None, step), selection_value=lambda s: s.training, stopped=stopped
        )

    values = [3.0, 1.0, 2.0, 5.0, 4.0, 6.0]
    one: Any = [search(value, "converged" if value in (1.0, 6.0) else "") for value in values]
    found = multistart.MultiStart(one, round=8)
    found._drop_half()
    assert set(found.dropped) == {3, 4}
    assert found.running == [0, 2]
    assert found.winner is one[1]


def test_the_winner_stays_the_winner():
    """Would catch a tuning that was stopped and goes on with a start that had lost: the winner, judged anew
    with numbers held at their start, looks worse than one that is out."""

    def search(value):
        step = Iteration(7, value, float("nan"), False)
        return SimpleNamespace(
            best=Best(None, step),
            selection_value=lambda s: s.training,
            stopped="converged",
            state_dict=dict,
            restore=lambda kept: None,
        )

    one: Any = [search(2.0), search(1.0)]
    found = multistart.MultiStart(one)
    assert found.run(15, None) is one[1]
    one[1].best = Best(None, Iteration(9, 3.0, float("nan"), False))
    again = multistart.MultiStart(one)
    again.restore(found.state_dict())
    assert again.run(15, None) is one[1]


def test_a_drawn_start_that_cannot_be_warmed_is_kept():
    """Would catch one impossible start that ends the tuning of all; the given start's fault is told."""

    def fails(*_):
        raise TuningError("got nothing finite")

    good: Any = SimpleNamespace(history=[], warm=lambda *_: None)
    bad: Any = SimpleNamespace(history=[], warm=fails)
    multistart.MultiStart([good, bad]).warm(3)
    with pytest.raises(TuningError):
        multistart.MultiStart([bad, good]).warm(3)


def test_starts_are_drawn_within_their_reach(runs):
    """Would catch starts so far off that none of them helps, or all at one place."""
    free = [
        "noise",
        tuning.Free("initial.bias", prior=0.1),
        "calibration.clock_offset",
        "truth.origin",
    ]
    base = as_arrays(MODEL.parameters)._replace(truth=no_correction())
    where = layout(MODEL, base, free)
    middle = np.asarray(where.to_free(base))
    drawn = np.array(multistart.draw(where, middle, 200, seed=3)) - middle
    np.testing.assert_array_equal(drawn[0], 0.0)
    reach = np.abs(drawn).max(axis=0)
    labels = where.labels()
    for i, label in enumerate(labels):
        most = {"noise": 1.5 * np.log(10.0), "initial": 0.15, "calibration": 5.0, "truth": 0.0}
        limit = most[label.split(".")[0]]
        assert 0.9 * limit <= reach[i] <= limit, label
    again = np.array(multistart.draw(where, middle, 200, seed=3)) - middle
    np.testing.assert_array_equal(drawn, again)


def test_a_start_without_a_finite_objective_begins_nearer(runs, start):
    """Would catch one impossible start that ends the tuning of all, or is passed over."""
    where = layout(MODEL, start, OPTIONS["free"])
    groups = prepare_groups(MODEL, runs, need_truth=False)
    aim = tuning.innovation_likelihood()
    made = [Descent(MODEL, aim, where, start, groups, None, 40, width=4) for _ in range(4)]
    middle = made[0].start
    made[1].begin_at(middle + 1500.0)
    made[2].begin_at(np.full_like(middle, np.nan))
    made[3].begin_at(middle + 1.0)
    found = multistart.MultiStart(made)
    for _ in range(6):
        found._round(patience=15)
    assert found.outcomes[1].value < np.inf
    assert "not finite" in found.outcomes[2].ending
    assert found.outcomes[2].value == np.inf
    assert found.outcomes[0].iterations == 6


class Stop(Exception):
    """Stands for a process that ends."""


def stop_at(number):
    def progress(step, total):
        if step.number == number:
            raise Stop

    return progress


@pytest.mark.parametrize("how", ["starts", "adam"])
def test_goes_on_after_a_stop(how, runs, start, race, tmp_path):
    """Would catch a part of the state that is not kept: who is dropped, Adam's moments, the rate."""
    options: dict[str, Any] = {**OPTIONS, "start": start}
    options |= {"starts": 4} if how == "starts" else {"optimiser": tuning.Adam(batch=2)}
    whole = race if how == "starts" else tuning.tune(runs, **options)
    state = tmp_path / "state.npz"
    for number in (5, 11):
        with pytest.raises(Stop):
            tuning.tune(runs, checkpoint=state, progress=stop_at(number), **options)
    again = tuning.tune(runs, checkpoint=state, **options)
    assert not state.exists()
    np.testing.assert_allclose(again.free, whole.free, rtol=0.0, atol=1e-12)
    assert str(again.history) == str(whole.history)
    assert again.starts == whole.starts


@pytest.mark.parametrize("after", [3, 9])
def test_goes_on_after_a_stop_in_the_warm_steps(after, runs, start, tmp_path, monkeypatch):
    """Would catch warm steps that begin anew after a stop in the middle of them, or right after them."""
    options: dict[str, Any] = {**OPTIONS, "start": start, "warm": True, "iterations": 2}
    steps, write = [], checkpoint.write

    def stopping(*given):
        write(*given)
        steps.append(1)
        if len(steps) == after:
            raise Stop

    monkeypatch.setattr(checkpoint, "write", stopping)
    state = tmp_path / "state.npz"
    with pytest.raises(Stop):
        tuning.tune(runs, checkpoint=state, **options)
    again = tuning.tune(runs, checkpoint=state, **options)
    whole = tuning.tune(runs, **options)
    np.testing.assert_allclose(again.free, whole.free, rtol=0.0, atol=1e-12)
    assert (again.filterings, again.evaluations) == (whole.filterings, whole.evaluations)


def test_batches_come_to_the_same_place(runs, start, alone):
    """Would catch a gradient of some runs that is not that of the whole on average, a rate that never
    falls, and a best that was not judged on all runs."""
    longer: dict[str, Any] = OPTIONS | {"iterations": 80}
    tuned = tuning.tune(runs, start=start, optimiser=tuning.Adam(batch=2), **longer)
    assert tuned.best.training <= alone.best.training + 5e-3
    assert tuned.best.training == min(step.training for step in tuned.history)
    assert tuned.best.training < tuned.history[0].training - 0.1


def test_each_pass_takes_every_run(runs):
    """Would catch runs that are left out of a pass, and an order that is always the same."""
    data = prepare_groups(MODEL, runs, need_truth=False)[0]
    rng = np.random.default_rng(0)
    orders = [[batch.chosen for batch in cut(data, 2, rng)] for _ in range(5)]
    for order in orders:
        assert [len(batch) for batch in order] == [2, 2]
        assert set(np.concatenate(order)) == {0, 1, 2}
    assert len({tuple(np.concatenate(order)) for order in orders}) > 1
    assert [len(batch.chosen) for batch in cut(data, 16, rng)] == [3]


def test_the_batches_of_a_pass_are_all_runs(runs, start):
    """Would catch a run that counts twice because it fills a batch, and batches weighted otherwise than by
    their rows: Adam would end elsewhere than at the minimum for all runs."""
    where = layout(MODEL, start, OPTIONS["free"])
    groups = prepare_groups(MODEL, runs, need_truth=False)
    search = MinibatchDescent(
        MODEL, tuning.innovation_likelihood(), where, start, groups, None, 3, size=2
    )
    search.free = search.free + 0.3
    parts = cut(groups[0], 2, np.random.default_rng(0))
    each = [search.slope(groups[0], batch, len(parts)) for batch in parts]
    whole = np.asarray(search.value_and_gradient(search.free)[1])
    np.testing.assert_allclose(np.mean(each, axis=0), whole, rtol=1e-8)
    assert np.abs(each[0] - whole).max() > 1e-3 * np.abs(whole).max()


def test_goes_on_in_the_middle_of_a_pass(runs, start, monkeypatch):
    """Would catch a pass that begins again after a stop, or whose beginning is judged twice."""
    where = layout(MODEL, start, OPTIONS["free"])
    groups = prepare_groups(MODEL, runs, need_truth=False)
    given = MODEL, tuning.innovation_likelihood(), where, start, groups, None, 4
    whole = MinibatchDescent(*given, size=2)
    whole.run(15, None)
    monkeypatch.setattr(minibatch, "KEEP_S", -1.0)
    kept = []
    stopped = MinibatchDescent(*given, size=2, keep=lambda state: kept.append(state))
    stopped.run(15, None)
    middle = next(state for state in kept[2:] if state["batches_done"] == 1)
    again = MinibatchDescent(*given, size=2)
    again.restore(middle)
    again.run(15, None)
    np.testing.assert_array_equal(again.free, whole.free)
    assert str(again.history) == str(whole.history)


def test_a_pass_that_fails_is_repeated_from_the_best(runs, start):
    """Would catch Adam walking on from where nothing is finite."""
    where = layout(MODEL, start, OPTIONS["free"])
    groups = prepare_groups(MODEL, runs, need_truth=False)
    aim = tuning.innovation_likelihood()
    search = MinibatchDescent(MODEL, aim, where, start, groups, None, 3, size=2)
    search.rate = 2000.0
    search.run(15, None)
    assert [step.rejected for step in search.history] == [False, True, True]
    assert search.best is not None
    np.testing.assert_array_equal(search.best.free, search.start)
    assert search.rate == pytest.approx(2000.0 / 16.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"starts": 0}, "0 starts"),
        ({"optimiser": tuning.Adam(), "starts": 2}, "2 starts with adam"),
    ],
)
def test_what_does_not_go_together_is_refused(options, words, runs):
    """Would catch an option that is passed over in silence."""
    with pytest.raises(TuningError, match=words):
        tuning.tune(runs, **options)


@pytest.mark.parametrize(
    ("name", "batch", "words"),
    [("sgd", None, "one of optax"), ("lbfgs", 4, "another optimiser"), ("adam", 0, "batches of 0")],
)
def test_names_of_optimisers(name, batch, words):
    """Would catch a name or a batch of the command line that is passed over in silence."""
    with pytest.raises(TuningError, match=words):
        optimisers.from_name(name, batch)
    assert optimisers.from_name("adam", 3) == tuning.Adam(batch=3)


def test_old_arguments_of_the_optimiser_work_for_one_release():
    """Would catch a script of the last release that breaks, or one that nobody warns."""
    with pytest.warns(DeprecationWarning, match=r"optimiser=tuning\.FisherScoring\(\)"):
        assert optimisers.as_optimiser("fisher") == tuning.FisherScoring()
    with pytest.warns(DeprecationWarning, match=r"tuning\.Adam\(batch=2\)"):
        assert optimisers.as_optimiser("adam", 2) == tuning.Adam(batch=2)


def test_a_state_belongs_to_one_optimiser():
    """Would catch a tuning that goes on from the state of another optimiser, or one that never goes on."""
    every = tuning.LBFGS(), tuning.FisherScoring(), tuning.Adam(), tuning.Adam(batch=3)
    own = [optimisers.as_optimiser(optax.sgd(rate)) for rate in (0.1, 0.2)]
    assert len({repr(one) for one in (*every, own[0])}) == 5
    assert repr(own[0]) == repr(own[1])
