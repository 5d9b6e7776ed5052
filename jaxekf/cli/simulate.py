"""`jaxekf simulate`: recorded runs with known truth."""

from pathlib import Path
from typing import Any

import click

from jaxekf import files, storage
from jaxekf import simulate as simulator
from jaxekf.cli.console import json_option, note, overwrite_option, print_json


class _Finite(click.FloatRange):
    """A number within bounds; NaN, which is within any, is refused."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        number = super().convert(value, param, ctx)
        if number != number:
            self.fail(f"got '{value}', expected a number; try 0", param, ctx)
        return number


def _spans(
    _: click.Context, __: click.Parameter, values: tuple[str, ...]
) -> list[tuple[float, float]]:
    spans = []
    for value in values:
        try:
            begin, end = (float(part) for part in value.split(","))
        except ValueError:
            raise click.BadParameter(
                f"got '{value}', expected START,END in seconds; try 20,20.5"
            ) from None
        if not 0.0 <= begin < end:
            raise click.BadParameter(f"got '{value}', expected 0 <= START < END; try 20,20.5")
        spans.append((begin, end))
    return spans


@click.command()
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("runs"), show_default=True
)
@click.option(
    "--motion",
    type=click.Choice(["free", "constant-rate"]),
    default="free",
    show_default=True,
    help="Smooth rotations about all axes, or the paper's turn about x.",
)
@click.option("--runs", type=click.IntRange(1), default=1, show_default=True)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Of the first run; the next have the next.",
)
@click.option(
    "--duration", type=_Finite(0.5, 1e5), default=60.0, show_default=True, help="Seconds."
)
@click.option(
    "--rate",
    type=_Finite(-1e4, 1e4),
    default=-9.0,
    show_default=True,
    help="Constant rate, deg/s.",
)
@click.option(
    "--speed",
    type=_Finite(-1e4, 1e4),
    default=40.0,
    show_default=True,
    help="Free motion, deg/s rms per axis.",
)
@click.option(
    "--rest",
    type=_Finite(0.0),
    default=5.0,
    show_default=True,
    help="Seconds at rest at the start.",
)
@click.option(
    "--occlusion", multiple=True, callback=_spans, help="START,END in seconds; repeatable."
)
@click.option(
    "--dropouts",
    type=_Finite(0.0, 1.0),
    default=0.0,
    show_default=True,
    help="Share of tracker samples lost.",
)
@click.option(
    "--optical-noise",
    type=_Finite(0.0, 1e3),
    default=0.3,
    show_default=True,
    help="deg per axis.",
)
@click.option(
    "--gyroscope-noise",
    type=_Finite(0.0, 1e3),
    default=0.05,
    show_default=True,
    help="deg/s/sqrt(Hz).",
)
@click.option(
    "--bias",
    type=_Finite(0.0, 1e3),
    default=0.5,
    show_default=True,
    help="deg/s, standard deviation at the start.",
)
@click.option(
    "--bias-walk",
    type=_Finite(0.0, 1e3),
    default=0.005,
    show_default=True,
    help="deg/s^2/sqrt(Hz).",
)
@overwrite_option
@json_option
def simulate(
    output: Path,
    motion: str,
    runs: int,
    seed: int,
    duration: float,
    rate: float,
    speed: float,
    rest: float,
    occlusion: list[tuple[float, float]],
    dropouts: float,
    optical_noise: float,
    gyroscope_noise: float,
    bias: float,
    bias_walk: float,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate runs: 62.5 Hz tracker, 125 Hz gyroscope, encoder. Every seed is explicit."""
    grade = simulator.SensorGrade(
        gyroscope_deg=gyroscope_noise,
        bias_walk_deg=bias_walk,
        bias_deg=bias,
        optical_deg=optical_noise,
    )
    for number in range(seed, seed + runs):
        files.check_output(output / f"{motion}-{number}", "recording.toml", overwrite=overwrite)
    written = []
    for number in range(seed, seed + runs):
        chosen = (
            simulator.constant_rate_motion(rate, rest)
            if motion == "constant-rate"
            else simulator.free_motion(number, speed_deg=speed, rest_s=rest)
        )
        name = f"{motion}-{number}"
        recording = simulator.recording(
            name,
            chosen,
            seed=number,
            duration_s=duration,
            grade=grade,
            occlusions=occlusion,
            dropouts=dropouts,
        )
        written.append(str(storage.save(recording, output / name, overwrite=overwrite, digits=10)))
        note(f"wrote {written[-1]}")
    if as_json:
        print_json({"runs": written})
