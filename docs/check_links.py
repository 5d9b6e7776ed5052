"""Look for dead links within a built manual: python docs/check_links.py docs/_build

Every local `href` and `src` must name a file that is there and, after `#`, an element of it. Prints the
dead ones; the exit status is 1 where there are any.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class _Page(HTMLParser):
    """The links of a page, and the names that a link can point to."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.names: set[str] = set()
        self.feed(file.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for key, value in attrs:
            if value is None:
                continue
            if key in ("href", "src"):
                self.links.append(value)
            elif key == "id" or (key == "name" and tag == "a"):
                self.names.add(value)


def dead_links(folder: Path) -> list[str]:
    """The dead links below a folder, a line each."""
    pages = {file.resolve(): _Page(file) for file in sorted(folder.rglob("*.html"))}
    dead = []
    for file, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or link in ("", "#"):
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            there = target.is_file() or (target / "index.html").is_file()
            name = unquote(parts.fragment)
            known = not name or target not in pages or name in pages[target].names
            if not (there and known):
                dead.append(f"{file.relative_to(folder.resolve())}: {link}")
    return dead


def main() -> None:
    folder = Path(sys.argv[1])
    if not any(folder.rglob("*.html")):
        sys.exit(f"{folder} has no pages: build the manual first")
    dead = dead_links(folder)
    print("\n".join(dead) or f"{folder}: no dead links")
    sys.exit(1 if dead else 0)


if __name__ == "__main__":
    main()
