"""The demo recordings that come with the package, made by its own simulator.

Seven runs with different motions: the paper's constant rate, and free rotations from slow to fast, each
with a rest at the start and some occlusions. `paths` returns their folders.
"""

from functools import partial
from pathlib import Path

import numpy as np

from jaxekf.io import run_folder
from jaxekf.recordings.types import Recording
from jaxekf.simulation import attitude_runs

FOLDER = Path(__file__).parent / "demo_runs"
TRAINING = ("free-1", "free-2", "free-3")
VALIDATION = ("free-4",)
TESTING = ("constant-rate", "free-5", "free-6")

_GRADE = attitude_runs.SensorGrade(
    gyroscope_deg=0.05, bias_walk_deg=0.005, bias_deg=0.6, optical_deg=0.3, encoder_hz=62.5
)
_START_NS = 1_700_000_000_000_000_000
_DURATION_S = 24.0
_SPEEDS_DEG = (20.0, 45.0, 80.0, 35.0, 60.0, 30.0)


def paths(names: tuple[str, ...]) -> list[Path]:
    """Folders of the bundled runs.

    Examples
    --------
    >>> import jaxekf
    >>> [path.name for path in jaxekf.demo.paths(jaxekf.demo.TRAINING)]
    ['free-1', 'free-2', 'free-3']
    """
    return [FOLDER / name for name in names]


def make() -> list[Recording]:
    """The bundled runs, simulated anew; reproducible but for rounding in the CSV files.

    Examples
    --------
    >>> import numpy as np
    >>> import jaxekf
    >>> made = {run.name: run for run in jaxekf.demo.make()}
    >>> kept = jaxekf.load(jaxekf.demo.FOLDER / "free-5")
    >>> np.allclose(made["free-5"].need_imu().gyroscope, kept.need_imu().gyroscope, atol=1e-5)
    True
    """
    record = partial(attitude_runs.recording, duration_s=_DURATION_S, grade=_GRADE)
    motion, hidden = attitude_runs.constant_rate_motion(rest_s=6.0), [(16.0, 16.5)]
    runs = [record("constant-rate", motion, seed=100, occlusions=hidden, start_ns=_START_NS)]
    for number, speed in enumerate(_SPEEDS_DEG, start=1):
        rng = np.random.default_rng([number, 2])
        begins = np.array([6.0, 12.0, 18.0]) + rng.uniform(0.0, 3.0, 3)
        runs.append(
            record(
                f"free-{number}",
                attitude_runs.free_motion(number, speed_deg=speed),
                seed=100 + number,
                occlusions=list(zip(begins, begins + np.array([0.5, 1.0, 2.0]), strict=True)),
                dropouts=0.01,
                start_ns=_START_NS + number * 60_000_000_000,
            )
        )
    return runs


def write(folder: Path = FOLDER) -> None:
    """Write the bundled runs with seven digits."""
    for run in make():
        run_folder.save(run, folder / run.name, overwrite=True, digits=7)


if __name__ == "__main__":
    write()
