"""The figures of a gallery example, for sphinx-gallery, which only knows those of pyplot.

Those of `jaxekf.reporting.plots` do not belong to pyplot. A figure is shown after the block of the
example that made it.
"""

from typing import Any

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst


class FigureScraper:
    """Saves every figure that a block left in a variable, once."""

    def __init__(self) -> None:
        self.seen: list[Figure] = []

    def __repr__(self) -> str:
        return "FigureScraper"

    def __call__(self, block: Any, block_vars: dict[str, Any], conf: dict[str, Any]) -> str:
        files = []
        for name, figure in block_vars["example_globals"].items():
            known = any(figure is earlier for earlier in self.seen)
            if name.startswith("_") or not isinstance(figure, Figure) or known:
                continue
            self.seen.append(figure)
            files.append(str(next(block_vars["image_path_iterator"])))
            figure.savefig(files[-1], dpi=130)
        return figure_rst(files, conf["src_dir"])


_SCRAPER = FigureScraper()


def _get_sg_image_scraper() -> FigureScraper:
    return _SCRAPER
