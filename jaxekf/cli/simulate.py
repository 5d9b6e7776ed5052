"""`jaxekf simulate`: simulated runs with known truth."""

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from jaxekf.cli.console import (
    default_option,
    json_option,
    output_option,
    overwrite_option,
    print_json,
    wrote,
)
from jaxekf.cli.options import Finite, Span, hidden, spans
from jaxekf.io import atomic, run_folder
from jaxekf.recordings.types import Recording
from jaxekf.simulation import attitude_runs as simulator
from jaxekf.simulation import marker_runs

# Options that apply to one kind of motion only; for another kind they are an error.
_ROTATION_ONLY = ("rate", "speed", "rest", "occlusion", "dropouts", "optical_noise")
_TOOL_ONLY = ("hide", "latency", "marker_noise", "accelerometer_noise", "accelerometer_bias")


@click.command()
@output_option("runs", "Folder for the run folders MOTION-SEED.")
@default_option(
    "--motion",
    click.Choice(["free", "constant-rate", "tool"]),
    "free",
    "Motion. free: smooth rotation about all axes; constant-rate: rotation about x at a constant rate;"
    " tool: hand motion in six degrees of freedom, measured as single markers.",
)
@default_option("--runs", click.IntRange(1), 1, "Number of runs.")
@default_option(
    "--seed",
    click.IntRange(0),
    0,
    "Random seed of the first run; it increases by one from run to run.",
)
@default_option("--duration", Finite(0.5, 1e5), 60.0, "Duration, s.")
@default_option("--rate", Finite(-1e4, 1e4), -9.0, "Rate of the constant-rate motion, deg/s.")
@default_option("--speed", Finite(-1e4, 1e4), 40.0, "Rate of the free motion, deg/s RMS per axis.")
@default_option("--rest", Finite(0.0), 5.0, "Rest at the start, s.")
@click.option(
    "--occlusion",
    multiple=True,
    callback=spans,
    help="Interval START,END without tracker samples, s; repeatable.",
)
@default_option("--dropouts", Finite(0.0, 1.0), 0.0, "Fraction of tracker samples lost at random.")
@default_option(
    "--optical-noise",
    Finite(0.0, 1e3),
    0.3,
    "Standard deviation of the tracker's attitude, deg per axis.",
)
@default_option(
    "--gyroscope-noise",
    Finite(0.0, 1e3),
    0.05,
    "White noise density of the gyroscope, deg/s/sqrt(Hz).",
)
@default_option(
    "--bias", Finite(0.0, 1e3), 0.5, "Standard deviation of the initial gyroscope bias, deg/s."
)
@click.option(
    "--bias-walk",
    type=Finite(0.0, 1e3),
    default=None,
    help="Random walk of the gyroscope bias, deg/s^2/sqrt(Hz).  [default: 0.005; tool: 0.002]",
)
@click.option(
    "--hide",
    multiple=True,
    callback=hidden,
    help="Interval START,END[,MARKER...] in which the named markers out of 1, 2, 3, or all, are hidden, s"
    " (tool); repeatable.",
)
@default_option(
    "--latency", Finite(0.0, 10.0), 0.034, "Latency of the tracker's time stamps, s (tool)."
)
@default_option(
    "--marker-noise",
    Finite(0.0, 1e3),
    0.231,
    "Standard deviation of a marker position, mm per axis (tool).",
)
@default_option(
    "--accelerometer-noise",
    Finite(0.0, 1e6),
    1.85,
    "White noise density of the accelerometer, mg/sqrt(Hz) (tool).",
)
@default_option(
    "--accelerometer-bias",
    Finite(0.0, 1e3),
    0.1,
    "Standard deviation of the initial accelerometer bias, m/s^2 (tool).",
)
@overwrite_option
@json_option
@click.pass_context
def simulate(
    ctx: click.Context,
    output: Path,
    motion: str,
    runs: int,
    seed: int,
    overwrite: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Simulate runs with their truth.

    The motions free and constant-rate have a 62.5 Hz attitude tracker, a 125 Hz gyroscope and an encoder;
    estimate them with `jaxekf estimate RUN`. The motion tool has three markers on an L with legs of 10 cm,
    one frame every 18 ms with late time stamps, a 500 Hz gyroscope and accelerometer in the corner, and the
    true pose; estimate it with `jaxekf estimate RUN --model tight`.
    """
    _check_options(ctx, motion)
    for number in range(seed, seed + runs):
        atomic.check_output(output / f"{motion}-{number}", "recording.toml", overwrite=overwrite)
    written = []
    for number in range(seed, seed + runs):
        record = _tool if motion == "tool" else _rotation
        recording = record(motion, number, options)
        folder = output / recording.name
        written.append(str(run_folder.save(recording, folder, overwrite=overwrite, digits=10)))
        wrote(folder)
    if as_json:
        print_json({"runs": written})


def _check_options(ctx: click.Context, motion: str) -> None:
    """Raise `click.UsageError` for an option that does not apply to this motion."""
    for name in _ROTATION_ONLY if motion == "tool" else _TOOL_ONLY:
        if ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            other = "another motion" if motion == "tool" else "--motion tool"
            hint = "; hide markers by --hide" if name == "occlusion" else ""
            raise click.UsageError(
                f"got --{name.replace('_', '-')} with --motion {motion}, expected it with {other} only;"
                f" leave it out{hint}"
            )


def _rotation(motion: str, seed: int, options: dict[str, Any]) -> Recording:
    """Simulate an attitude tracker and a gyroscope."""
    walk = options["bias_walk"]
    grade = simulator.SensorGrade(
        gyroscope_deg=options["gyroscope_noise"],
        bias_walk_deg=0.005 if walk is None else walk,
        bias_deg=options["bias"],
        optical_deg=options["optical_noise"],
    )
    chosen = (
        simulator.constant_rate_motion(options["rate"], options["rest"])
        if motion == "constant-rate"
        else simulator.free_motion(seed, speed_deg=options["speed"], rest_s=options["rest"])
    )
    return simulator.recording(
        f"{motion}-{seed}",
        chosen,
        seed=seed,
        duration_s=options["duration"],
        grade=grade,
        occlusions=options["occlusion"],
        dropouts=options["dropouts"],
    )


def _tool(motion: str, seed: int, options: dict[str, Any]) -> Recording:
    """Simulate single markers, gyroscope and accelerometer."""
    walk, default = options["bias_walk"], marker_runs.ToolGrade()
    grade = marker_runs.ToolGrade(
        gyroscope_deg=options["gyroscope_noise"],
        accelerometer_mg=options["accelerometer_noise"],
        bias_walk_deg=default.bias_walk_deg if walk is None else walk,
        bias_deg=options["bias"],
        accelerometer_bias=options["accelerometer_bias"],
        marker_mm=options["marker_noise"],
        latency_s=options["latency"],
    )
    tool = marker_runs.Tool()
    return marker_runs.tool_recording(
        f"{motion}-{seed}",
        marker_runs.free_tool_motion(seed),
        seed=seed,
        duration_s=options["duration"],
        grade=grade,
        tool=tool,
        hidden=_hidden(options["hide"], tool.names),
    )


def _hidden(spans: list[Span], names: tuple[str, ...]) -> marker_runs.Hidden:
    """Hidden intervals of each marker; a span without names is for all markers."""
    intervals = []
    for span in spans:
        for name in span.markers or names:
            if name not in names:
                raise click.UsageError(
                    f"got the marker '{name}' in --hide, expected one of {', '.join(names)};"
                    " check its name"
                )
            intervals.append((name, span.begin_s, span.end_s))
    return intervals
