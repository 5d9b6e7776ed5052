"""The report: results with measurements and truth in one HTML file, which needs no network.

Its input are result folders, tuned folders and the recordings that the results name: no model or filter is
run. `write_report` is public. Text and HTML are in `templates`; a new figure goes into `_figures`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxekf.io.atomic import check_file, write_whole
from jaxekf.reporting.report import _consistency as consistency
from jaxekf.reporting.report import _figures as figures
from jaxekf.reporting.report._comparison import compare
from jaxekf.reporting.report._page import MARKER, Section, compose
from jaxekf.reporting.report._saved import SavedResult, read_result
from jaxekf.reporting.report._summary import Summary, summarise
from jaxekf.reporting.report._tuned import FILE, SavedTuning, read_tuning
from jaxekf.reporting.report._tuning_figures import draw_tuning
from jaxekf.reporting.report._tunings import TuningSection

__all__ = ["Written", "write_report"]

_BINS_IN_ALL, _MOST_BINS, _FEWEST_BINS = 1500, 500, 120


class Written(NamedTuple):
    """Content and size of a report that was written."""

    path: Path
    size: int
    """Bytes."""
    runs: tuple[str, ...]
    """Headings, in order."""
    folders: tuple[Path, ...]
    """Result folders in the same order."""
    summaries: tuple[Summary, ...]
    missing: tuple[str, ...]
    """For each run the reason why its recording could not be read; empty if it was."""
    tunings: tuple[TuningSection, ...]


def write_report(
    folders: Sequence[Path | str], output: Path | str, *, overwrite: bool = False
) -> Written:
    """Write one report of several result folders and tuned folders, atomically.

    They may come in any order; one that is named twice is shown once. Long series are drawn more coarsely
    for many runs, to keep the file small. Raises `RecordingError` for a folder without a readable result or
    tuning of this version, and for an `output` that may not be written.
    """
    check_file(output, MARKER, overwrite=overwrite)
    read = [_read(folder) for folder in _without_repeats(folders)]
    results = [found for found in read if isinstance(found, SavedResult)]
    tunings = [found for found in read if isinstance(found, SavedTuning)]
    bins = max(_FEWEST_BINS, min(_MOST_BINS, _BINS_IN_ALL // max(1, len(results))))
    sections = []
    names = _unique_names([(result.run, result.folder) for result in results])
    for name, result in zip(names, results, strict=True):
        compared = compare(result)
        drawn = figures.draw(compared, bins)
        drawn += [
            f
            for f in (consistency.innovations(compared, bins), consistency.errors(compared, bins))
            if f
        ]
        sections.append(Section(name, compared, summarise(compared), drawn))
    names = _unique_names([(tuning.folder.resolve().name, tuning.folder) for tuning in tunings])
    tuned = [
        TuningSection(name, tuning, draw_tuning(tuning.document))
        for name, tuning in zip(names, tunings, strict=True)
    ]
    text = compose(sections, tuned, bins)
    write_whole(output, text)
    return Written(
        Path(output),
        len(text.encode("utf-8")),
        tuple(section.name for section in sections),
        tuple(result.folder for result in results),
        tuple(section.summary for section in sections),
        tuple(section.compared.missing for section in sections),
        tuple(tuned),
    )


def _without_repeats(folders: Sequence[Path | str]) -> list[Path]:
    """The folders, each once, whatever path names it."""
    found: dict[Path, Path] = {}
    for folder in map(Path, folders):
        found.setdefault(folder.resolve(), folder)
    return list(found.values())


def _read(folder: Path) -> SavedResult | SavedTuning:
    if (folder / FILE).exists():
        return read_tuning(folder)
    return read_result(folder)


def _unique_names(named: Sequence[tuple[str, Path]]) -> list[str]:
    """Headings: the names, with their folders if several are equal."""
    names = [name for name, _ in named]
    return [f"{name} ({folder})" if names.count(name) > 1 else name for name, folder in named]
