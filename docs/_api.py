"""API pages of the public modules, one for each room: a new module is found by itself."""

from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

ROOMS = ("geometry", "models", "simulation", "io", "pose_solvers", "calibration", "evaluation")
"""Rooms whose modules without a leading underscore are public."""
_IO = ("run_folder", "schema", "streams", "container", "export")
"""Modules of `jaxekf.io` for users, besides the importers."""


def public_modules(room: str) -> list[str]:
    """Names of the public modules of a room, relative to it."""
    package = import_module(f"jaxekf.{room}" + (".importers" if room == "io" else ""))
    names = sorted(m.name for m in iter_modules(package.__path__) if not m.name.startswith("_"))
    return [*_IO, *(f"importers.{name}" for name in names)] if room == "io" else names


def write(folder: Path) -> None:
    """Write a page for each room."""
    folder.mkdir(exist_ok=True)
    for room in ROOMS:
        about = (import_module(f"jaxekf.{room}").__doc__ or "").split("\n\n")[0]
        lines = [f"# jaxekf.{room}", "", about]
        for name in public_modules(room):
            directive = f".. automodule:: jaxekf.{room}.{name}\n   :members:"
            lines += ["", f"## {name}", "", "```{eval-rst}", directive, "```"]
        (folder / f"{room}.md").write_text("\n".join([*lines, ""]), "utf-8")
