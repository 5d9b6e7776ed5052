"""`jaxekf allan`: noise densities from what rests."""

from pathlib import Path
from typing import Any

import click
import numpy as np

from jaxekf.calibration.allan import SensorNoise
from jaxekf.calibration.noise_densities import Coefficient
from jaxekf.calibration.static_interval import TrackerNoise
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
    overwrite_option,
    print_json,
    print_table,
)
from jaxekf.estimation import parameters
from jaxekf.estimation.batch import provenance
from jaxekf.io.atomic import check_output, whole_folder
from jaxekf.io.hashes import inputs_of
from jaxekf.io.run_folder import read_log
from jaxekf.models import get_model
from jaxekf.reporting.plots.deviations import allan as draw
from jaxekf.reporting.plots.style import save


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--from", "begin_s", type=click.FloatRange(0.0), help="Seconds: where the stretch begins."
)
@click.option(
    "--to",
    "end_s",
    type=click.FloatRange(0.0, min_open=True),
    help="Seconds from the IMU's first sample.  [default: while the gyroscope stays quiet]",
)
@model_option
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("allan"), show_default=True
)
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
    """Noise densities from LOG: a run that rests at its start, or a CSV file like imu.csv.

    Writes allan.csv and allan.png with the Allan deviation, and noise.toml to tune from: white noise and
    random walk of the bias of gyroscope and accelerometer, and the tracker's scatter at rest. Where the
    rest is too short to tell a random walk it says so.
    """
    check_output(output, "allan.csv", overwrite=overwrite)
    chosen = get_model(model)
    recording = read_log(log)
    found = static_noise(recording, begin_s, end_s)
    start = start_for(chosen, found)
    note(
        f"{found.run}: rests from {found.begin_s:.1f} to {found.end_s:.1f} s, {found.imu.samples} samples"
    )
    if found.imu.missing:
        note(f"{found.run}: {found.imu.missing} missing samples were interpolated")
    for text in start.sentences:
        note(f"{found.run}: {text}")
    with whole_folder(output, "allan.csv", overwrite=overwrite) as folder:
        write_curve(folder / "allan.csv", found)
        save(draw(found), folder / "allan.png")
        origin = {"rest": found.run, "seconds": found.imu.duration_s, "found": list(start.taken)}
        origin |= provenance() | {"inputs": inputs_of([recording])}
        parameters.save_noise(folder, chosen, start.params, origin)
    note(f"wrote {output}: noise.toml for {chosen.name} sets {', '.join(start.taken) or 'nothing'}")
    if as_json:
        files = {name: str(output / name) for name in ("allan.csv", "allan.png", "noise.toml")}
        document = as_dict(found) | {"notes": list(start.sentences), "files": files}
        print_json(document | {"model": chosen.name, "set": list(start.taken)})
        return
    for label, sensor in found.sensors.items():
        _print_sensor(label, sensor)
    _print_tracker(found.tracker)


def _print_sensor(label: str, sensor: SensorNoise) -> None:
    turn = 180.0 / np.pi if sensor.unit.startswith("rad") else 1.0
    white, walk = ("deg/s/√Hz", "deg/s²/√Hz") if turn != 1.0 else ("m/s²/√Hz", "m/s³/√Hz")
    floor, at = sensor.floor()
    rows = []
    for i, (axis, made) in enumerate(zip(AXES, sensor.axes, strict=True)):
        rows.append(
            [
                axis,
                *_with_interval(made.white, turn),
                f"{turn * floor[i]:.3g}",
                f"{at[i]:.3g}",
                f"{turn * made.flicker:.3g}" if made.flicker else "–",
                *_with_interval(made.walk, turn),
            ]
        )
    unit = white.split("/√")[0]
    columns = [
        "axis",
        f"white noise\n({white})",
        "95 %",
        f"lowest\n({unit})",
        "at\n(s)",
        f"flicker\n({unit})",
        f"random walk\n({walk})",
        "95 %",
    ]
    print_table(f"{label.capitalize()} at rest", columns, rows)


def _with_interval(made: Coefficient, turn: float) -> tuple[str, str]:
    """A coefficient and its interval; where it is not told from nothing, the limit alone."""
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
        columns = ["of", "axis", "deviation", "95 %", "unit"]
        print_table("Tracker at rest, sample to sample", columns, rows)
