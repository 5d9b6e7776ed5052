"""A page that shows results beside what was measured and what is true: one HTML file, no network.

It is made of result folders and tuned folders alone, and of the results' recordings where those still are
where they were: no model and no filter is run.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxekf.io.atomic import check_file, write_whole
from jaxekf.reporting.report import _consistency as consistency
from jaxekf.reporting.report import _figures as figures
from jaxekf.reporting.report._evidence import gather
from jaxekf.reporting.report._page import MARKER, Section, compose
from jaxekf.reporting.report._saved import SavedResult, read_result
from jaxekf.reporting.report._summary import Summary, summarise
from jaxekf.reporting.report._tuned import FILE, SavedTuning, read_tuning
from jaxekf.reporting.report._tuning_figures import draw_tuning
from jaxekf.reporting.report._tunings import TuningSection

__all__ = ["Written", "write_report"]

_BINS_IN_ALL, _MOST_BINS, _FEWEST_BINS = 1500, 500, 120


class Written(NamedTuple):
    """What a report was made of, run by run, and how large it is."""

    path: Path
    size: int
    """Bytes."""
    runs: tuple[str, ...]
    """Headings, in order."""
    folders: tuple[Path, ...]
    """Of the runs, in the same order."""
    summaries: tuple[Summary, ...]
    missing: tuple[str, ...]
    """Why a run's recording could not be read; empty where it was."""
    tunings: tuple[TuningSection, ...]


def write_report(
    folders: Sequence[Path | str], output: Path | str, *, overwrite: bool = False
) -> Written:
    """Write one report of several result folders and tuned folders, whole or not at all.

    They may come in any order; one that is named twice is shown once. Raises `RecordingError` for a folder
    that holds no readable result or tuning of this version, and where `output` may not be written. The more
    runs, the more coarsely long series are drawn, to keep the file small.
    """
    check_file(output, MARKER, overwrite=overwrite)
    read = [_read(folder) for folder in _once(folders)]
    results = [found for found in read if isinstance(found, SavedResult)]
    tunings = [found for found in read if isinstance(found, SavedTuning)]
    bins = max(_FEWEST_BINS, min(_MOST_BINS, _BINS_IN_ALL // max(1, len(results))))
    sections = []
    names = _unlike([(result.run, result.folder) for result in results])
    for name, result in zip(names, results, strict=True):
        seen = gather(result)
        drawn = figures.draw(seen, bins)
        drawn += [
            f for f in (consistency.innovations(seen, bins), consistency.errors(seen, bins)) if f
        ]
        sections.append(Section(name, seen, summarise(seen), drawn))
    names = _unlike([(tuning.folder.resolve().name, tuning.folder) for tuning in tunings])
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
        tuple(section.seen.missing for section in sections),
        tuple(tuned),
    )


def _once(folders: Sequence[Path | str]) -> list[Path]:
    """The folders without those that were named before, under whatever name."""
    found: dict[Path, Path] = {}
    for folder in map(Path, folders):
        found.setdefault(folder.resolve(), folder)
    return list(found.values())


def _read(folder: Path) -> SavedResult | SavedTuning:
    if (folder / FILE).exists():
        return read_tuning(folder)
    return read_result(folder)


def _unlike(named: Sequence[tuple[str, Path]]) -> list[str]:
    """Headings: the names, with their folders where several are alike."""
    names = [name for name, _ in named]
    return [f"{name} ({folder})" if names.count(name) > 1 else name for name, folder in named]
