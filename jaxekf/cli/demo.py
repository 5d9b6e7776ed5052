"""`jaxekf demo`: tuning, estimates and figures of the bundled recordings."""

import time
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path

import click
import numpy as np

import tuning
from jaxekf.cli.comparison import print_comparison
from jaxekf.cli.console import json_option, note, output_option, print_json, tuning_progress
from jaxekf.estimation.batch import estimate_many
from jaxekf.estimation.parameters import as_arrays
from jaxekf.estimation.result import Estimate
from jaxekf.estimation.versions import provenance
from jaxekf.evaluation.diagnosis import diagnose
from jaxekf.evaluation.metrics import score
from jaxekf.filtering.model import Parameters
from jaxekf.io.atomic import check_output, whole_folder
from jaxekf.io.description import SCHEMA_VERSION
from jaxekf.io.documents import codec
from jaxekf.io.hashes import inputs_of
from jaxekf.io.run_folder import load
from jaxekf.models import get_model
from jaxekf.recordings.types import Recording
from jaxekf.simulation import demo as runs
from tuning.comparison.compare import compare_estimates
from tuning.results.comparison import as_dicts

# Values from data sheets: the best case of the gyroscope, the worst case of the tracker.
_HAND_SET_DEG = {"gyroscope": 0.01, "bias_walk": 0.001, "optical": 1.0}
_ITERATIONS = 20


def _prepare_test(hand_set: Parameters) -> tuple[list[Recording], list[Estimate]]:
    """The test runs and their estimates before tuning; also imports the libraries of the figures."""
    testing = [load(path) for path in runs.paths(runs.TESTING)]
    estimates = estimate_many(testing, "loose", hand_set)
    import_module("jaxekf.cli.plot")
    import_module("scipy.stats")
    return testing, estimates


@click.command()
@output_option(
    "demo", "Folder for noise, estimates and figures; one of an earlier call is replaced."
)
@json_option
def demo(output: Path, as_json: bool) -> None:
    """Tune on some bundled runs, estimate the others, and write tables, estimates and figures.

    The recordings are simulated. A demo folder of an earlier call is replaced.
    """
    check_output(output, "demo.json", overwrite=True)
    began = time.perf_counter()
    model = get_model("loose")
    hand_set = as_arrays(model.parameters)
    deviations = {name: np.deg2rad(value) for name, value in _HAND_SET_DEG.items()}
    hand_set = as_arrays(hand_set._replace(noise=hand_set.noise._replace(**deviations)))
    training, validation = (
        [load(path) for path in runs.paths(names)] for names in (runs.TRAINING, runs.VALIDATION)
    )
    note(f"tuning on {', '.join(runs.TRAINING)}; validating on {', '.join(runs.VALIDATION)}")
    with ThreadPoolExecutor(1) as background:
        # Much of the tuning is compilation on one core; another core is free.
        prepared = background.submit(_prepare_test, hand_set)
        with tuning_progress(_ITERATIONS) as progress:
            tuned = tuning.tune(
                training,
                validate=validation,
                start=hand_set,
                objective=tuning.attitude_error() + 0.01 * tuning.innovation_likelihood(),
                iterations=_ITERATIONS,
                progress=progress,
            )
        testing, before = prepared.result()
    note(f"estimating {', '.join(runs.TESTING)}")
    estimates = {"hand-set": before, "tuned": estimate_many(testing, model, tuned.params)}
    compared = compare_estimates(testing, estimates)
    every = [*training, *validation, *testing]
    # `_prepare_test` has imported the figures and their libraries, during the compilation.
    from jaxekf.cli.plot import draw
    from jaxekf.reporting.plots import available_figures

    figures = []
    with whole_folder(output, "demo.json", overwrite=True) as folder:
        tuning.save(tuned, folder, rows=compared.rows)
        for made, recording in zip(compared.estimates["tuned"], compared.recordings, strict=True):
            found = diagnose(made, recording).as_dict(curves=True)
            judged = score(made, recording).as_dict()
            made.save(folder / "result" / recording.name, diagnosis=found, score=judged)
            chosen = ("attitude", "occlusion")
            if recording.name == "constant-rate":
                chosen = available_figures(made, recording)
            files = draw(made, recording, folder / "figures", chosen)
            figures += [str(output / "figures" / file.name) for file in files]
        document = {
            "schema_version": SCHEMA_VERSION,
            "kind": "jaxekf demo",
            "provenance": provenance() | {"inputs": inputs_of(every)},
            "rows": as_dicts(compared.rows),
            "mean_attitude_rmse_deg": tuning.mean_by_variant(compared.rows),
            "noise_deg": {
                name: float(np.rad2deg(value))
                for name, value in tuned.params.noise._asdict().items()
            },
            "figures": figures,
        }
        (folder / "demo.json").write_text(codec.as_text(document), "utf-8")
    # Not in the file, so that the same runs give the same file.
    document["seconds"] = round(time.perf_counter() - began, 1)
    if as_json:
        print_json(document)
        return
    print_comparison("Test runs, not used for tuning", compared.rows)
    for name, value in document["noise_deg"].items():
        unit = model.units.noise._asdict()[name].replace("rad", "deg", 1)
        click.echo(f"  {name:<10} {_HAND_SET_DEG[name]:>7} -> {value:.4f} {unit}")
    click.echo(f"noise, estimates and figures are in {output}/ ({document['seconds']} s)")
