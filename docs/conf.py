"""How the manual is built: python -m sphinx -W --keep-going -b html docs docs/_build"""

import os
import re
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent / "examples")]

# Examples wait for the compiler, not for what it makes.
os.environ.setdefault("JAXEKF_COMPILE", "quick")
# XLA logs lines of three kilobytes for programs read from a cache.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import _api  # noqa: E402
import _streams  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402
from sphinx.ext.napoleon.docstring import NumpyDocstring  # noqa: E402

import jaxekf  # noqa: E402

jaxekf.set_up()
_streams.write(HERE / "_generated" / "streams.md")
_api.write(HERE / "api" / "modules")

project = "jaxekf"
author = "The jaxekf authors"
copyright = "The jaxekf authors, MIT licence"
release = version = jaxekf.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx_click",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build", "_generated", "gallery", "auto_gallery/*.ipynb", "auto_gallery/*.py"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "attrs_inline"]
myst_heading_anchors = 3
# Docstrings write code in single backquotes.
default_role = "code"

html_theme = "furo"
html_title = f"jaxekf {release}"
html_static_path: list[str] = []
html_show_sphinx = False

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
python_maximum_signature_line_length = 80
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_gallery",
    "filename_pattern": r"/plot_",
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": ("_figures",),
    "reset_modules": (),
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "remove_config_comments": True,
    "capture_repr": (),
    "abort_on_example_error": True,
    "min_reported_time": 0,
    "parallel": False,
}
suppress_warnings = ["config.cache"]


# Napoleon takes what goes before a colon in the description of an attribute for its type; here it is text.
def _as_written(docstring: NumpyDocstring) -> list[str]:
    return docstring._consume_to_end()


NumpyDocstring._parse_attribute_docstring = _as_written  # type: ignore[method-assign]


def _plain_paths(app: Sphinx, context: object, lines: list[str]) -> None:
    """Defaults that are paths as a user writes them."""
    lines[:] = [re.sub(r"PosixPath\('(.*?)'\)", r"\1", line) for line in lines]


def setup(app: Sphinx) -> None:
    app.connect("sphinx-click-process-options", _plain_paths)
