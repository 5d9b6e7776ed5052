"""The manual's sources: public names, links, and the length of the README. CI builds it, see `.ci/run`."""

import importlib
import inspect
import re
import sys
from pathlib import Path

import pytest

import jaxekf
import tuning

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("api/*.md"), *ROOT.glob("*.md")])


@pytest.mark.parametrize("package", [jaxekf, tuning])
def test_public_names_are_in_the_reference(package):
    """A public name without a place in the manual, or a place of a name that is no more."""
    page = (DOCS / "api" / f"{package.__name__}.md").read_text("utf-8")
    found = re.findall(rf"^\.\. auto\w+:: {package.__name__}\.(\w+)$", page, re.M)
    assert sorted(found) == sorted(package.__all__)
    assert all(hasattr(package, name) for name in found)


@pytest.mark.parametrize(
    "package", [jaxekf, jaxekf.timeline, tuning], ids=lambda package: package.__name__
)
def test_public_names_have_an_example(package):
    """Would catch a public function or class without an example in its own docstring, a new one too."""
    names = getattr(package, "__all__", None) or [
        name
        for name, value in vars(package).items()
        if not name.startswith("_") and getattr(value, "__module__", "") == package.__name__
    ]
    public = {name: getattr(package, name) for name in names}
    # An inherited docstring is of another class.
    documented = {
        name: vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
        for name, value in public.items()
        if inspect.isclass(value) or inspect.isroutine(value)
    }
    assert documented
    lacking = sorted(name for name, text in documented.items() if ">>>" not in (text or ""))
    assert not lacking, f"no example in {package.__name__}: {', '.join(lacking)}"


def test_public_modules_are_in_the_reference(tmp_path, monkeypatch):
    """A room or a public module without a page."""
    monkeypatch.syspath_prepend(str(DOCS))
    api = importlib.import_module("_api")
    api.write(tmp_path / "modules")
    sys.modules.pop("_api")
    index = (DOCS / "api" / "index.md").read_text("utf-8")
    for room in api.ROOMS:
        assert f"modules/{room}\n" in index
        page = (tmp_path / "modules" / f"{room}.md").read_text("utf-8")
        for name in re.findall(r"^\.\. automodule:: (\S+)$", page, re.M):
            assert importlib.import_module(name).__doc__, name
    assert "jaxekf.models.tight" in (tmp_path / "modules" / "models.md").read_text("utf-8")


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


def test_modules_that_are_named_exist():
    """A page on the design that names a module which has moved."""
    text = (DOCS / "how-it-works.md").read_text("utf-8")
    named = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", text, re.M)
    modules = {file.stem for file in (ROOT / "jaxekf" / "filtering").rglob("*.py")}
    names = {name.strip("` ") for row in named for name in row.split(",")}
    assert len(names) > 10 and names <= modules, names - modules


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
