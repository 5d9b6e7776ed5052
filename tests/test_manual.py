"""The manual's sources: public names, links, and the length of the README. CI builds it, see `.ci/run`."""

import importlib
import pkgutil
import re
import sys
from pathlib import Path

import pytest

import jaxekf
import tuning

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
ROOMS = ("geometry", "models", "simulation", "pose_solvers", "calibration", "evaluation")
PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("api/*.md"), *ROOT.glob("*.md")])


@pytest.mark.parametrize("package", [jaxekf, tuning])
def test_public_names_are_in_the_reference(package):
    """A public name without a place in the manual, or a place of a name that is no more."""
    page = (DOCS / "api" / f"{package.__name__}.md").read_text("utf-8")
    found = re.findall(rf"^\.\. auto\w+:: {package.__name__}\.(\w+)$", page, re.M)
    assert sorted(found) == sorted(package.__all__)
    assert all(hasattr(package, name) for name in found)


@pytest.mark.parametrize("room", [*ROOMS, "io"])
def test_public_modules_are_in_the_reference(room):
    """A new public module that nobody finds, or a page of a module that has moved."""
    page = (DOCS / "api" / f"{room}.md").read_text("utf-8")
    listed = re.findall(rf"^\.\. automodule:: jaxekf\.{room}\.([\w.]+)$", page, re.M)
    for name in listed:
        importlib.import_module(f"jaxekf.{room}.{name}")
    if room == "io":
        # Of this room users need no module but those of the formats.
        path, prefix = [str(ROOT / "jaxekf" / "io" / "importers")], "importers."
    else:
        path, prefix = [str(ROOT / "jaxekf" / room)], ""
    modules = {prefix + m.name for m in pkgutil.iter_modules(path) if not m.name.startswith("_")}
    assert modules - {"importers.formats"} <= set(listed)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_pages(page):
    """A link to a file that is not there, or to a heading that was renamed."""
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.S)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in link or link.startswith("auto_gallery/"):
            continue
        name, _, heading = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), f"{page.name}: {link}"
        if heading:
            heads = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.M)
            slugs = [re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in heads]
            assert heading in slugs, f"{page.name}: {link}"


def test_gallery_pages_that_are_named_exist():
    """A link to an example that was renamed."""
    examples = {file.stem for file in (DOCS / "gallery").glob("plot_*.py")}
    for page in PAGES:
        for name in re.findall(r"auto_gallery/(plot_\w+)", page.read_text("utf-8")):
            assert name in examples, f"{page.name}: {name}"


def test_readme_is_short():
    """A README that grows into a manual again."""
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 200


def test_dead_links_are_found(tmp_path, monkeypatch):
    """A check of the built pages that lets dead links through."""
    monkeypatch.syspath_prepend(str(DOCS))
    check = importlib.import_module("check_links")
    (tmp_path / "b.html").write_text('<p id="here"></p>')
    links = ["b.html", "b.html#here", "b.html#gone", "c.html", "#gone", "https://example.org/x"]
    (tmp_path / "a.html").write_text("".join(f'<a href="{link}"></a>' for link in links))
    dead = check.dead_links(tmp_path)
    sys.modules.pop("check_links")
    assert dead == ["a.html: b.html#gone", "a.html: c.html", "a.html: #gone"]
