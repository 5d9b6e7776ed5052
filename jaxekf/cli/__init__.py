"""The command line: simulate, import, check, crop, allan, align, estimate, tune, plot, report, demo.

Each command is a module here, imported only when the command runs. A new command is a module with its line
in `_SUMMARIES`.
"""

import click

from jaxekf import __version__
from jaxekf.cli.commands import LazyCommand, LazyGroup

_SUMMARIES = {
    "align": "Clock offset and rotation between tracker and IMU.",
    "allan": "Noise densities of an IMU from a static recording.",
    "check": "Check of samples, gaps, clocks, frames and units.",
    "crop": "A part of a run, as a run of its own.",
    "demo": "Tuning and estimates of the bundled recordings.",
    "estimate": "Attitude, rate, biases and pose of runs.",
    "import": "Recordings of other programs, converted to runs.",
    "plot": "Figures of runs.",
    "report": "Results as one HTML page that works offline.",
    "simulate": "Simulated runs with their truth.",
    "tune": "Noise and calibration, tuned by gradient on runs.",
}
# A Python module or function cannot have the name `import`.
_OTHER_NAMES = {"import": ("imports", "import_run")}


def _lazy_command(name: str) -> LazyCommand:
    module, attribute = _OTHER_NAMES.get(name, (name, name))
    return LazyCommand(f"jaxekf.cli.{module}", attribute, _SUMMARIES[name])


@click.group(
    cls=LazyGroup,
    lazy_commands={name: _lazy_command(name) for name in _SUMMARIES},
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name="jaxekf")
def main() -> None:
    """Attitude, rate, bias and pose from recorded runs of an optical tracker and an IMU.

    A run is a folder with recording.toml, imu.csv and optical.csv, markers.csv or camera.csv with
    landmarks.csv; encoder.csv has the truth, if it is known.
    """
    # The import of JAX takes most of a second; the help and the version end before it.
    from jaxekf._support.compilation import set_up
    from jaxekf.cli.machine import prepare

    set_up()
    prepare()
