"""Recorded data for the examples: the folder on the command line, and short pieces for `--smoke`."""

import argparse
import json
import os
import sys
from pathlib import Path

from jaxekf import Recording

DATA = Path(os.environ.get("JAXEKF_DATA", Path(__file__).parents[2] / "shared" / "data"))
"""Folder of the recorded data for `--smoke`."""


def parse(parser: argparse.ArgumentParser, name: str) -> argparse.Namespace:
    """Parse the arguments, with `folder` and `smoke` added to them.

    With ``--smoke`` the folder is `name` in `DATA` unless given; if there is none, the script ends with a
    message.
    """
    parser.add_argument("folder", type=Path, nargs="?", help="folder of the recordings")
    parser.add_argument("--smoke", action="store_true", help="a short piece of the data")
    arguments = parser.parse_args()
    if arguments.folder is None and not arguments.smoke:
        parser.error("got no folder, expected the folder of the recordings")
    if arguments.folder is None:
        arguments.folder = DATA / name
        if not arguments.folder.is_dir():
            sentence = (
                f"There is no recorded data in {arguments.folder}; set JAXEKF_DATA to the folder that"
                f" has {name}."
            )
            print(json.dumps({"skipped": sentence}))
            sys.exit(0)
    return arguments


def piece(recording: Recording, start_s: float, seconds: float) -> Recording:
    """The recording from `start_s` after its IMU's first sample, `seconds` long."""
    begin = int(recording.need_imu().time_ns[0]) + int(start_s * 1e9)
    end = begin + int(seconds * 1e9)
    streams = {
        label: stream.take((stream.time_ns >= begin) & (stream.time_ns < end))
        for label, stream in recording.streams.items()
    }
    return recording.with_streams(streams)
