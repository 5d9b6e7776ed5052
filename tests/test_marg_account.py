"""What became of every row of a file of which the model `marg` uses some: one run for all of it."""

import numpy as np

import jaxekf
from jaxekf.estimation import timeline
from jaxekf.recordings.types import Imu, Recording

HERTZ, ROWS = 400.0, 1000
LATE = 6
"""The row in which the magnetometer is read for the first time; from there on every other one is."""
MASKED = (101, 300, 302, 303)
"""Rows without a specific force, two of them with a reading of the magnetometer."""
REPEATED = (20, 21, 400)
"""Rows that stand in the file twice, with a reading of the magnetometer and without."""
HEADER = "time,gx,gy,gz,ax,ay,az,mx,my,mz"


def lines():
    """A file at rest, in its order."""
    rng = np.random.default_rng(4)
    noise = rng.standard_normal((ROWS, 9)) * np.repeat([1e-3, 0.02, 0.3], 3)
    values = noise + np.repeat([[0.0, 0.0, 0.0, 0.0, 0.0, 9.81, 0.0, 20.0, -44.0]], ROWS, axis=0)
    found = [HEADER]
    for i, row in enumerate(values):
        cells = [f"{x:.9f}" for x in row]
        if i < LATE or i % 2:
            cells[6:] = ["", "", ""]
        if i in MASKED:
            cells[3:6] = ["nan", "", "nan"]
        line = ",".join([f"{i / HERTZ:.4f}", *cells])
        found += [line] * (2 if i in REPEATED else 1)
    return found


def write(folder):
    (folder / "recording.toml").write_text(
        'schema_version = 1\nname = "run"\nfield_ref = [0.0, 1.0, 0.0]\n[imu]\nkind = "imu"\n'
    )
    (folder / "imu.csv").write_text("\n".join(lines()) + "\n")


def test_every_row_of_the_file_has_one_end(tmp_path):
    """Samples that are thinned, or blank, or lost while reading, and that no account tells of, or two."""
    write(tmp_path)
    run = jaxekf.load(tmp_path)
    assert run.intake["imu"].rows == ROWS + len(REPEATED)
    made = jaxekf.estimate(run, "marg")
    read = [i for i in range(LATE, ROWS, 2) if i not in MASKED]
    thinned = len(read) - len(read[::2])
    assert made.account["magnetometer"] == {
        "read": ROWS + len(REPEATED),
        "masked": ROWS - len(read),
        "dropped_outside_run": 0,
        "dropped_thinned": thinned,
        "dropped_repeated": len(REPEATED),
        "gated": 0,
        "used": len(read) - thinned,
    }
    assert made.account["imu"] == {
        "read": ROWS + len(REPEATED),
        "masked": len(MASKED),
        "dropped_outside_run": LATE,
        "dropped_repeated": len(REPEATED),
        "used": ROWS - len(MASKED) - LATE,
    }
    for name, account in made.account.items():
        assert account["read"] == sum(n for key, n in account.items() if key != "read"), name
    taken = made.sensors["magnetometer"].time_ns
    np.testing.assert_array_equal(taken, np.round(np.array(read[::2]) / HERTZ * 1e9))
    # It rests, and says so once it has for a second.
    rest = made.sensors["rest"]
    shown = rest.used.any(axis=1)
    assert not shown[rest.time_ns < 0.99e9].any() and shown[rest.time_ns > 1.02e9].mean() > 0.9


def test_without_a_file_samples_are_counted(tmp_path):
    """An account of a run made in memory in rows of a file that it does not come from."""
    write(tmp_path)
    imu = jaxekf.load(tmp_path).need_imu()
    cut = {key: getattr(imu, key)[100:500] for key in imu.per_sample}
    part = Recording("part", imu=Imu(imu.time_ns[100:500], **cut))
    account = timeline.build(jaxekf.get_model("marg"), part).account["magnetometer"]
    good = int(np.isfinite(cut["magnetometer"]).all(axis=1).sum())
    assert account["read"] == good
    assert account["dropped_thinned"] == good // 2
    assert account["fed"] == good - good // 2
    assert (account["masked"], account["dropped_outside_run"]) == (0, 0)
