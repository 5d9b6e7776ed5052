"""The live estimator against a batch of what had arrived, sample by sample."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from test_tight import COARSE, matched, run, until

import jaxekf
from jaxekf._support.errors import ModelError
from jaxekf.estimation import timeline
from jaxekf.estimation.live import Stream
from jaxekf.models import tight


def live(one, **options):
    """A stream that starts where the batch does, and its events in the order of arrival."""
    model = tight.adapt([one])
    line = timeline.build(model, one)
    params = matched()._replace(setup=line.setup)
    start = int(line.time_ns[0, -1])
    belief = jaxekf.initial_belief(model, params, line.first)
    imu, markers = one.imu, one.markers
    values = np.c_[imu.gyroscope, imu.accelerometer]
    events = [(int(t), 1, ("imu", i)) for i, t in enumerate(imu.time_ns)]
    events += [(int(t), 0, ("markers", i)) for i, t in enumerate(markers.time_ns)]

    def put(stream, event):
        kind, i = event
        if kind == "imu":
            stream.put_input(int(imu.time_ns[i]), values[i])
            return
        for j, name in enumerate(markers.names):
            if markers.visible[i, j]:
                taken = int(markers.time_ns[i]) - markers.latency_ns
                stream.put(tight.sensor_name(name), taken, markers.position[i, j])

    return Stream(model, params, belief, start, **options), sorted(events), put


@pytest.mark.parametrize(
    ("latency_s", "shift_ns"), [(0.0, 0), (0.0, 2_500_000), (0.036, 1_100_000)]
)
def test_stream_is_a_batch_of_what_had_arrived(latency_s, shift_ns):
    """A frame that is lost, used twice or at the wrong time; a final belief taken too early; an input
    interpolated with what had not come yet."""
    grade = replace(COARSE, latency_s=latency_s)
    one = run(9, duration_s=1.0, grade=grade, hidden=[("2", 0.5, 0.8)])
    # Frames between the samples of the IMU: what is interpolated there is known only later.
    shifted = replace(one.markers, time_ns=one.markers.time_ns + shift_ns)
    one = one.replace(markers=shifted)
    stream, events, put = live(one)
    asked = {int(one.imu.time_ns[i]) for i in (22, 23, 150)}
    compared = 0
    for instant, _, event in events:
        put(stream, event)
        if event[0] != "imu" or instant not in asked:
            continue
        known = stream.known()
        batch = jaxekf.estimate(until(one, instant), "tight", matched())
        assert known.time_ns == batch.time_ns[-1] == instant
        for a, b in zip(
            jax.tree.leaves(known.belief.mean), jax.tree.leaves(batch.state), strict=True
        ):
            np.testing.assert_allclose(a, b[-1], rtol=0, atol=1e-10)
        np.testing.assert_allclose(known.belief.cov, batch.cov[-1], rtol=0, atol=1e-10)
        for name, (value, cov) in known.outputs.items():
            np.testing.assert_allclose(value, batch.outputs[name].value[-1], rtol=0, atol=1e-10)
            np.testing.assert_allclose(cov, batch.outputs[name].cov[-1], rtol=0, atol=1e-10)
        compared += 1
    assert compared == len(asked)
    assert not any(stream.dropped.values())


def test_asking_seldom_changes_nothing():
    """A window that overflows many times between questions; finality that depends on when one asks."""
    one = run(10, duration_s=6.0)
    often, events, put = live(one)
    seldom, _, _ = live(one)
    for i, (_, _, event) in enumerate(events):
        put(often, event)
        put(seldom, event)
        if event[0] == "imu" and i % 40 == 0 and i > 40:
            often.known()
    a, b = often.known().belief, seldom.known().belief
    assert len(events) > 2 * 256
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=1e-10), a, b)


def test_what_comes_too_late_is_dropped_and_counted():
    """A sample older than the horizon that moves a belief said to be final, or vanishes unseen."""
    one = run(11, duration_s=1.0)
    stream, events, put = live(one)
    without, _, _ = live(one)
    for _, _, event in events:
        put(stream, event)
        put(without, event)
    now = stream.known().time_ns
    without.known()
    assert not stream.put("marker_1", int(one.imu.time_ns[20]), np.ones(3))
    assert stream.dropped == {"marker_1": 1, "marker_2": 0, "marker_3": 0}
    # The second question starts where the first became final, so its last digits are its own.
    jax.tree.map(np.testing.assert_array_equal, stream.known().belief, without.known().belief)
    assert stream.put("marker_1", now - 50_000_000, one.markers.position[-1, 0])


def test_input_out_of_order_is_refused():
    """Time that runs backwards, or a question before there is anything to answer it with."""
    one = run(11, duration_s=1.0)
    stream, _, _ = live(one)
    with pytest.raises(ModelError, match="call known after more input"):
        stream.known()
    stream.put_input(10, np.zeros(6))
    with pytest.raises(ModelError, match="increase"):
        stream.put_input(10, np.zeros(6))


def test_nothing_is_made_up_in_a_gap():
    """A hole in the input bridged without a word: in its middle, or before its first sample."""
    one = run(9, duration_s=1.0)
    stream, _, _ = live(one)
    first = int(one.imu.time_ns[0])
    with pytest.raises(ModelError, match=r"0\.3\d\d s after"):
        stream.put_input(first + 350_000_000, np.zeros(6))
    for i in range(3):
        stream.put_input(first + 6_000_000 * i, np.zeros(6))
    with pytest.raises(ModelError, match="not extrapolated"):
        stream.put_input(first + 200_000_000, np.zeros(6))
    stream.put_input(first + 80_000_000, np.zeros(6))
