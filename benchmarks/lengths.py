"""Runs of many different lengths in `estimate` and `tune`: ``python benchmarks/lengths.py [--quick]``.

Compares the number of compiled programs with the number of padded lengths, times a first and a second pass,
and compares estimates with those of the same run filtered alone without padding. Prints a table and, as the
last line, JSON.
"""

import argparse
import json
import os
import sys
import time
from typing import Any

import jax

import jaxekf

jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
jaxekf.set_up()

import jax.numpy as jnp
import numpy as np
from rich.progress import Progress

import tuning
from jaxekf.estimation import batch, padding
from jaxekf.simulation import attitude_runs
from tuning.search import evaluation

_RATE = attitude_runs.SensorGrade().optical_hz
"""Steps per second: the gyroscope is an input, each tracker sample a step."""


def recordings(count: int, shortest: int, longest: int) -> list[Any]:
    """Simulated runs with uniformly distributed numbers of steps."""
    lengths = np.random.default_rng(6).uniform(shortest, longest, count)
    return [
        attitude_runs.recording(
            f"run{i}",
            attitude_runs.free_motion(i, speed_deg=60.0, rest_s=0.1),
            seed=i,
            duration_s=length / _RATE,
        )
        for i, length in enumerate(lengths)
    ]


def difference(model: Any, lines: list[Any], found: list[Any]) -> float:
    """The largest relative difference from runs filtered alone without padding."""
    params = jax.tree.map(jnp.asarray, model.parameters)
    worst = 0.0
    for line, estimate in zip(lines, found, strict=True):
        belief = jaxekf.initial_belief(model, params, line.first)
        steps = jax.tree.map(jnp.asarray, line.steps)
        alone = jaxekf.run_filter(model, params, belief, steps, keep="estimates").instants.updated
        for a, b in (
            *zip(jax.tree.leaves(estimate.state), jax.tree.leaves(alone.mean), strict=True),
            (estimate.cov, alone.cov),
        ):
            b = np.asarray(b)[line.valid]
            worst = max(worst, float(np.max(np.abs(a - b)) / np.max(np.abs(b))))
    return worst


def timed(function: Any) -> tuple[Any, float]:
    """The result of a function, and the seconds it took."""
    begin = time.perf_counter()
    found = function()
    return found, time.perf_counter() - begin


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer and shorter runs")
    parser.add_argument("--smoke", action="store_true", help="two tiny runs")
    arguments = parser.parse_args()
    count, shortest, longest, compared = (100, 500, 20_000, 10)
    if arguments.quick:
        count, shortest, longest, compared = (12, 100, 1_000, 3)
    if arguments.smoke:
        # Both runs have the same length after padding, so that one program is enough.
        count, shortest, longest, compared = (2, 29, 31, 1)
    iterations = 1 if arguments.smoke else 3
    model = jaxekf.get_model("loose")
    with Progress(disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("simulating", total=5)

        def done(following: str) -> None:
            progress.update(task, advance=1, description=following)

        runs = recordings(count, shortest, longest)
        lines = jaxekf.timeline.build_many(model, runs)
        buckets = len(padding.groups(lines))
        done("estimating")
        found, first = timed(lambda: jaxekf.estimate_many(runs, model))
        compiled = batch._run._cache_size()
        done("estimating again")
        found, second = timed(lambda: jaxekf.estimate_many(runs, model))
        again = batch._run._cache_size() - compiled
        done("comparing")
        some = [int(i) for i in np.linspace(0, count - 1, compared)]
        worst = difference(model, [lines[i] for i in some], [found[i] for i in some])
        result = {
            "runs": count,
            "steps": sum(int(line.valid.sum()) for line in lines),
            "buckets": buckets,
            "estimate: programs": compiled,
            "estimate: programs of a second pass": again,
            "estimate: s": round(first, 2),
            "estimate: s of a second pass": round(second, 2),
            f"estimate: largest relative difference to unpadded, {compared} runs": worst,
        }
        report(result)
        done("tuning")
        tuned, spent = timed(
            lambda: tuning.tune(runs, model=model, objective="likelihood", iterations=iterations)
        )
        programs = evaluation._value_and_gradient._cache_size()
        timed(lambda: tuning.tune(runs, model=model, objective="likelihood", iterations=1))
        more = evaluation._value_and_gradient._cache_size() - programs
        done("done")
    of_tuning = {
        "tune: programs": programs,
        "tune: programs of a second pass": more,
        f"tune: s, {iterations} iterations": round(spent, 2),
        "tune: objective": [float(step.training) for step in tuned.history],
    }
    report(of_tuning)
    print(json.dumps(result | of_tuning))


def report(found: dict[str, Any]) -> None:
    """Print one result per line."""
    for name, value in found.items():
        print(f"{name}: {value}", flush=True)


if __name__ == "__main__":
    main()
