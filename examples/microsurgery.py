"""An instrument in a surgeon's hand: attitude from accelerometers and a magnetometer, without a gyroscope.

    python examples/microsurgery.py [--minutes 30] [--seed 0] [--output FIGURE.png] [--smoke]

The simulated system of Ang, Khosla and Riviere at 500 Hz has a magnetometer and three dual-axis
accelerometers, whose differences give the rate and whose mean gives the vertical. The model `triad` filters
it, with noise from data sheets, the geometry of the array and the acceleration of the hand: nothing is
tuned. The result is compared with the integrated rate alone and with TRIAD alone. A second run, in which
the hand rotates but does not accelerate, shows whether the filter is consistent.

Half an hour, 900,000 steps, is filtered in one piece and needs about 4 GB of memory.

The last line of the output is JSON; the exit status is 1 if an expected value is missed. With --smoke half
a minute is estimated, and nothing is checked.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from rich.progress import Progress

import jaxekf
from jaxekf.evaluation import consistency, metrics
from jaxekf.geometry import rotation
from jaxekf.models import triad
from jaxekf.recordings.types import Flags, Floats
from jaxekf.reporting.plots import style
from jaxekf.simulation import gyro_free_runs
from jaxekf.simulation.marker_runs import ToolMotion

GRADE = gyro_free_runs.SurgeryGrade()
PART_S = 300.0
"""Length of the first and the last part of a run, which are compared; at most a third of the run."""
SETTLE_S = 5.0
"""Consistency is evaluated from this time on, because the initial rate is unknown."""
FIRST_RATE = 0.2
"""Standard deviation of the initial rate of a hand, rad/s, which the array does not measure."""
CLOSE_S = 2.0
_BINS = 150


class Run(NamedTuple):
    """One simulated run and its estimate; errors are rotation vectors (N, 3) in rad, body frame."""

    recording: jaxekf.Recording
    estimate: jaxekf.Estimate
    error: Floats
    simulate_s: float
    rate_s: float
    filter_s: float


def acceleration_rms(motion: ToolMotion) -> float:
    """RMS acceleration of the body along one axis, m/s^2; it is a sum of sinusoids."""
    peak = motion.amplitude * (2.0 * np.pi * motion.frequency) ** 2
    return float(np.sqrt(np.sum(0.5 * peak**2) / 3.0))


def parameters(acceleration: float) -> jaxekf.Parameters:
    """Noise of the filter, from the sensors, the array and the `acceleration` of the body, m/s^2.

    The random walk of the array's rate is that of the bias. The filter interpolates the rate linearly
    between two samples; the remaining Brownian bridge, with the variance ``walk^2 T^2 / 12``, is the white
    noise of the rate. Each component of the specific force is the mean of two axes.

    The magnetometer is much more accurate than the accelerometers, so that the error of TRIAD is nearly in
    a plane that rotates with the error of the force. Its second-order part,
    ``(force error / g)^2 tan(dip)`` at a dip of about 60 deg or more, is missing in the covariance of eqs.
    41 to 46 and is added to the noise of the field.
    """
    walk = gyro_free_runs.rate_walk(gyro_free_runs.handheld_array(), GRADE)
    force = np.hypot(GRADE.acceleration_sigma / np.sqrt(2.0), acceleration)
    field = 1e-6 * GRADE.magnetometer_ugauss / GRADE.field_gauss
    curved = (force / np.linalg.norm(gyro_free_runs.GRAVITY_REF)) ** 2
    params = triad.MODEL.parameters
    noise = params.noise._replace(
        rate=walk / (GRADE.hertz * np.sqrt(12.0)),
        bias_walk=walk,
        accelerometer=force,
        magnetometer=np.hypot(field, curved * np.tan(np.deg2rad(GRADE.dip_deg))),
    )
    # The array's rate is early by half an interval; see `gyro_free_runs.array_rate`.
    calibration = params.calibration._replace(clock_offset=-0.5 / GRADE.hertz)
    initial = params.initial._replace(bias=FIRST_RATE)
    return params._replace(noise=noise, calibration=calibration, initial=initial)


def run(seed: int, minutes: float, *, body_acceleration: bool = True) -> Run:
    """Simulate and estimate one run."""
    motion = gyro_free_runs.surgical_motion(seed, body_acceleration=body_acceleration)
    array = gyro_free_runs.handheld_array()
    name = "microsurgery" if body_acceleration else "microsurgery, no acceleration"
    begin = time.perf_counter()
    simulated = gyro_free_runs.array_run(
        motion, array, seed=seed, duration_s=60.0 * minutes, grade=GRADE
    )
    made = time.perf_counter()
    recording = gyro_free_runs.array_recording(name, simulated, array, grade=GRADE)
    rated = time.perf_counter()
    # The array's rate is between the samples of the other sensors, at which the truth is known.
    truth = simulated.truth
    params = parameters(acceleration_rms(motion))
    both = jaxekf.estimate(recording, "triad", params, at=truth.time_ns, clock="tracker")
    estimate = both.requested
    assert estimate is not None
    done = time.perf_counter()
    known = np.isin(truth.time_ns, estimate.time_ns)
    error = metrics.attitude_error(estimate.attitude.value, truth.q_ref_body[known])
    return Run(recording, estimate, error, made - begin, rated - made, done - rated)


def triad_error(recording: jaxekf.Recording) -> Floats:
    """Error (N, 3) in rad of TRIAD applied to each sample."""
    return metrics.attitude_error(
        triad.attitude(recording).value, recording.need_encoder().q_ref_body
    )


def rate_error(recording: jaxekf.Recording) -> Floats:
    """Error (N, 3) in rad of the rate integrated from the true initial attitude and rate."""
    imu, truth = recording.need_imu(), recording.need_encoder().q_ref_body
    first = -GRADE.hertz * metrics.attitude_error(truth[1:2], truth[:1])
    # The value half an interval later is the mean over the interval.
    rate = imu.gyroscope - imu.gyroscope[0] + first
    turned = _integrate(truth[0], rate[:-1] / GRADE.hertz)
    return metrics.attitude_error(np.concatenate([truth[:1], turned]), truth)


@jax.jit
def _integrate(first: Array, turns: Array) -> Array:
    def step(q: Array, turn: Array) -> tuple[Array, Array]:
        q = rotation.normalise(rotation.product(q, rotation.exp(turn)))
        return q, q

    return jax.lax.scan(step, jnp.asarray(first), jnp.asarray(turns))[1]


def nees(made: Run) -> consistency.Consistency:
    """NEES of the attitude, with a confidence interval that accounts for correlation in time."""
    late = made.estimate.time >= SETTLE_S
    squares = metrics.normalised_square(made.error[late], made.estimate.attitude.cov[late])
    return consistency.judge_squares([squares], [np.full(len(squares), 3)])


def ends(t: Floats) -> tuple[Flags, Flags]:
    """The first and the last part of the times (N,)."""
    part = min(PART_S, t[-1] / 3.0)
    return t < part, t > t[-1] - part


def rms_deg(error: Floats) -> float:
    """Root mean square of the angle of rotation vectors (N, 3)."""
    return float(np.rad2deg(metrics.rms(error)))


def compare(full: Run, still: Run) -> dict[str, Any]:
    """The results of the run with acceleration and of the one without."""
    t = full.estimate.time
    first, last = ends(t)
    alone, integrated = triad_error(full.recording), rate_error(full.recording)
    consistent, consistent_full = nees(still), nees(full)
    taken = full.rate_s + full.filter_s
    return {
        "minutes": float(t[-1] / 60.0),
        "rate_alone_deg": {
            f"{at:g} s": float(np.rad2deg(np.linalg.norm(integrated[np.searchsorted(t, at)])))
            for at in (1.0, 10.0, 60.0, float(t[-1]))
            if at <= t[-1]
        },
        "filter_first_deg": rms_deg(full.error[first]),
        "filter_last_deg": rms_deg(full.error[last]),
        "filter_deg": rms_deg(full.error),
        "triad_deg": rms_deg(alone),
        "no_acceleration": {
            "filter_deg": rms_deg(still.error),
            "triad_deg": rms_deg(triad_error(still.recording)),
            "nees": consistent.mean,
            "nees_interval": list(consistent.interval),
            "independent_samples": consistent.effective,
        },
        "nees_with_acceleration": consistent_full.mean,
        "simulate_s": full.simulate_s,
        "rate_s": full.rate_s,
        "filter_s": full.filter_s,
        "faster_than_real_time": float(t[-1] / taken),
    }


def checks_of(found: dict[str, Any]) -> dict[str, bool]:
    """The checks of the expected values."""
    low, high = found["no_acceleration"]["nees_interval"]
    return {
        "the integrated rate drifts: 10 times the filter's error within 10 s": (
            found["rate_alone_deg"]["10 s"] > 10.0 * found["filter_deg"]
        ),
        "the filter does not drift: error of the last part at most 1.2 of the first": (
            found["filter_last_deg"] <= 1.2 * found["filter_first_deg"]
        ),
        "error of the filter at most 0.25 of TRIAD's": found["filter_deg"]
        <= 0.25 * found["triad_deg"],
        "NEES without acceleration: 1 within its interval": low <= 1.0 <= high,
        "faster than real time": found["faster_than_real_time"] > 1.0,
    }


def figure_of(full: Run) -> Any:
    """Figure of the errors about the three axes: RMS over the whole run, and the end with 2 sigma bands."""
    estimate, t = full.estimate, full.estimate.time
    # The estimate may begin a sample after the truth.
    alone, integrated = (
        error[-len(t) :] for error in (triad_error(full.recording), rate_error(full.recording))
    )
    sigma = np.rad2deg(estimate.attitude.sigma)
    edges = np.linspace(0.0, t[-1], _BINS + 1)
    bins = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, _BINS - 1)
    count, middle = np.bincount(bins), 0.5 * (edges[1:] + edges[:-1])
    close = (t >= t[-1] - CLOSE_S) & (t <= t[-1])
    with style.styled():
        figure, grid = style.new_grid(3, 2, (11, 7))
        for i, axis in enumerate(style.AXES):
            left, right = grid[i]
            for error, colour, name in (
                (integrated, style.HELD, "integrated rate"),
                (alone, style.MEASURED, "TRIAD"),
                (full.error, style.ESTIMATE, "filter"),
            ):
                square = np.bincount(bins, np.rad2deg(error[:, i]) ** 2) / count
                left.plot(middle, np.sqrt(square), color=colour, lw=1.2, label=name)
            left.set_yscale("log")
            left.set_ylabel(f"RMS error about {axis} (deg)")
            own = np.rad2deg(full.error[close, i])
            right.plot(
                t[close],
                np.rad2deg(alone[close, i]),
                ".",
                ms=2.5,
                color=style.MEASURED,
                label="TRIAD",
            )
            style.band(right, t[close], np.zeros(len(own)), sigma[close, i], "2σ of the filter")
            right.plot(t[close], own, color=style.ESTIMATE, lw=1.2, label="filter")
            right.set_ylabel(f"error about {axis} (deg)")
            right.margins(x=0)
        grid[0, 0].set_title(f"whole run, RMS of intervals of {edges[1]:.3g} s", fontsize=9)
        grid[0, 1].set_title(f"last {CLOSE_S:g} s", fontsize=9)
        style.finish(figure, grid, "Attitude of a handheld instrument without a gyroscope")
    return figure


def table(found: dict[str, Any]) -> str:
    """The results as text."""
    still = found["no_acceleration"]
    low, high = still["nees_interval"]
    drift = ", ".join(f"{v:.3g} deg after {at}" for at, v in found["rate_alone_deg"].items())
    return "\n".join(
        [
            f"integrated rate: {drift}",
            f"filter: {found['filter_deg']:.4f} deg RMS; first part {found['filter_first_deg']:.4f},"
            f" last part {found['filter_last_deg']:.4f}",
            f"TRIAD: {found['triad_deg']:.4f} deg RMS; error of the filter relative to it:"
            f" {found['filter_deg'] / found['triad_deg']:.3f}",
            f"without acceleration: filter {still['filter_deg']:.4f}, TRIAD {still['triad_deg']:.4f} deg;"
            f" NEES {still['nees']:.4f}, true mean in {low:.4f} to {high:.4f} with"
            f" {100 * consistency.SURE:g} % ({still['independent_samples']:.0f} independent samples)",
            f"with acceleration, which is not white: NEES {found['nees_with_acceleration']:.2f}",
            f"{found['rate_s'] + found['filter_s']:.1f} s for rate and filter,"
            f" {found['faster_than_real_time']:.0f} times faster than real time"
            f" (and {found['simulate_s']:.1f} s to simulate)",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--minutes", type=float, default=30.0, help="duration, min, at least 0.5 (30)"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    parser.add_argument("--output", type=Path, help="PNG file for the figure")
    parser.add_argument("--smoke", action="store_true", help="half a minute, nothing is checked")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.minutes = 0.5
    if arguments.minutes < 0.5:
        parser.error(f"got --minutes {arguments.minutes:g}, expected at least 0.5; make it longer")
    jaxekf.set_up()
    stages: dict[str, Callable[[], Any]] = {
        "with acceleration": lambda: run(arguments.seed, arguments.minutes),
        "without": lambda: run(arguments.seed, arguments.minutes, body_acceleration=False),
    }
    made = []
    with Progress(transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("", total=len(stages))
        for name, stage in stages.items():
            progress.update(task, description=name)
            made.append(stage())
            progress.advance(task)
    found = compare(*made)
    checks = checks_of(found)
    print(table(found))
    for text, passed in checks.items():
        print(f"{'ok    ' if passed else 'MISSED'} {text}")
    if arguments.output is not None:
        print(f"figure: {style.save(figure_of(made[0]), arguments.output)}")
    print(json.dumps(found | {"checks": checks}))
    sys.exit(0 if arguments.smoke or all(checks.values()) else 1)


if __name__ == "__main__":
    main()
