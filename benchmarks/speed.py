"""Speed of filters of the same problem: ``python benchmarks/speed.py [--quick] [--models marg triad]``.

Prints median microseconds per step and run, seconds of the first call, and peak memory of filters with ten
states; then for each model of the package, compared with the same model in textbook JAX, the number of
operations, the seconds of tracing, lowering and compilation, and the run time. Build times are those of
programs for 64 runs, without caches; operations are lines with ``=`` in the StableHLO text for 16 runs. All
filters must agree. There are two CPU devices.

The last line is JSON. ``limit_ratio`` compares ten states and 64 runs with C++ with 8 runs per vector on
two threads (null if that cannot be built), and the gradient with the forward pass. ``build_ratio`` is the
build time of the gradient relative to that of textbook JAX.
"""

import argparse
import json
import platform
import resource
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax

import jaxekf

DEVICES = 2
jax.config.update("jax_num_cpu_devices", DEVICES)
jaxekf.set_up()
jax.config.update("jax_enable_compilation_cache", False)

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import models
import peers
from clock import Build, build, operations, timed
from models import KINDS, Measured
from problem import NOISE, STEPS, Noise, measurements
from rich.console import Console
from rich.table import Table

OURS = "jaxekf"
"""This package, compiled by `jaxekf.jit` as in `estimate` and `tune`."""
PLAIN = "jaxekf, plain jax.jit"
TEXTBOOK = "textbook JAX"
PEERS = ("dynamax", "cuthbert")
RACE = "race"
"""Name of the model with ten states."""
TWO_THREADS = "C++ vectors, 2 thread(s)"
Times = dict[str, dict[str, float]]
Programs = dict[str, dict[str, dict[str, Measured]]]


class Size(NamedTuple):
    """Sizes of the measurements."""

    runs: tuple[int, ...]
    steps: int
    """Steps of a run with ten states."""
    seconds: float
    """Duration of the timing of each program."""
    models: tuple[str, ...]
    model_steps: int
    """Steps of a run of another model."""
    model_runs: int
    model_kinds: tuple[str, ...] = KINDS
    gradients: tuple[str, ...] = (OURS, PLAIN, TEXTBOOK, *PEERS)
    """Filters with ten states whose gradient is timed."""


FULL = Size((1, 64, 1024), STEPS, 3.0, tuple(models.CONTENDERS), 500, models.RUNS)
QUICK = Size(
    (1, 64), STEPS, 0.5, models.MAIN, 100, models.RUNS, gradients=(OURS, PLAIN, TEXTBOOK, "dynamax")
)
SMOKE = Size((2,), 30, 0.0, ("loose",), 30, 2, ("forward",), (OURS, TEXTBOOK))


class Contender(NamedTuple):
    """A filter of many runs, with the functions that make its input and compile it."""

    run: peers.Filter
    give: Callable[[np.ndarray], Any]
    """Converts measurements into its input."""
    jit: Callable[..., Any]

    def function(self, kind: str) -> Any:
        """The jitted function: means and likelihood, or likelihood and gradient with respect to Q and R."""
        if kind == "forward":
            return self.jit(self.run)
        return self.jit(jax.value_and_grad(lambda noise, given: self.run(noise, given)[1]))


def contenders() -> dict[str, Contender]:
    """The installed filters by name."""
    found = {
        OURS: Contender(peers.ours, peers.given_to_ours, jaxekf.jit),
        PLAIN: Contender(peers.ours, peers.given_to_ours, jax.jit),
        TEXTBOOK: Contender(peers.over_runs(peers.textbook), jax.numpy.asarray, jax.jit),
    }
    for name in PEERS:
        if peers.available(name):
            one = peers.over_runs(getattr(peers, name))
            found[name] = Contender(one, jax.numpy.asarray, jax.jit)
    return found


def agree(kind: str, results: dict[str, Any]) -> None:
    """Raise unless all filters have the same means and likelihood, or gradients."""
    if kind == "gradient":
        slopes = {name: np.concatenate(slope) for name, (_, slope) in results.items()}
        for name, slope in slopes.items():
            tolerance = 2e-2 if name == "dynamax" else 1e-5
            np.testing.assert_allclose(slope, slopes[OURS], rtol=tolerance, err_msg=name)
        return
    mean, total = results[OURS]
    for name, (other, likelihood) in results.items():
        # dynamax adds 1e-9 to the diagonal of S, and so differs by that much.
        loose = name == "dynamax"
        np.testing.assert_allclose(other, mean, rtol=0, atol=2e-5 if loose else 1e-8, err_msg=name)
        np.testing.assert_allclose(likelihood, total, rtol=1e-3 if loose else 1e-7, err_msg=name)


class Race(NamedTuple):
    """Times of the filters with ten states."""

    us: Times
    """Microseconds per step and run, by filter and column."""
    first_s: Times
    """Seconds of the first call, with compilation."""
    builds: dict[str, dict[str, Build]]
    """Builds of the largest gradient and its forward pass, by kind and filter."""


def race(size: Size, report: Callable[[str], None]) -> Race:
    """Build, compare and time the filters with ten states."""
    found = Race({}, {}, {})
    most = max([runs for runs in size.runs if runs < 1024])
    for runs in size.runs:
        z = measurements(runs, size.steps)
        for kind in KINDS if runs < 1024 else KINDS[:1]:
            column, results = f"{runs} {kind}", {}
            for name, one in contenders().items():
                if runs == 1024 and name == "cuthbert":
                    continue
                if kind == "gradient" and name not in size.gradients:
                    continue
                report(f"{name}, {column}")
                given, noise = one.give(z), Noise(*NOISE)
                built = build(one.function(kind), noise, given)
                begin, median, result = timed(built.program, noise, given, seconds=size.seconds)
                results[name] = jax.tree.map(np.asarray, result)
                found.us.setdefault(name, {})[column] = median / (runs * size.steps) * 1e6
                found.first_s.setdefault(name, {})[column] = built.total_s + begin
                if runs == most:
                    found.builds.setdefault(kind, {})[name] = built._replace(program=None)
            if runs == size.runs[0] and kind == "forward" and peers.available("filterpy"):
                results["filterpy"] = by_filterpy(z, column, found.us)
            agree(kind, results)
    return found


def by_filterpy(z: np.ndarray, column: str, us: Times) -> tuple[np.ndarray, float]:
    """Means and likelihood of filterpy, run by run."""
    begin = time.perf_counter()
    found = [peers.filterpy(NOISE, one) for one in z]
    us["filterpy"] = {column: (time.perf_counter() - begin) / z[..., 0].size * 1e6}
    return np.stack([mean for mean, _ in found]), sum(total for _, total in found)


def of_ten_states(made: Race, size: Size) -> dict[str, dict[str, Measured]]:
    """The results of the model with ten states in the form of the other models."""
    column = max([runs for runs in size.runs if runs < 1024])
    z = measurements(models.COUNTED, size.steps)
    found: dict[str, dict[str, Measured]] = {}
    for kind, builds in made.builds.items():
        for name in (OURS, TEXTBOOK):
            number = builds[name].operations
            if name == OURS:
                one = contenders()[name]
                number = operations(one.function(kind), Noise(*NOISE), one.give(z))
            us = made.us[name][f"{column} {kind}"]
            found.setdefault(kind, {})[name] = Measured(builds[name], number, us)
    return found


def ratios(speed: Times) -> dict[str, float]:
    """Ratios of times within this run of the script."""
    own = speed[OURS]
    found = {
        f"gradient / forward, 64 runs, {name}": speed[name]["64 gradient"]
        / speed[name]["64 forward"]
        for name in (OURS, PLAIN)
        if "64 gradient" in speed[name]
    }
    scalar = speed.get("C++ scalar, one thread", {}).get("1 forward")
    vector = [v["1024 forward"] for k, v in speed.items() if k.startswith("C++ vectors")]
    for column, value in own.items():
        for name in (TEXTBOOK, *PEERS):
            if column in speed.get(name, {}):
                found[f"{name} / jaxekf, {column}"] = speed[name][column] / value
        if scalar and "forward" in column:
            found[f"jaxekf / C++ scalar, {column}"] = value / scalar
        if vector and "forward" in column:
            found[f"jaxekf / C++ vectors, {column}"] = value / min(vector)
    return {key: round(value, 3) for key, value in found.items()}


def limit_ratio(speed: Times) -> dict[str, float | None]:
    """Ten states, 64 runs, two devices: time relative to C++ on two threads, and gradient to forward."""
    own = speed[OURS]
    forward, gradient = own.get("64 forward"), own.get("64 gradient")
    limit = speed.get(TWO_THREADS, {}).get("1024 forward")
    return {
        "forward": round(forward / limit, 3) if forward and limit else None,
        "gradient_over_forward": round(gradient / forward, 3) if forward and gradient else None,
    }


def of_programs(found: Programs) -> dict[str, Any]:
    """The results of the programs for the line of JSON."""

    def each(whose: str, value: Callable[[Measured], float]) -> dict[str, dict[str, float]]:
        return {
            name: {kind: value(both[whose]) for kind, both in kinds.items()}
            for name, kinds in found.items()
        }

    own, plain = models.OWN, models.TEXTBOOK
    return {
        "operations": each(own, lambda one: one.operations),
        "build_s": each(own, lambda one: round(one.build.total_s, 2)),
        "build_ratio": {
            name: round(one[own].build.total_s / one[plain].build.total_s, 3)
            for name, kinds in found.items()
            for kind, one in kinds.items()
            if kind == "gradient"
        },
        "textbook_operations": each(plain, lambda one: one.operations),
        "textbook_build_s": each(plain, lambda one: round(one.build.total_s, 2)),
        "other_models_us_per_step_per_run": {
            f"{name}, {kind}": {whose: one.us for whose, one in both.items()}
            for name, kinds in found.items()
            if name != RACE
            for kind, both in kinds.items()
        },
    }


def show(console: Console, made: Race) -> None:
    """Print the table of filters with ten states."""
    columns = list(made.us[OURS])
    table = Table(title="ten states: microseconds per step and run (first call, s)")
    table.add_column("filter")
    for column in columns:
        table.add_column(column, justify="right")
    for name, row in made.us.items():
        first = made.first_s.get(name, {})
        cells = [
            f"{row[c]:.3f}" + (f" ({first[c]:.1f})" if c in first else "") if c in row else ""
            for c in columns
        ]
        table.add_row(name, *cells)
    console.print(table)


def show_models(console: Console, found: Programs, runs: int) -> None:
    """Print the table of all models: operations, build times and run times of both implementations."""
    table = Table(
        title=f"models and textbook JAX: operations ({models.COUNTED} runs); trace + lower + compile, s,"
        f" and microseconds per step and run ({runs} runs)"
    )
    columns = ("operations", "build, s", "us")
    table.add_column("", no_wrap=True)
    for name in (*columns, *(f"textbook {name}" for name in columns), "build ratio", "us ratio"):
        table.add_column(name, justify="right", no_wrap="build, s" in name)
    for name, kinds in found.items():
        for kind, both in kinds.items():
            cells: list[str] = []
            own, plain = both[models.OWN], both[models.TEXTBOOK]
            for one in (own, plain):
                stages = (one.build.trace_s, one.build.lower_s, one.build.compile_s)
                text = " + ".join(f"{seconds:.1f}" for seconds in stages)
                cells += [f"{one.operations:,}", text, f"{one.us:.3f}"]
            cells.append(f"{own.build.total_s / plain.build.total_s:.2f}")
            cells.append(f"{own.us / plain.us:.3f}")
            table.add_row(f"{name}, {kind}", *cells)
    console.print(table)


def processor() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer runs, shorter timing")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes")
    parser.add_argument(
        "--models",
        nargs="+",
        choices=list(models.CONTENDERS),
        help="only these models, compared with textbook JAX (all)",
    )
    return parser.parse_args()


def race_models(
    names: Sequence[str], size: Size, found: Programs, report: Callable[[str], None]
) -> None:
    """Add the results of these models to `found`."""
    found |= models.race(
        names,
        size.seconds,
        size.model_steps,
        runs=size.model_runs,
        kinds=size.model_kinds,
        report=report,
    )


def main() -> None:
    """Run the benchmark."""
    arguments = parse_arguments()
    size = SMOKE if arguments.smoke else QUICK if arguments.quick else FULL
    console, began = Console(width=140), time.perf_counter()
    found: Programs = {}
    # The first compilation starts the compiler; it is not part of the times.
    jax.block_until_ready(jax.jit(lambda x: x + 1)(1.0))
    with Console(stderr=True).status("") as status:
        if arguments.models:
            race_models(arguments.models, size, found, status.update)
            show_models(console, found, size.model_runs)
            print(json.dumps(of_programs(found)))
            return
        where = {
            "python": platform.python_version(),
            "jax": version("jax"),
            "jaxlib": version("jaxlib"),
            "devices": f"{len(jax.devices())} {jax.devices()[0].platform}",
            "processor": processor(),
        }
        print(", ".join(f"{key} {value}" for key, value in where.items()), flush=True)
        made = race(size, status.update)
        for name, value in ({} if arguments.smoke else peers.yardsticks()).items():
            made.us[name] = {"1 forward" if "scalar" in name else "1024 forward": value}
        show(console, made)
        found[RACE] = of_ten_states(made, size)
        race_models(size.models, size, found, status.update)
    if arguments.smoke:
        for name in models.CONTENDERS:
            models.work(name, size.model_runs, size.model_steps)
    show_models(console, found, size.model_runs)
    print(
        "all filters agree: means within 1e-8 (dynamax, whose solver adds 1e-9 to S, within 2e-5)"
    )
    limits = {f"limit ratio, {name}": value for name, value in limit_ratio(made.us).items()}
    for name, value in (ratios(made.us) | limits).items():
        print(f"{name}: {value}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of the whole benchmark: {peak:.0f} MiB")
    result = {
        **where,
        "us_per_step_per_run": made.us,
        "ratios": ratios(made.us),
        "first_call_s": made.first_s,
        **of_programs(found),
        "limit_ratio": limit_ratio(made.us),
        "peak_memory_mib": round(peak),
        "seconds": round(time.perf_counter() - began, 1),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
