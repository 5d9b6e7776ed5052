"""Time and memory over run length, runs and state size: ``python benchmarks/scaling.py [--quick]``.

Every point is measured in its own process on one CPU device, so that its peak memory is known. Prints a
table, the slopes on logarithmic axes, time and memory of one hour at 200 Hz with and without recomputation
of beliefs, and JSON as the last line; writes a figure (``-o``). ``--smoke`` has three tiny points.
"""

import argparse
import json
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

_HOUR = 720_000
_SECONDS = 1.0
_LENGTHS = (250, 500, 1_000, 2_000, 4_000, 16_000, 64_000, 256_000)
_RUNS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
_STATES = (6, 9, 12, 15, 18, 21)
_KINDS = ("forward", "gradient")


@dataclass(frozen=True)
class Point:
    """One point: its size, and its measured time and memory."""

    sweep: str
    kind: str
    states: int
    runs: int
    steps: int
    checkpoint: bool = True
    seconds: float = float("nan")
    first_s: float = float("nan")
    peak_mib: float = float("nan")
    base_mib: float = float("nan")

    @property
    def size(self) -> int:
        """The number that the sweep varies."""
        return {"run length": self.steps, "runs": self.runs, "state size": self.states}[self.sweep]


def points(quick: bool, smoke: bool) -> list[Point]:
    """All points of all sweeps."""
    if smoke:
        lengths = (Point("run length", "forward", 10, 1, steps) for steps in (1_000, 2_000))
        return [*lengths, Point("state size", "forward", 6, 2, 20)]
    lengths, runs, states = _LENGTHS, _RUNS, _STATES
    if quick:
        lengths, runs, states = lengths[2:6], runs[4:8], states[:3]
    return [
        point
        for kind in _KINDS
        for point in (
            *(Point("run length", kind, 10, 1, steps) for steps in lengths),
            *(Point("runs", kind, 10, count, 500) for count in runs),
            *(Point("state size", kind, size, 16, 500) for size in states),
        )
    ]


# --- in the process of one point ----------------------------------------------------------------------


def _chain(size: int) -> tuple[Any, Any, Any]:
    """A model of `size` states: blocks of three, each the rate of the one before; two are measured."""
    import jax.numpy as jnp

    from jaxekf.filtering.model import Belief, Model, Parameters, Sensor
    from jaxekf.filtering.steps import Rows, Steps
    from jaxekf.geometry.manifold import Euclidean

    count = size // 3
    walk = Parameters(0.1, 0.02, 1.0)

    def transition(x: Any, u: Any, dt: Any, w: Any, params: Any) -> Any:
        following = [*x[1:], jnp.zeros(3)]
        moved = [a + dt * jnp.sin(b) for a, b in zip(x, following, strict=True)]
        return tuple(m + w[3 * i : 3 * i + 3] for i, m in enumerate(moved))

    def sensor(part: int) -> Sensor:
        return Sensor(
            f"part_{part}",
            Euclidean(3),
            lambda x, u, params, aux: x[part],
            lambda params, aux, dt: params.calibration**2 * jnp.eye(3),
        )

    model = Model(
        name="chain",
        summary="a chain of blocks of three states",
        space=(Euclidean(3),) * count,
        transition=transition,
        process_noise=lambda params, dt: params.noise**2 * dt * jnp.eye(size),
        sensors=(sensor(0), sensor(1)),
        parameters=walk,
        units=Parameters("", "", ""),
        noise_dims=size,
        initial_mean=lambda first: (jnp.zeros(3),) * count,
        initial_covariance=lambda params: params.initial**2 * jnp.eye(size),
    )

    def given(runs: int, steps: int) -> Any:
        rng = np.random.default_rng(3)
        shape = (runs, steps, 1)

        def rows() -> Rows:
            return Rows(
                0.1 * rng.normal(size=(*shape, 3)),
                None,
                np.ones((*shape, 3), bool),
                np.full(shape, 0.01),
            )

        clock = np.broadcast_to(0.01 * np.arange(steps)[:, None], shape)
        fast = {"part_0": rows(), "part_1": rows()}
        return Steps(clock, np.full(shape, 0.01), np.ones(shape, bool), None, fast, {})

    def start(params: Any, runs: int) -> Any:
        mean = tuple(jnp.zeros((runs, 3)) for _ in range(count))
        cov = jnp.broadcast_to(params.initial**2 * jnp.eye(size), (runs, size, size))
        return Belief(mean, cov)

    return model, given, start


def measure(point: Point) -> Point:
    """Measure time and memory of a point; call it once in a process."""
    import jax
    import jax.numpy as jnp
    import problem
    from clock import timed

    from jaxekf import jit, run_filter_batch, set_up

    set_up()

    if point.states == 10:
        model, given = problem.MODEL, problem.steps(problem.measurements(point.runs, point.steps))
        noise: Any = problem.NOISE
        params_of, start = problem.parameters, lambda params, runs: problem.start(runs)
    else:
        model, make, start = _chain(point.states)
        given, noise, params_of = make(point.runs, point.steps), model.parameters, lambda p: p
    given = jax.tree.map(jnp.asarray, given)
    noise = jax.tree.map(lambda a: jnp.asarray(a, float), noise)

    def total(noise: Any, given: Any) -> Any:
        params = params_of(noise)
        every = jax.tree.map(lambda a: jnp.broadcast_to(a, (point.runs, *jnp.shape(a))), params)
        belief = start(params, point.runs)
        output = run_filter_batch(
            model, every, belief, given, keep="means", checkpoint=point.checkpoint
        )
        return jnp.sum(output.instants.log_likelihood), output.instants.updated.mean

    forward = point.kind == "forward"
    function = jit(total if forward else jax.value_and_grad(total, has_aux=True))
    base = _resident()
    first, each, _ = timed(function, noise, given, seconds=_SECONDS)
    return Point(
        **{
            **vars(point),
            "seconds": each,
            "first_s": first - each,
            "peak_mib": _resident(),
            "base_mib": base,
        }
    )


def _resident() -> float:
    """Peak memory of this process, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


# --- all points ---------------------------------------------------------------------------------------


def in_a_process(point: Point) -> Point:
    """Measure a point in its own process."""
    given = json.dumps(vars(point))
    found = subprocess.run(
        [sys.executable, __file__, "--point", given], check=True, capture_output=True, text=True
    )
    return Point(**json.loads(found.stdout.splitlines()[-1]))


def slope(found: list[Point], quantity: str, knee: int) -> float:
    """The exponent of a power law fitted to the points at or above the size `knee`."""
    past = [p for p in found if p.size >= knee]
    values = [getattr(p, quantity) for p in past]
    return float(np.polyfit(np.log([p.size for p in past]), np.log(values), 1)[0])


_KNEE = {"run length": 1_000, "runs": 16, "state size": 6}
"""Smallest size in the fit of each sweep; below it, fixed costs and unused vector lanes dominate."""


def main() -> None:
    """Measure all points, print the results and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer points, without the hour")
    parser.add_argument("--smoke", action="store_true", help="three tiny points")
    parser.add_argument(
        "-o", "--output", default="scaling.png", help="figure (scaling.png); none with --smoke"
    )
    parser.add_argument("--point", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.point:
        print(json.dumps(vars(measure(Point(**json.loads(options.point))))))
        return
    from rich.console import Console
    from rich.progress import track

    console = Console(width=110)
    errors = Console(stderr=True)
    todo = points(options.quick, options.smoke)
    progress = track(todo, "measuring", console=errors, disable=not sys.stderr.isatty())
    found = [in_a_process(point) for point in progress]
    slopes = {}
    for sweep, knee in _KNEE.items():
        for kind in _KINDS:
            chosen = [p for p in found if p.sweep == sweep and p.kind == kind]
            if len({p.size for p in chosen if p.size >= knee}) < 2:
                continue
            slopes[f"time against {sweep}, {kind}"] = round(slope(chosen, "seconds", knee), 3)
    show(console, found)
    for name, value in slopes.items():
        print(f"slope of {name}: {value}")
    hour = {} if options.quick or options.smoke else an_hour()
    for name, value in hour.items():
        print(f"{name}: {value:.3g}")
    if not options.smoke:
        draw(found, slopes, Path(options.output))
        print(f"figure: {options.output}")
    print(json.dumps({"slopes": slopes, "hour": hour, "points": [vars(p) for p in found]}))


def an_hour() -> dict[str, float]:
    """Time and memory of the gradient over an hour at 200 Hz, with recomputed and with stored beliefs."""
    again = in_a_process(Point("run length", "gradient", 10, 1, _HOUR))
    kept = in_a_process(Point("run length", "gradient", 10, 1, _HOUR, checkpoint=False))
    return {
        f"gradient over {_HOUR:,} steps, s": again.seconds,
        "peak memory, MiB": again.peak_mib,
        "the same with stored beliefs, s": kept.seconds,
        "its peak memory, MiB": kept.peak_mib,
        "ratio of times": again.seconds / kept.seconds,
    }


def show(console: Any, found: list[Point]) -> None:
    """Print the table of points."""
    from rich.table import Table

    table = Table(title="one CPU device, float64")
    for column in ("sweep", "size", "kind", "us per step and run", "compile, s", "peak, MiB"):
        table.add_column(column, justify="left" if column in ("sweep", "kind") else "right")
    for p in found:
        each = p.seconds / (p.runs * p.steps) * 1e6
        cells = (f"{p.size:,}", p.kind, f"{each:.3f}", f"{p.first_s:.1f}", f"{p.peak_mib:.0f}")
        table.add_row(p.sweep, *cells)
    console.print(table)


def draw(found: list[Point], slopes: dict[str, float], path: Path) -> None:
    """Draw time and memory over each of the three sizes."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from jaxekf.io.atomic import whole_file

    labels = {
        "run length": "steps in one run",
        "runs": "runs of 500 steps",
        "state size": "states (16 runs of 500 steps)",
    }
    figure, axes = plt.subplots(2, 3, figsize=(12, 7), sharex="col", layout="constrained")
    for column, (sweep, label) in enumerate(labels.items()):
        for kind, marker in zip(_KINDS, "os", strict=True):
            chosen = [p for p in found if p.sweep == sweep and p.kind == kind]
            sizes = [p.size for p in chosen]
            exponent = slopes[f"time against {sweep}, {kind}"]
            name = f"{kind} (slope {exponent:.2f})"
            axes[0, column].loglog(
                sizes, [1e3 * p.seconds for p in chosen], marker, ls="-", label=name
            )
            grown = [max(p.peak_mib - p.base_mib, 0.1) for p in chosen]
            axes[1, column].loglog(sizes, grown, marker, ls="-", label=kind)
        axes[1, column].set_xlabel(label)
        for axis in axes[:, column]:
            axis.grid(True, which="both", alpha=0.3)
            axis.legend()
    axes[0, 0].set_ylabel("time of one call (ms)")
    axes[1, 0].set_ylabel("additional peak memory with compilation (MiB)")
    figure.suptitle(
        "10-state model unless stated otherwise; one CPU device, float64; slopes of large sizes"
    )
    with whole_file(path, overwrite=True) as made:
        figure.savefig(made, dpi=120)


if __name__ == "__main__":
    main()
