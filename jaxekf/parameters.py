"""Noise, calibration and initial belief as TOML files with units and where they came from."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tomli_w

from jaxekf.errors import ModelError, RecordingError
from jaxekf.model import Model, Parameters
from jaxekf.storage import SCHEMA_VERSION, write_whole

_SECTIONS = Parameters._fields


def as_arrays(params: Parameters) -> Parameters:
    """The same tree with float arrays at its leaves."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), params)


def leaf_names(section: Any) -> list[str]:
    """Dotted name of each leaf of a pytree of parameters, in the order of its leaves."""
    paths = jax.tree_util.tree_flatten_with_path(section)[0]
    return [
        ".".join(str(getattr(k, "name", getattr(k, "key", k))) for k in path) for path, _ in paths
    ]


def to_document(model: Model, params: Parameters, origin: Mapping[str, Any]) -> dict[str, Any]:
    """A TOML document: each leaf with its value and unit."""
    document: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "model": model.name,
        "origin": dict(origin),
    }
    for section in _SECTIONS:
        values, units = getattr(params, section), getattr(model.units, section)
        entries = {}
        for name, value, unit in zip(
            leaf_names(values), jax.tree.leaves(values), jax.tree.leaves(units), strict=True
        ):
            entries[name] = {"value": np.asarray(value, float).tolist(), "unit": unit}
            if unit.startswith("rad"):
                degrees = np.rad2deg(np.asarray(value, float))
                entries[name]["value_deg"] = np.round(degrees, 9).tolist()
        document[section] = entries
    return document


def save(path: Path | str, model: Model, params: Parameters, origin: Mapping[str, Any]) -> None:
    """Write `noise.toml` (noise and initial belief) and `calibration.toml` into a folder, each whole.

    ``value_deg`` beside a value in radians is for reading only.
    """
    document = to_document(model, params, origin)
    head = {key: document[key] for key in ("schema_version", "model", "origin")}
    noise = head | {"noise": document["noise"], "initial": document["initial"]}
    write_whole(Path(path) / "noise.toml", tomli_w.dumps(noise))
    if document["calibration"]:
        calibration = head | {"calibration": document["calibration"]}
        write_whole(Path(path) / "calibration.toml", tomli_w.dumps(calibration))


def load(model: Model, *paths: Path | str) -> Parameters:
    """The model's defaults with what the given files say instead.

    A folder stands for the `noise.toml` and `calibration.toml` in it.
    """
    params = model.parameters
    for path in map(Path, paths):
        files = [path]
        if path.is_dir():
            files = [f for f in (path / "noise.toml", path / "calibration.toml") if f.is_file()]
            if not files:
                raise RecordingError(path, "a folder without noise.toml", "one", "another folder")
        for file in files:
            params = _read(file, model, params)
    return as_arrays(params)


def _read(path: Path, model: Model, params: Parameters) -> Parameters:
    try:
        document = tomllib.loads(path.read_text("utf-8-sig"))
    except FileNotFoundError:
        raise RecordingError(path, "no such file", "a noise.toml", "another path") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(
            path, f"text that is not TOML ({error})", "TOML", "mending it"
        ) from error
    if document.get("schema_version") != SCHEMA_VERSION:
        raise RecordingError(
            path,
            f"schema_version {document.get('schema_version')!r}",
            str(SCHEMA_VERSION),
            "tuning again with this version",
        )
    if document.get("model") != model.name:
        raise ModelError(
            f"{path}: got parameters of the model '{document.get('model')}', expected those of"
            f" '{model.name}'; choose that model or tune this one"
        )
    for section in _SECTIONS:
        if section in document:
            values = _fill(path, section, getattr(params, section), document[section])
            params = params._replace(**{section: values})
    return params


def _fill(path: Path, section: str, default: Any, entries: Mapping[str, Any]) -> Any:
    names = leaf_names(default)
    unknown = set(entries) - set(names)
    if unknown:
        raise RecordingError(
            path, f"{section} entries {sorted(unknown)}", f"some of {names}", "correcting the names"
        )
    leaves, structure = jax.tree.flatten(default)
    filled = []
    for name, leaf in zip(names, leaves, strict=True):
        value = np.asarray(entries[name]["value"], float) if name in entries else leaf
        # Noise may be given for all axes, for each, or as a factor; calibration keeps its shape.
        if not np.all(np.isfinite(value)) or (
            section == "calibration" and np.shape(value) != np.shape(leaf)
        ):
            raise RecordingError(
                path,
                f"{section}.{name} = {entries[name]['value']}",
                f"finite numbers of shape {np.shape(leaf)}",
                "correcting the value",
            )
        filled.append(value)
    return jax.tree.unflatten(structure, filled)
