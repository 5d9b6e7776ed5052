"""Types of arguments: everything that is an array gives the result of a float64 array, or one sentence."""

import inspect
from dataclasses import fields, is_dataclass, replace

import jax
import numpy as np
import pytest
from scenario import recording

import jaxekf
import tuning
from jaxekf.calibration import allan, noise_densities
from jaxekf.filtering import arguments
from jaxekf.pose_solvers import marker_pose
from jaxekf.recordings.types import PlainStream, Samples
from jaxekf.simulation import camera_runs
from tuning.parametrisation.free_vector import initial_parameters

RUN = recording(1)
LOOSE = jaxekf.get_model("loose")


def exact(array):
    """Floats that float32 holds exactly, so that a conversion changes nothing."""
    return np.asarray(array, np.float32).astype(float)


class Column:
    """An object that is an array by the protocol alone, as a column of pandas is."""

    def __init__(self, array):
        self.array = array

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.array, dtype)


def variants(array):
    """The same numbers in other forms."""
    frozen = array.copy()
    frozen.flags.writeable = False
    yield "frozen", frozen
    yield "strided", np.repeat(array, 2, axis=0)[::2] if array.ndim else array
    yield "fortran", np.asfortranarray(array)
    yield "swapped", array.astype(array.dtype.newbyteorder())
    yield "list", array.tolist()
    yield "objects", array.astype(object)
    yield "column", Column(array)
    yield "without a mask", np.ma.array(array)
    if array.dtype == float:
        yield "float32", array.astype(np.float32)
        yield "on a device", jax.numpy.asarray(array)
    if array.dtype == np.int64:
        yield "datetime64", array.astype("M8[ns]")
        yield "uint64", array.astype(np.uint64)
    if array.dtype == bool:
        yield "0 and 1", array.astype(int)
        yield "0.0 and 1.0", array.astype(float)


def wrong(array):
    """Other things in place of the numbers."""
    yield "texts", np.full(array.shape, "much")
    yield "complex", array.astype(complex) + 0.5j
    yield "masked", np.ma.array(array, mask=np.ones(array.shape, bool))
    yield "ragged", [[1.0], [1.0, 2.0]]
    yield "an object", object()
    if array.dtype == np.int64:
        yield "float times", array.astype(float)
        yield "times beyond int64", np.full(array.shape, 2**63, np.uint64)
        yield "no time", np.full(array.shape, "NaT", "M8[ns]")
    if array.dtype == bool:
        yield "neither 0 nor 1", np.full(array.shape, 0.5)


def streams():
    """Streams of every class, whose floats survive float32."""
    plain = PlainStream(RUN.imu.time_ns, {"force": RUN.imu.accelerometer})
    optical = replace(RUN.optical, p_body_tool=np.zeros(3), error=np.zeros(len(RUN.optical.valid)))
    encoder = jaxekf.Encoder(
        *(getattr(RUN.optical, n) for n in ("time_ns", "q_ref_body", "valid", "valid"))
    )
    samples = Samples(RUN.imu.time_ns, RUN.imu.gyroscope, np.ones(len(RUN.imu.time_ns), bool))
    return [optical, RUN.imu, encoder, RUN.markers, RUN.camera, plain, samples]


def content(node):
    """Every array of a result."""
    if is_dataclass(node):
        node = {f.name: getattr(node, f.name) for f in fields(node)}
    return [np.asarray(leaf) for leaf in jax.tree.leaves(node) if not isinstance(leaf, str)]


def check(call, array):
    """`call` gives the same for every variant of `array`, and a sentence for what is none."""
    expected = content(call(array))
    for name, given in variants(array):
        for a, b in zip(content(call(given)), expected, strict=True):
            # Sums over another order of the axes differ in the last bit.
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-15, err_msg=name)
            assert a.dtype == b.dtype, name
    for name, given in wrong(array):
        with pytest.raises(jaxekf.JaxekfError) as caught:
            call(given)
            pytest.fail(f"{name} were accepted")
        text = str(caught.value)
        assert "\n" not in text, name
        assert "got " in text, name
        assert "expected " in text, name


@pytest.mark.parametrize("stream", streams(), ids=lambda stream: type(stream).__name__)
def test_streams_convert_or_refuse(stream):
    """Would catch float32 attitudes that end in a TypeError of JAX, lists in an IndexError, and float times
    that are cut to whole nanoseconds in silence."""
    for field in fields(stream):
        value = getattr(stream, field.name)
        if field.name == "values":
            call = lambda force: PlainStream(stream.time_ns, {"force": force})  # noqa: E731
            check(call, exact(value["force"]))
        elif isinstance(value, np.ndarray):
            value = exact(value) if value.dtype == float else value
            check(lambda given, name=field.name: replace(stream, **{name: given}), value)


def test_streams_without_other_types_are_not_copied():
    """Would catch a copy of every array at every step of reading a recording."""
    for stream in streams():
        again = replace(stream)
        for field in fields(stream):
            if isinstance(getattr(stream, field.name), np.ndarray):
                assert getattr(again, field.name) is getattr(stream, field.name)


def test_a_wrong_shape_is_refused_where_it_is_given():
    """Would catch quaternions of three numbers that fail deep inside the filter."""
    with pytest.raises(jaxekf.RecordingError, match=r"optical:q_ref_body: .*shape \(N, 4\)"):
        replace(RUN.optical, q_ref_body=np.zeros((10, 3)))
    with pytest.raises(jaxekf.RecordingError, match=r"imu:gyroscope: .*shape \(N, 3\)"):
        jaxekf.Imu(np.arange(5), np.zeros(5))
    with pytest.raises(jaxekf.RecordingError, match="imu:gyroscope: got None, expected a value"):
        replace(RUN.imu, gyroscope=None)
    with pytest.raises(jaxekf.RecordingError, match=r"optical:latency_ns: .*a whole number"):
        replace(RUN.optical, latency_ns=1.5e6)
    assert type(replace(RUN.optical, latency_ns=np.int32(5)).latency_ns) is int


def with_noise(optical):
    return LOOSE.parameters._replace(noise=LOOSE.parameters.noise._replace(optical=optical))


DEVIATIONS = exact([0.01, 0.02, 0.03])
LINE = jaxekf.timeline.build(LOOSE, RUN)
TIMES = RUN.imu.time_ns[5:20]
STATIC = exact(np.random.default_rng(3).standard_normal((400, 3)))


def put(stream, **given):
    """A sample put into a new live stream, and what it then holds."""
    belief = jaxekf.initial_belief(LOOSE, LOOSE.parameters, LINE.first)
    live = jaxekf.Stream(LOOSE, LOOSE.parameters, belief, 0)
    if "rate" in given:
        live.put_input(0, given["rate"])
        return live._values
    live.put("optical", 0, given["attitude"])
    return live._samples[0]["optical"].value


def initial(optical):
    return jaxekf.initial_belief(LOOSE, with_noise(optical), LINE.first)


def steps_with(value):
    slow = {"optical": LINE.steps.slow["optical"]._replace(value=value)}
    belief = initial(DEVIATIONS)
    return arguments.for_filter(
        LOOSE, with_noise(DEVIATIONS), belief, LINE.steps._replace(slow=slow)
    )


# Calls with one array argument each, by the name of the public function.
CALLS = {
    "timeline": (lambda at: jaxekf.timeline.build(LOOSE, RUN, at=at).requested_ns, TIMES),
    "initial_belief": (initial, DEVIATIONS),
    "run_filter": (steps_with, exact(LINE.steps.slow["optical"].value)),
    "Stream.put_input": (lambda rate: put(None, rate=rate), exact([0.1, 0.2, 0.3])),
    "Stream.put": (lambda q: put(None, attitude=q), exact([1.0, 0.0, 0.0, 0.0])),
    "with_axes": (lambda a: tuning.with_axes(LOOSE, with_noise(a), "each"), DEVIATIONS),
    "scaled": (lambda a: tuning.scaled(with_noise(a), 2.0), DEVIATIONS),
    "layout": (
        lambda a: tuning.layout(LOOSE, with_noise(a)).to_free(with_noise(DEVIATIONS)),
        DEVIATIONS,
    ),
    "tune": (lambda a: initial_parameters(LOOSE, with_noise(a), None, None), DEVIATIONS),
    "sensor_noise": (lambda a: allan.sensor_noise(a, 0.01, "rad/s").curve.deviation, STATIC),
    "overlapping_deviation": (
        lambda a: allan.overlapping_deviation(a, np.array([1.0, 2.0])),
        STATIC[:, 0],
    ),
    "noise_densities.fit": (lambda a: noise_densities.fit(a, 0.01).white, STATIC[:, 0]),
    "absolute_orientation": (
        lambda a: marker_pose.absolute_orientation(
            RUN.markers.p_body_marker, a, RUN.markers.usable
        ),
        exact(RUN.markers.position),
    ),
    "camera_run": (
        lambda a: (
            camera_runs.camera_run(
                "eight", camera_runs.eight(), seed=1, duration_s=1.0, landmarks=a
            )[0].camera
        ),
        exact(camera_runs.scene(0, 40)),
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_functions_convert_or_refuse(name):
    """Would catch an Allan deviation that is summed in float32, and parameters given as lists that JAX
    takes for three parameters."""
    check(*CALLS[name])


def test_estimates_do_not_depend_on_types():
    """Would catch a type that is converted but not everywhere: the whole way from float32 and lists to the
    estimate, with one compiled program."""
    optical = replace(RUN.optical, q_ref_body=exact(RUN.optical.q_ref_body))
    run = RUN.replace(optical=optical, imu=replace(RUN.imu, gyroscope=exact(RUN.imu.gyroscope)))
    plain = jaxekf.estimate(run, params=with_noise(DEVIATIONS), at=TIMES)
    other = run.replace(
        optical=replace(optical, q_ref_body=optical.q_ref_body.astype(np.float32)),
        imu=replace(run.imu, gyroscope=run.imu.gyroscope.tolist()),
    )
    same = jaxekf.estimate(other, params=with_noise(DEVIATIONS.tolist()), at=TIMES.tolist())
    np.testing.assert_array_equal(same.cov, plain.cov)
    np.testing.assert_array_equal(same.attitude.value, plain.attitude.value)
    np.testing.assert_array_equal(same.requested.cov, plain.requested.cov)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: jaxekf.estimate(5), "run: got a value of type int, expected a jaxekf.Recording"),
        (lambda: jaxekf.estimate_many("free-1"), "runs: got one str, expected a sequence"),
        (lambda: jaxekf.estimate_many(RUN), "runs: got one Recording, expected a sequence"),
        (lambda: jaxekf.estimate(RUN, model=5), "a model of type int"),
        (lambda: jaxekf.estimate(RUN, params={"noise": 1}), "params: got a value of type dict"),
        (
            lambda: jaxekf.estimate(RUN, params=jaxekf.get_model("marg").parameters),
            "params: got noise of type Noise, expected Noise of model 'loose' .gyroscope",
        ),
        (
            lambda: jaxekf.estimate(RUN, params=with_noise([0.1, 0.2])),
            r"noise.optical of shape \(2,\)",
        ),
        (lambda: jaxekf.estimate(RUN, params=with_noise("small")), "params.noise.optical: got"),
        (lambda: jaxekf.estimate_many([RUN], at=0.5), "got requested times of type float"),
        (lambda: jaxekf.every("fast"), "seconds: got values of type <U4"),
        (lambda: jaxekf.every([0.1, 0.2]), "seconds: got an array of shape"),
        (lambda: jaxekf.Every(0.5), "period_ns: got 0.5 of type float"),
        (lambda: jaxekf.crop(RUN, "1"), "start_s: got values of type <U1"),
        (lambda: jaxekf.score(RUN, RUN), "estimate: got a value of type Recording"),
        (lambda: jaxekf.score(RUN, None), "recording: got a value of type NoneType"),
        (lambda: jaxekf.diagnose(RUN), "estimate: got a value of type Recording"),
        (lambda: tuning.tune(RUN), "runs: got one Recording"),
    ],
)
def test_other_things_are_refused_in_a_sentence(call, words):
    """Would catch an AttributeError, or a string that is read as a sequence of one-letter paths."""
    with pytest.raises(jaxekf.JaxekfError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


WITHOUT_ARRAYS = {
    *("demo", "estimate_online", "get_model", "jit", "keep_programs", "load", "load_parameters"),
    *("read_export", "robust", "save", "save_parameters", "set_up", "split_at_gaps"),
    *("attitude_error", "compare", "cross_validate", "evaluate", "fit_runs", "forget_folds"),
    *("innovation_likelihood", "mean_by_variant", "prepare", "rate_error", "read_free"),
    *("save_record", "tune_by_coordinates", "tune_by_nelder_mead"),
}
"""Functions whose arrays are those of recordings, parameters or estimates."""
TESTED_ABOVE = {"crop", "diagnose", "diagnose_many", "estimate", "estimate_many", "every", "score"}


def test_no_public_function_is_forgotten():
    """Would catch a new public function whose arrays nobody tries."""
    like = {name for name in jaxekf.__all__ if name.startswith("run_")}
    known = {*CALLS, *WITHOUT_ARRAYS, *TESTED_ABOVE, *like}
    for package in (jaxekf, tuning):
        functions = {n for n in package.__all__ if inspect.isroutine(getattr(package, n))}
        assert functions <= known
