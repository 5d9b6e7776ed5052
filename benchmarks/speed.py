"""Race of filters on the same work: ``python benchmarks/speed.py [--quick] [--models marg triad]``.

Prints a table of microseconds per step and run (medians), the first-call seconds and the peak memory, and
last one line of JSON. All filters must agree before any is timed.
"""

import argparse
import json
import os
import platform
import resource
import sys
import time
from importlib.metadata import version
from pathlib import Path

import jax

jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))
import models  # noqa: E402
import peers  # noqa: E402
from clock import timed  # noqa: E402
from problem import NOISE, STEPS, Noise, measurements  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

import jaxekf  # noqa: E402

OURS = "jaxekf"
"""Compiled by `jaxekf.jit`, as `estimate` and `tune` are."""
PLAIN = "jaxekf, plain jax.jit"


def contenders() -> dict[str, tuple[object, object]]:
    """By name: the filter of many runs, and what turns measurements into its input."""
    found = {
        OURS: (peers.ours, peers.given_to_ours),
        PLAIN: (peers.ours, peers.given_to_ours),
        "textbook JAX": (peers.over_runs(peers.textbook), jax.numpy.asarray),
    }
    for name in ("dynamax", "cuthbert"):
        if peers.available(name):
            found[name] = (peers.over_runs(getattr(peers, name)), jax.numpy.asarray)
    return found


def agree(filters: dict[str, tuple[object, object]]) -> None:
    """Raise unless all filters give the same means and likelihood, and gradients."""
    z = measurements(3, 300)
    results = {}
    for name, (run, give) in filters.items():
        results[name] = jax.tree.map(np.asarray, jax.jit(run)(NOISE, give(z)))
    if peers.available("filterpy"):
        found = [peers.filterpy(NOISE, one) for one in z]
        results["filterpy"] = np.stack([m for m, _ in found]), sum(t for _, t in found)
    mean, total = results[OURS]
    for name, (other, likelihood) in results.items():
        # dynamax adds 1e-9 to the diagonal of S before it solves, and so differs by that much.
        loose = name == "dynamax"
        np.testing.assert_allclose(other, mean, rtol=0, atol=2e-5 if loose else 1e-8, err_msg=name)
        np.testing.assert_allclose(likelihood, total, rtol=1e-3 if loose else 1e-7, err_msg=name)
    slopes = {
        name: np.concatenate(jax.grad(lambda n, g, run=run: run(n, g)[1])(NOISE, give(z)))
        for name, (run, give) in filters.items()
    }
    for name, slope in slopes.items():
        tolerance = 2e-2 if name == "dynamax" else 1e-5
        np.testing.assert_allclose(slope, slopes[OURS], rtol=tolerance, err_msg=name)


def main() -> None:
    """Run the race."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer runs, shorter timing")
    parser.add_argument(
        "--models",
        nargs="+",
        choices=list(models.CONTENDERS),
        help="these other models alone, against textbook JAX",
    )
    arguments = parser.parse_args()
    quick = arguments.quick
    if arguments.models:
        other = models.race(0.5 if quick else 3.0, arguments.models)
        show_models(Console(width=110), other)
        print(json.dumps({"other_models_us_per_step_per_run": other}))
        return
    filters = contenders()
    agree(filters)
    where = {
        "python": platform.python_version(),
        "jax": version("jax"),
        "jaxlib": version("jaxlib"),
        "devices": f"{len(jax.devices())} {jax.devices()[0].platform}",
        "processor": processor(),
    }
    print(", ".join(f"{key} {value}" for key, value in where.items()))
    print(
        "all filters agree: means within 1e-8 (dynamax, whose solver adds 1e-9 to S, within 2e-5)"
    )
    sizes = (1, 64) if quick else (1, 64, 1024)
    seconds = 0.5 if quick else 3.0
    speed: dict[str, dict[str, float]] = {}
    first: dict[str, dict[str, float]] = {}
    for runs in sizes:
        z = measurements(runs)
        for name, (run, give) in filters.items():
            given = give(z)
            compiled = jaxekf.jit if name == OURS else jax.jit
            if not (runs == 1024 and name == "cuthbert"):
                forward = compiled(run)
                measure(speed, first, name, f"{runs} forward", forward, given, runs, seconds)
            if runs < 1024:
                gradient = compiled(jax.value_and_grad(lambda n, g, run=run: run(n, g)[1]))
                measure(speed, first, name, f"{runs} gradient", gradient, given, runs, seconds)
    if peers.available("filterpy"):
        z = measurements(1, 300)[0]
        begin = time.perf_counter()
        peers.filterpy(NOISE, z)
        speed["filterpy"] = {"1 forward": (time.perf_counter() - begin) / len(z) * 1e6}
    for name, value in peers.yardsticks().items():
        speed[name] = {"1 forward" if "scalar" in name else "1024 forward": value}
    other = models.race(seconds)
    show(speed, first, other)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of the whole race: {peak:.0f} MiB")
    result = {
        **where,
        "us_per_step_per_run": speed,
        "ratios": ratios(speed),
        "first_call_s": first,
        "other_models_us_per_step_per_run": other,
        "peak_memory_mib": round(peak),
    }
    print(json.dumps(result))


def measure(
    speed: dict[str, dict[str, float]],
    first: dict[str, dict[str, float]],
    name: str,
    column: str,
    function: object,
    given: object,
    runs: int,
    seconds: float,
) -> None:
    """Time one filter and note it."""
    begin, median = timed(function, Noise(*NOISE), given, seconds=seconds)
    speed.setdefault(name, {})[column] = median / (runs * STEPS) * 1e6
    first.setdefault(name, {})[column] = begin


def ratios(speed: dict[str, dict[str, float]]) -> dict[str, float]:
    """What the project asks of itself, from the same run of the script."""
    own = speed[OURS]
    found = {
        f"gradient / forward, 64 runs, {name}": speed[name]["64 gradient"]
        / speed[name]["64 forward"]
        for name in (OURS, PLAIN)
    }
    scalar = speed.get("C++ scalar, one thread", {}).get("1 forward")
    vector = [v["1024 forward"] for k, v in speed.items() if k.startswith("C++ vectors")]
    for column, value in own.items():
        for name in ("dynamax", "textbook JAX", "cuthbert"):
            if column in speed.get(name, {}):
                found[f"{name} / jaxekf, {column}"] = speed[name][column] / value
        if scalar and "forward" in column:
            found[f"jaxekf / C++ scalar, {column}"] = value / scalar
        if vector and "forward" in column:
            found[f"jaxekf / C++ vectors, {column}"] = value / min(vector)
    return {key: round(value, 3) for key, value in found.items()}


def show(
    speed: dict[str, dict[str, float]],
    first: dict[str, dict[str, float]],
    other: dict[str, dict[str, float]],
) -> None:
    """The tables."""
    console = Console(width=110)
    columns = list(speed[OURS])
    table = Table(title="microseconds per step and run (first call, s)")
    table.add_column("filter")
    for column in columns:
        table.add_column(column, justify="right")
    for name, row in speed.items():
        cells = [
            f"{row[c]:.3f}" + (f" ({first[name][c]:.1f})" if name in first else "")
            if c in row
            else ""
            for c in columns
        ]
        table.add_row(name, *cells)
    console.print(table)
    show_models(console, other)
    for name, value in ratios(speed).items():
        print(f"{name}: {value:g}")


def show_models(console: Console, other: dict[str, dict[str, float]]) -> None:
    """The table of other models."""
    table = Table(title="other models, 64 runs: microseconds per step and run")
    for column in ("model", "jaxekf", "textbook JAX", "ratio"):
        table.add_column(column, justify="left" if column == "model" else "right")
    for name, row in other.items():
        own, plain = row["jaxekf"], row["textbook JAX"]
        table.add_row(name, f"{own:.3f}", f"{plain:.3f}", f"{plain / own:.1f}")
    console.print(table)


def processor() -> str:
    """Name of the processor, where Linux tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


if __name__ == "__main__":
    main()
