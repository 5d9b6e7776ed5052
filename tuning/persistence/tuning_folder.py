"""A tuning as a folder: parameter files, and `tuning.json` for the report."""

from collections.abc import Sequence
from pathlib import Path

from jaxekf.estimation import parameters
from jaxekf.io.atomic import whole_set
from tuning.persistence.tuning_document import JudgedOn, record, write_record
from tuning.results.comparison import Row
from tuning.results.held_out import CrossValidation
from tuning.results.tuned import Tuned


def save(
    tuned: Tuned,
    folder: Path | str,
    *,
    rows: Sequence[Row] = (),
    judged_on: JudgedOn | None = None,
    folds: CrossValidation | None = None,
) -> None:
    """Write a tuning into a folder: `noise.toml`, `calibration.toml` and `tuning.json`.

    The parameter files hold units and origin. If runs have parameters of their own, ``runs/NAME`` has the
    same files for each. A new folder is written atomically. In a folder that exists each file is replaced
    atomically, and the ``tuning`` in their origins is the same in all files of one tuning, so that
    `load_parameters` and the report refuse a mixture that a kill has left.

    Parameters
    ----------
    tuned
        The tuning.
    folder
        Folder to write; an earlier tuning in it is replaced.
    rows, judged_on, folds
        Further contents of `tuning.json`, see `tuning.save_record`.

    Raises
    ------
    TuningError
        If `judged_on` contradicts the names of the runs; then nothing is written.

    Examples
    --------
    >>> import tempfile
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-1",))
    >>> tuned = tuning.tune(runs, objective="likelihood", free=["noise.optical"], iterations=2)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     tuning.save(tuned, folder)
    ...     again = jaxekf.load_parameters(tuned.model, folder)
    >>> bool(again.noise.optical == tuned.params.noise.optical)
    True
    """
    document = record(tuned, rows=rows, judged_on=judged_on, folds=folds)
    origin = tuned.origin | {"tuning": tuned.digest}
    with whole_set(folder) as made:
        parameters.save(made, tuned.model, tuned.params, origin | {"inputs": tuned.inputs})
        for name, params in tuned.each.items():
            own = {key: files for key, files in tuned.inputs.items() if key == name}
            of_run = made / "runs" / name
            parameters.save(of_run, tuned.model, params, origin | {"inputs": own})
    if not parameters.leaf_names(tuned.params.calibration):
        # The calibration of an earlier model must not be read with the noise of this one.
        (Path(folder) / "calibration.toml").unlink(missing_ok=True)
    parameters.forget(Path(folder) / "runs", keep=tuned.each)
    write_record(folder, document)
