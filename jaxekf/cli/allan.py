"""`jaxekf allan`: sensor noise from a static recording."""

from pathlib import Path
from typing import Any

import click
import numpy as np

from jaxekf.calibration.allan import SensorNoise
from jaxekf.calibration.noise_densities import Coefficient
from jaxekf.calibration.static_interval import TrackerNoise, longest_rest
from jaxekf.calibration.static_noise import (
    AXES,
    as_dict,
    start_for,
    static_noise,
    write_curve,
)
from jaxekf.cli.console import (
    json_option,
    model_option,
    note,
    output_option,
    overwrite_option,
    print_json,
    print_table,
)
from jaxekf.estimation import parameters
from jaxekf.estimation.versions import provenance
from jaxekf.io.atomic import check_output, whole_folder
from jaxekf.io.hashes import inputs_of
from jaxekf.io.run_folder import read_log
from jaxekf.models import get_model
from jaxekf.recordings.types import NANOSECONDS, Recording
from jaxekf.reporting.plots.deviations import allan as draw
from jaxekf.reporting.plots.style import save


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--from",
    "begin_s",
    type=click.FloatRange(0.0),
    help="Start of the static interval, s after the first IMU sample.  [default: the first sample]",
)
@click.option(
    "--to",
    "end_s",
    type=click.FloatRange(0.0, min_open=True),
    help="End of the static interval, s after the first IMU sample.  [default: the first motion]",
)
@model_option
@output_option("allan", "Folder for allan.csv, allan.png and noise.toml.")
@overwrite_option
@json_option
def allan(
    log: Path,
    begin_s: float | None,
    end_s: float | None,
    model: str,
    output: Path,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Estimate sensor noise from LOG: a run that is static at its start, or a CSV file like imu.csv.

    The output has the Allan deviation (allan.csv, allan.png), and noise.toml, a start for tuning: white
    noise and bias random walk of gyroscope and accelerometer, and standard deviations of the tracker. A
    note names the random walks that the static interval is too short for.
    """
    check_output(output, "allan.csv", overwrite=overwrite)
    chosen = get_model(model)
    recording = read_log(log)
    noise = static_noise(recording, begin_s, end_s)
    start = start_for(chosen, noise)
    times = recording.need_imu().time_ns
    whole = float(times[-1] - times[0]) / NANOSECONDS
    part = f"{noise.begin_s:.1f} to {noise.end_s:.1f} s of {whole:.1f} s"
    note(f"{noise.run}: static from {part}, {noise.imu.samples} samples")
    if begin_s is None and end_s is None:
        _note_longer_rest(recording, noise.end_s, whole)
    if noise.imu.missing:
        note(f"{noise.run}: {noise.imu.missing} missing samples were interpolated")
    for text in start.sentences:
        note(f"{noise.run}: {text}")
    with whole_folder(output, "allan.csv", overwrite=overwrite) as folder:
        write_curve(folder / "allan.csv", noise)
        save(draw(noise), folder / "allan.png")
        origin = {"rest": noise.run, "seconds": noise.imu.duration_s, "found": list(start.taken)}
        origin |= provenance() | {"inputs": inputs_of([recording])}
        parameters.save_noise(folder, chosen, start.params, origin)
    note(f"wrote {output}: noise.toml for {chosen.name} sets {', '.join(start.taken) or 'nothing'}")
    if as_json:
        files = {name: str(output / name) for name in ("allan.csv", "allan.png", "noise.toml")}
        document = as_dict(noise) | {"notes": list(start.sentences), "files": files}
        print_json(document | {"model": chosen.name, "set": list(start.taken)})
        return
    for label, sensor in noise.sensors.items():
        _print_sensor(label, sensor)
    _print_tracker(noise.tracker)


def _note_longer_rest(recording: Recording, end_s: float, whole_s: float) -> None:
    """Print that the rest at the start was taken, and whether the run has a longer one."""
    if end_s > whole_s - 1.0:
        return
    begin, end = longest_rest(recording.need_imu())
    if end - begin > end_s + 1.0:
        choice = f"a longer one is from {begin:g} to {end:g} s (--from {begin:g} --to {end:g})"
    else:
        choice = "--from and --to choose another"
    note(f"{recording.name}: this is the rest at the start; {choice}")


def _print_sensor(label: str, sensor: SensorNoise) -> None:
    turn = 180.0 / np.pi if sensor.unit.startswith("rad") else 1.0
    white, walk = ("deg/s/√Hz", "deg/s²/√Hz") if turn != 1.0 else ("m/s²/√Hz", "m/s³/√Hz")
    floor, at = sensor.floor()
    rows = []
    for i, (axis, noise) in enumerate(zip(AXES, sensor.axes, strict=True)):
        rows.append(
            [
                axis,
                *_with_interval(noise.white, turn),
                f"{turn * floor[i]:.3g}",
                f"{at[i]:.3g}",
                f"{turn * noise.flicker:.3g}" if noise.flicker else "–",
                *_with_interval(noise.walk, turn),
            ]
        )
    unit = white.split("/√")[0]
    columns = [
        "axis",
        f"white noise\n({white})",
        "95 %",
        f"minimum\n({unit})",
        "at τ\n(s)",
        f"flicker\n({unit})",
        f"random walk\n({walk})",
        "95 %",
    ]
    print_table(f"{label.capitalize()} at rest", columns, rows)


def _with_interval(made: Coefficient, turn: float) -> tuple[str, str]:
    """A coefficient and its 95 % interval; only the upper bound if it is not significant."""
    low, high = (f"{turn * value:.3g}" for value in (made.low, made.high))
    return (
        (f"{turn * made.value:.3g}", f"{low} to {high}")
        if made.significant
        else ("–", f"below {high}")
    )


def _print_tracker(noise: TrackerNoise) -> None:
    rows: list[list[Any]] = []
    shown = {
        "optical": ("attitude", "deg, body", 180.0 / np.pi),
        "position": ("position", "mm, reference", 1e3),
        "marker": ("marker", "mm, reference", 1e3),
    }
    for name, (label, unit, factor) in shown.items():
        scatter = getattr(noise, name)
        if scatter is not None:
            rows += [
                [
                    label,
                    axis,
                    f"{factor * scatter.value[i]:.3g}",
                    f"{factor * scatter.low[i]:.3g} to {factor * scatter.high[i]:.3g}",
                    unit,
                ]
                for i, axis in enumerate(AXES)
            ]
    if rows:
        columns = ["measurement", "axis", "standard deviation", "95 %", "unit"]
        print_table("Tracker at rest, from sample to sample", columns, rows)
