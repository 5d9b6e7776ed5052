"""The command line: simulate, import, check, allan, align, estimate, tune, plot, report, demo."""

import click
import jax

from jaxekf import __version__
from jaxekf.cli.align import align
from jaxekf.cli.allan import allan
from jaxekf.cli.check import check
from jaxekf.cli.console import Commands
from jaxekf.cli.demo import demo
from jaxekf.cli.estimate import estimate
from jaxekf.cli.imports import import_run
from jaxekf.cli.machine import prepare
from jaxekf.cli.plot import plot
from jaxekf.cli.report import report
from jaxekf.cli.simulate import simulate
from jaxekf.cli.tune import tune


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="jaxekf")
def main() -> None:
    """Attitude, rate, bias and pose from recorded runs of an optical tracker and an IMU.

    A run is a folder with recording.toml, optical.csv or markers.csv, imu.csv and, for truth, encoder.csv;
    or with camera.csv and landmarks.csv.
    """
    jax.config.update("jax_enable_x64", True)
    prepare()


for command in (simulate, import_run, check, allan, align, estimate, tune, plot, report, demo):
    main.add_command(command)
