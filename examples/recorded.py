"""Recorded data for the examples: the folder on the command line, and short pieces for `--smoke`."""

import argparse
import json
import os
import sys
from pathlib import Path

from jaxekf.recordings.types import NANOSECONDS, Recording

DATA = Path(os.environ.get("JAXEKF_DATA", Path(__file__).parents[2] / "shared" / "data"))
"""The folder that `--smoke` looks for data in."""


def parse(parser: argparse.ArgumentParser, name: str) -> argparse.Namespace:
    """The arguments, with `folder` and `smoke` among them.

    With ``--smoke`` the folder may be left out: it is then `name` in `DATA`, and the script ends with a
    sentence where that is not there.
    """
    parser.add_argument("folder", type=Path, nargs="?", help="the recordings")
    parser.add_argument(
        "--smoke", action="store_true", help="one short piece, to see that the script ends"
    )
    arguments = parser.parse_args()
    if arguments.folder is None and not arguments.smoke:
        parser.error("got no folder, expected the one that holds the recordings")
    if arguments.folder is None:
        arguments.folder = DATA / name
        if not arguments.folder.is_dir():
            sentence = (
                f"There is no recorded data in {arguments.folder}; set JAXEKF_DATA to the folder that"
                f" holds {name}."
            )
            print(json.dumps({"skipped": sentence}))
            sys.exit(0)
    return arguments


def piece(recording: Recording, start_s: float, seconds: float) -> Recording:
    """The recording from `start_s` after its IMU's first sample, `seconds` long."""
    begin = int(recording.need_imu().time_ns[0]) + int(start_s * NANOSECONDS)
    end = begin + int(seconds * NANOSECONDS)
    streams = {
        label: stream.take((stream.time_ns >= begin) & (stream.time_ns < end))
        for label, stream in recording.streams.items()
    }
    return recording.with_streams(streams)
