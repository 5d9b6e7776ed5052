"""Noise, calibration and initial belief as TOML files, with units and origin."""

import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tomli_w

from jaxekf._support.errors import ModelError, RecordingError
from jaxekf.filtering import arguments
from jaxekf.filtering.model import Model, Parameters
from jaxekf.io.atomic import write_whole
from jaxekf.io.run_folder import SCHEMA_VERSION
from jaxekf.models import get_model

_SECTIONS = ("noise", "calibration", "initial")


def as_arrays(params: Parameters) -> Parameters:
    """The parameters with float arrays as leaves."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), params)


def for_model(model: Model, params: Parameters) -> Parameters:
    """The parameters with float arrays as leaves, as `arguments.parameters` checks them."""
    return as_arrays(arguments.parameters(model, params))


def for_runs(params: Parameters, setup: Any, runs: int) -> Parameters:
    """The same parameters for each of several runs, on a new leading axis that `setup` has already."""
    shared = params._replace(setup=())
    every = jax.tree.map(lambda a: jnp.broadcast_to(a, (runs, *jnp.shape(a))), shared)
    return every._replace(setup=setup)


def leaf_names(section: Any) -> list[str]:
    """Dotted names of the leaves of a pytree of parameters, in the order of its leaves."""
    paths = jax.tree_util.tree_flatten_with_path(section)[0]
    return [
        ".".join(str(getattr(k, "name", getattr(k, "key", k))) for k in path) for path, _ in paths
    ]


def leaves_by_name(section: Any) -> dict[str, Any]:
    """The leaves of a pytree of parameters by their dotted names, in the order of its leaves."""
    return dict(zip(leaf_names(section), jax.tree.leaves(section), strict=True))


def to_document(model: Model, params: Parameters, origin: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters as a TOML document; each leaf has its value and unit."""
    document: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "model": model.name,
        "origin": dict(origin),
    }
    for section in _SECTIONS:
        units, entries = leaves_by_name(getattr(model.units, section)), {}
        for name, value in leaves_by_name(getattr(params, section)).items():
            array = np.asarray(value, float)
            entries[name] = {"value": array.tolist(), "unit": units[name]}
            if units[name].startswith("rad"):
                entries[name]["value_deg"] = np.round(np.rad2deg(array), 9).tolist()
        document[section] = entries
    return document


def described_arrays(model: Model, params: Parameters) -> dict[str, tuple[Any, str]]:
    """Each parameter as an array with its unit, by ``section/name``.

    The setup, which comes from the recording, is in SI units.
    """
    described = {}
    for section in (*_SECTIONS, "setup"):
        units = {} if section == "setup" else leaves_by_name(getattr(model.units, section))
        for name, leaf in leaves_by_name(getattr(params, section)).items():
            described[f"{section}/{name}"] = (np.asarray(leaf), units.get(name, "SI"))
    return described


def save(path: Path | str, model: Model, params: Parameters, origin: Mapping[str, Any]) -> None:
    """Write parameters into a folder: `noise.toml` (noise and initial belief) and `calibration.toml`.

    Each file is written atomically. ``value_deg`` beside a value in radians is for reading only.

    Parameters
    ----------
    path
        An existing folder.
    model
        The model of the parameters, for their names and units.
    params
        The parameters to write.
    origin
        How they were found, for the section ``origin``.

    Raises
    ------
    ModelError
        A standard deviation is not positive and finite.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import jaxekf
    >>> model = jaxekf.get_model("loose")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     jaxekf.save_parameters(folder, model, model.parameters, {"by": "hand"})
    ...     lines = Path(folder, "noise.toml").read_text().splitlines()
    >>> at = lines.index("[noise.optical]")
    >>> print("; ".join(lines[at : at + 4]))
    [noise.optical]; value = 0.005235987755982988; unit = "rad"; value_deg = 0.3
    """
    params = arguments.parameters(model, params, check_shapes=False)
    save_noise(path, model, params, origin)
    if leaf_names(params.calibration):
        save_calibration(path, model, params, origin)
    else:
        # The calibration of another model must not be read with this noise.
        (Path(path) / "calibration.toml").unlink(missing_ok=True)


def save_noise(
    path: Path | str, model: Model, params: Parameters, origin: Mapping[str, Any]
) -> None:
    """Write `noise.toml` alone; see `save`."""
    check(params)
    _write(Path(path) / "noise.toml", model, params, origin, ("noise", "initial"))


def save_calibration(
    path: Path | str, model: Model, params: Parameters, origin: Mapping[str, Any]
) -> None:
    """Write `calibration.toml` alone; see `save`."""
    _write(Path(path) / "calibration.toml", model, params, origin, ("calibration",))


def forget(folder: Path, keep: Collection[str]) -> None:
    """Remove the parameter files of an earlier result from the folders in `folder`, except from those named
    in `keep`; other files stay."""
    for old in sorted(folder.iterdir()) if folder.is_dir() else ():
        if old.name in keep or not old.is_dir():
            continue
        for name in ("noise.toml", "calibration.toml"):
            (old / name).unlink(missing_ok=True)
        if not any(old.iterdir()):
            old.rmdir()
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _write(
    file: Path,
    model: Model,
    params: Parameters,
    origin: Mapping[str, Any],
    sections: tuple[str, ...],
) -> None:
    document = to_document(model, params, origin)
    kept = ("schema_version", "model", "origin", *sections)
    write_whole(file, tomli_w.dumps({key: document[key] for key in kept}))


def load(model: str | Model, *paths: Path | str) -> Parameters:
    """The model's default parameters, with the values of files in place of the defaults.

    Parameters
    ----------
    model
        The model or its name. The files must name it.
    paths
        Files such as `noise.toml` and `calibration.toml`, or folders with these files; a later file
        overrides an earlier one.

    Returns
    -------
    Parameters
        Float arrays, in the units of `Model.units`.

    Raises
    ------
    RecordingError
        A file is missing, is not TOML, or has other entries, units or shapes than the model.
    ModelError
        A file is of another model, or a standard deviation is not positive and finite.

    Examples
    --------
    >>> import tempfile
    >>> import jaxekf
    >>> model = jaxekf.get_model("loose")
    >>> noise = model.parameters.noise._replace(optical=0.004)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     jaxekf.save_parameters(folder, model, model.parameters._replace(noise=noise), {})
    ...     params = jaxekf.load_parameters("loose", folder)
    >>> print(f"{params.noise.optical:.3f} rad")
    0.004 rad
    """
    model = get_model(model)
    params = model.parameters
    for path in map(Path, paths):
        files = [path]
        if path.is_dir():
            files = [f for f in (path / "noise.toml", path / "calibration.toml") if f.is_file()]
            if not files:
                raise RecordingError(path, "a folder without noise.toml", "one", "another folder")
        documents = {file: _document(file) for file in files}
        _check_together(path, list(documents.values()))
        for file, document in documents.items():
            params = _with_document(file, document, model, params)
    return as_arrays(params)


def _check_together(folder: Path, documents: list[dict[str, Any]]) -> None:
    """Raise `RecordingError` if the files of one folder come from different tunings."""
    origins = [document.get("origin") for document in documents]
    tunings = {o["tuning"] for o in origins if isinstance(o, dict) and "tuning" in o}
    if len(tunings) > 1:
        raise RecordingError(
            folder,
            f"noise.toml and calibration.toml of the tunings {' and '.join(sorted(map(str, tunings)))}",
            "both of the same tuning (it may have been stopped while it wrote them)",
            "tuning again, or naming both files if this is intended",
        )


def _document(path: Path) -> dict[str, Any]:
    """Read a file of parameters and check its version."""
    try:
        document = tomllib.loads(path.read_text("utf-8-sig"))
    except FileNotFoundError:
        raise RecordingError(path, "no such file", "a noise.toml", "another path") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(
            path, f"text that is not TOML ({error})", "TOML", "correcting it"
        ) from error
    if document.get("schema_version") != SCHEMA_VERSION:
        raise RecordingError(
            path,
            f"schema_version {document.get('schema_version')!r}",
            str(SCHEMA_VERSION),
            "tuning again with this version",
        )
    return document


def _with_document(
    path: Path, document: dict[str, Any], model: Model, params: Parameters
) -> Parameters:
    """The parameters with the values of a document in place of theirs."""
    if document.get("model") != model.name:
        raise ModelError(
            f"{path}: got parameters of the model '{document.get('model')}', expected those of"
            f" '{model.name}'; choose that model or tune this one"
        )
    unknown = set(document) - {"schema_version", "model", "origin", *_SECTIONS}
    if unknown:
        raise RecordingError(
            path,
            f"sections {sorted(unknown)}",
            f"some of {list(_SECTIONS)}",
            "correcting the names",
        )
    for section in _SECTIONS:
        if section in document:
            units = getattr(model.units, section)
            values = _with_entries(
                path, section, getattr(params, section), units, document[section]
            )
            params = params._replace(**{section: values})
    check(params, str(path))
    return params


def check(params: Parameters, place: str = "parameters") -> None:
    """Raise `ModelError` for a noise or initial standard deviation that is not positive and finite."""
    for section in ("noise", "initial"):
        for name, leaf in leaves_by_name(getattr(params, section)).items():
            value = np.asarray(leaf, float)
            deviations = np.diagonal(value) if value.ndim == 2 else value
            if not (np.all(np.isfinite(value)) and np.all(deviations > 0.0)):
                raise ModelError(
                    f"{place}: got {section}.{name} = {value.tolist()}, expected positive standard"
                    " deviations; use a small positive number for a nearly exact value"
                )


def _with_entries(path: Path, section: str, default: Any, units: Any, entries: Any) -> Any:
    leaves, units = leaves_by_name(default), leaves_by_name(units)
    if not isinstance(entries, dict):
        raise RecordingError(path, f"{section} = {entries!r}", "a section", f"[{section}.NAME]")
    if unknown := sorted(set(entries) - set(leaves)):
        expected = f"some of {list(leaves)}"
        raise RecordingError(path, f"{section} entries {unknown}", expected, "correcting the names")
    for name, leaf in leaves.items():
        if name in entries:
            given = entries[name], units[name], np.shape(leaf)
            leaves[name] = _value(path, f"{section}.{name}", *given)
    return jax.tree.unflatten(jax.tree.structure(default), list(leaves.values()))


def _value(path: Path, name: str, entry: Any, unit: str, shape: tuple[int, ...]) -> Any:
    """The value of one leaf: noise as one number, one for each axis or a factor; calibration as it is."""
    if not isinstance(entry, dict) or "value" not in entry:
        raise RecordingError(
            path,
            f"{name} = {entry!r}",
            "an entry with value and unit",
            f'value = ..., unit = "{unit}"',
        )
    if entry.get("unit", unit) != unit:
        raise RecordingError(path, f"{name} in {entry['unit']}", unit, "converting the value")
    try:
        value = np.asarray(entry["value"], float)
    except (TypeError, ValueError):
        value = np.full(1, np.nan)
    known = {shape} if name.startswith("calibration") else {(), (3,), (4,), (3, 3), (4, 4), shape}
    if value.shape not in known or not np.all(np.isfinite(value)):
        raise RecordingError(
            path,
            f"{name} = {entry['value']!r}",
            f"finite numbers of a shape in {sorted(known, key=str)}",
            "correcting the value",
        )
    return value
