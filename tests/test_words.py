"""The words of docstrings, help texts and messages: plain sentences with the terms of the field."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [file for top in ("jaxekf", "tuning") for file in sorted((ROOT / top).rglob("*.py"))]
UNCLEAR = re.compile(
    r"\b(lies?|told|tells?|said|says?|so many|stands|speaks? against|honest\w*|made up|patience_s)\b"
)
"""Words for which the field has a term: reported, estimated, stated, consistent, is in."""
VAGUE_START = re.compile(r"(Of|What|Where)\b")
RIGHT = {"_recursion.py": "say"}
"""``say`` for ``for example``."""


def texts(file):
    """Every text of a file with its line: docstrings, help texts, and parts of messages."""
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_words(file):
    """Would catch words that a reader of the field has to translate, and docstrings without a subject."""
    for line, text in texts(file):
        found = set(UNCLEAR.findall(text)) - {RIGHT.get(file.name)}
        assert not found, f"{file.name}:{line}: {found} in {text[:200]!r}"
        assert not VAGUE_START.match(text), f"{file.name}:{line}: {text[:80]!r}"
