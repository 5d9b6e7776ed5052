"""Writes every kind of output, over and over, until it is killed; for test_kill.py.

The parent of the writers imports once and forks one for each life that a line on standard input asks for:
the seconds after which to kill it. It answers with a line when that one is dead. No array of JAX is made in
here: a fork of its threads would hang.
"""

import itertools
import json
import os
import signal
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxekf
from jaxekf.estimation import parameters
from jaxekf.estimation.result import Estimate, OutputEstimate, SensorRecord
from jaxekf.io.atomic import whole_set
from jaxekf.models.loose import MODEL, State
from jaxekf.recordings.types import Imu, Recording
from jaxekf.reporting.report import write_report

COUNT = 400


def estimate(number):
    """An estimate all of whose numbers tell which it is."""
    marked = np.full((COUNT, 3), float(number))
    q = np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1))
    cov = np.tile(np.eye(3), (COUNT, 1, 1))
    time_ns = np.arange(COUNT) * 8_000_000
    seen = np.ones((COUNT, 3), bool)
    record = SensorRecord(time_ns, marked, cov, seen, ~seen, marked[:, 0])
    return Estimate(
        run="endless",
        model=MODEL,
        time_ns=time_ns,
        state=State(q, marked),
        cov=np.tile(np.eye(6), (COUNT, 1, 1)) * (number + 1.0),
        outputs={
            "attitude": OutputEstimate(q, cov, "body", "rad"),
            "rate": OutputEstimate(marked, cov, "body", "rad/s"),
        },
        sensors={"optical": record},
        log_likelihood=float(number),
        account={"optical": {"read": COUNT, "used": COUNT}},
        params=MODEL.parameters,
        provenance={"recording": "endless", "versions": {}, "dtype": "float64"},
    )


def tuned(folder, number):
    """What `Tuned.save` writes of the parameters, over an earlier one."""
    turn = MODEL.parameters.calibration._replace(alignment=np.full(3, 1e-6 * number))
    noise = MODEL.parameters.noise._replace(optical=1.0 + number)
    params = MODEL.parameters._replace(calibration=turn, noise=noise)
    with whole_set(folder) as made:
        parameters.save(made, MODEL, params, {"tuning": str(number)})


def write(folder, number):
    """Everything once, over what is there."""
    run = Recording("endless", imu=Imu(np.arange(COUNT) * 8_000_000, np.ones((COUNT, 3))))
    jaxekf.save(replace(run, info={"number": number}), folder / "run", overwrite=True)
    made = estimate(number)
    made.save(folder / "result", overwrite=True, exports=["npz", "hdf5", "tum"])
    for name in ("one.npz", "one.h5", "one.tum", "one.csv"):
        made.export(folder / name, overwrite=True)
    parameters.save(folder / "params", MODEL, MODEL.parameters, {"number": number})
    tuned(folder / "tuned", number)
    write_report([folder / "result"], folder / "report.html", overwrite=True)


def main():
    """Serve lives; the numbers go on from one to the next."""
    warnings.simplefilter("ignore")  # JAX warns of every fork.
    folder = Path(sys.argv[1])
    folder.mkdir(exist_ok=True)
    began = time.perf_counter()
    write(folder, 0)
    print(json.dumps({"seconds": time.perf_counter() - began}), flush=True)
    for life, line in enumerate(sys.stdin, 1):
        child = os.fork()
        if child == 0:
            for number in itertools.count(1000 * life):
                write(folder, number)
        time.sleep(float(line))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        print("{}", flush=True)


if __name__ == "__main__":
    main()
