"""The command line: simulate, import, check, allan, align, estimate, tune, plot, report, demo."""

import click

from jaxekf import __version__
from jaxekf.cli.commands import Commands, Place

_SUMMARIES = {
    "align": "Clock offset and rotation between tracker and IMU.",
    "allan": "Noise densities of an IMU from a static log.",
    "check": "Samples, gaps, clocks, frames and units of runs.",
    "demo": "Tuning and estimates on the bundled recordings.",
    "estimate": "Attitude, rate and biases of runs, as result folders.",
    "import": "Recordings of other programs, written as runs.",
    "plot": "Figures of runs.",
    "report": "Results as one HTML page that needs no network.",
    "simulate": "Simulated runs with their truth.",
    "tune": "Noise and calibration, tuned on runs by gradient.",
}
# `import` cannot name a module or a function.
_ELSEWHERE = {"import": ("imports", "import_run")}


def _place(name: str) -> Place:
    module, attribute = _ELSEWHERE.get(name, (name, name))
    return Place(f"jaxekf.cli.{module}", attribute, _SUMMARIES[name])


@click.group(
    cls=Commands,
    places={name: _place(name) for name in _SUMMARIES},
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name="jaxekf")
def main() -> None:
    """Attitude, rate, bias and pose from recorded runs of an optical tracker and an IMU.

    A run is a folder with recording.toml, optical.csv or markers.csv, imu.csv and, for truth, encoder.csv;
    or with camera.csv and landmarks.csv.
    """
    # JAX costs most of a second: not for the help and the version, which end before this.
    from jaxekf._support.compilation import set_up
    from jaxekf.cli.machine import prepare

    set_up()
    prepare()
