"""`jaxekf simulate`: recorded runs with known truth."""

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from jaxekf.cli.console import json_option, overwrite_option, print_json, wrote
from jaxekf.cli.options import Finite, Span, hidden, spans
from jaxekf.io import atomic, run_folder
from jaxekf.recordings.types import Recording
from jaxekf.simulation import attitude_runs as simulator
from jaxekf.simulation import marker_runs

# Options that one kind of motion has no use for: to take them in silence would simulate something else
# than was asked.
_ROTATION_ONLY = ("rate", "speed", "rest", "occlusion", "dropouts", "optical_noise")
_TOOL_ONLY = ("hide", "latency", "marker_noise", "accelerometer_noise", "accelerometer_bias")


@click.command()
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("runs"), show_default=True
)
@click.option(
    "--motion",
    type=click.Choice(["free", "constant-rate", "tool"]),
    default="free",
    show_default=True,
    help="free: smooth rotations about all axes; constant-rate: the paper's turn about x; tool: a hand's"
    " motion in six degrees of freedom, seen as single markers.",
)
@click.option("--runs", type=click.IntRange(1), default=1, show_default=True)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Of the first run; the next have the next.",
)
@click.option("--duration", type=Finite(0.5, 1e5), default=60.0, show_default=True, help="Seconds.")
@click.option(
    "--rate", type=Finite(-1e4, 1e4), default=-9.0, show_default=True, help="Constant rate, deg/s."
)
@click.option(
    "--speed",
    type=Finite(-1e4, 1e4),
    default=40.0,
    show_default=True,
    help="Free motion, deg/s rms per axis.",
)
@click.option(
    "--rest", type=Finite(0.0), default=5.0, show_default=True, help="Seconds at rest at the start."
)
@click.option(
    "--occlusion", multiple=True, callback=spans, help="START,END in seconds; repeatable."
)
@click.option(
    "--dropouts",
    type=Finite(0.0, 1.0),
    default=0.0,
    show_default=True,
    help="Share of tracker samples lost.",
)
@click.option(
    "--optical-noise", type=Finite(0.0, 1e3), default=0.3, show_default=True, help="deg per axis."
)
@click.option(
    "--gyroscope-noise",
    type=Finite(0.0, 1e3),
    default=0.05,
    show_default=True,
    help="deg/s/sqrt(Hz).",
)
@click.option(
    "--bias",
    type=Finite(0.0, 1e3),
    default=0.5,
    show_default=True,
    help="Of the gyroscope, deg/s, standard deviation at the start.",
)
@click.option(
    "--bias-walk",
    type=Finite(0.0, 1e3),
    default=None,
    help="Of the gyroscope, deg/s^2/sqrt(Hz).  [default: 0.005; tool 0.002]",
)
@click.option(
    "--hide",
    multiple=True,
    callback=hidden,
    help="Tool: START,END[,MARKER...]: seconds, and which of the markers 1, 2, 3 are hidden (all where"
    " none is named); repeatable.",
)
@click.option(
    "--latency",
    type=Finite(0.0, 10.0),
    default=0.034,
    show_default=True,
    help="Tool: seconds from when a frame is taken to its stamp.",
)
@click.option(
    "--marker-noise",
    type=Finite(0.0, 1e3),
    default=0.231,
    show_default=True,
    help="Tool: mm per axis.",
)
@click.option(
    "--accelerometer-noise",
    type=Finite(0.0, 1e6),
    default=1.85,
    show_default=True,
    help="Tool: mg/sqrt(Hz).",
)
@click.option(
    "--accelerometer-bias",
    type=Finite(0.0, 1e3),
    default=0.1,
    show_default=True,
    help="Tool: m/s^2, standard deviation at the start.",
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
    """Simulate runs with their truth. Every seed is explicit.

    The motions free and constant-rate have a 62.5 Hz tracker of the attitude, a 125 Hz gyroscope and an
    encoder: for `jaxekf estimate RUN`. A tool has three markers on an L with legs of 10 cm, seen every 18
    ms and stamped late, a 500 Hz gyroscope and accelerometer in its corner, and the true pose: for
    `jaxekf estimate RUN --model tight`.
    """
    _refuse_what_does_not_apply(ctx, motion)
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


def _refuse_what_does_not_apply(ctx: click.Context, motion: str) -> None:
    """An option that this motion has no use for is a mistake, not to be passed over."""
    for name in _ROTATION_ONLY if motion == "tool" else _TOOL_ONLY:
        if ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            other = "another motion" if motion == "tool" else "--motion tool"
            hint = "; hide markers by --hide" if name == "occlusion" else ""
            raise click.UsageError(
                f"got --{name.replace('_', '-')} with --motion {motion}, expected it with {other} only;"
                f" leave it out{hint}"
            )


def _rotation(motion: str, seed: int, options: dict[str, Any]) -> Recording:
    """A run of the tracker's attitude and a gyroscope."""
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
    """A run of single markers, gyroscope and accelerometer."""
    walk, given = options["bias_walk"], marker_runs.ToolGrade()
    grade = marker_runs.ToolGrade(
        gyroscope_deg=options["gyroscope_noise"],
        accelerometer_mg=options["accelerometer_noise"],
        bias_walk_deg=given.bias_walk_deg if walk is None else walk,
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


def _hidden(asked: list[Span], names: tuple[str, ...]) -> marker_runs.Hidden:
    """Marker by marker; a span that names none hides all."""
    found = []
    for span in asked:
        for name in span.markers or names:
            if name not in names:
                raise click.UsageError(
                    f"got the marker '{name}' in --hide, expected one of {', '.join(names)};"
                    " check its name"
                )
            found.append((name, span.begin_s, span.end_s))
    return found
