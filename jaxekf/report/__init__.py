"""A page that shows results beside what was measured and what is true: one HTML file, no network.

It is made of result folders alone, and of their recordings where those still are where they were: no model
and no filter is run.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxekf.files import check_file, write_whole
from jaxekf.report import consistency, figures
from jaxekf.report.evidence import gather
from jaxekf.report.page import MARKER, Section, compose
from jaxekf.report.saved import SavedResult, read_result
from jaxekf.report.summary import Summary, summarise

__all__ = ["Written", "write_report"]

_BINS_IN_ALL, _MOST_BINS, _FEWEST_BINS = 1500, 500, 120


class Written(NamedTuple):
    """What a report was made of, run by run, and how large it is."""

    path: Path
    size: int
    """Bytes."""
    runs: tuple[str, ...]
    """Headings, in order."""
    summaries: tuple[Summary, ...]
    missing: tuple[str, ...]
    """Why a run's recording could not be read; empty where it was."""


def write_report(
    folders: Sequence[Path | str], output: Path | str, *, overwrite: bool = False
) -> Written:
    """Write one report of several result folders, whole or not at all.

    Raises `RecordingError` for a folder that holds no readable result of this version, and where `output`
    may not be written. The more runs, the more coarsely long series are drawn, to keep the file small.
    """
    check_file(output, MARKER, overwrite=overwrite)
    results = [read_result(folder) for folder in folders]
    bins = max(_FEWEST_BINS, min(_MOST_BINS, _BINS_IN_ALL // max(1, len(results))))
    sections = []
    for name, result in zip(_names(results), results, strict=True):
        seen = gather(result)
        drawn = figures.draw(seen, bins)
        drawn += [
            f for f in (consistency.innovations(seen, bins), consistency.errors(seen, bins)) if f
        ]
        sections.append(Section(name, seen, summarise(seen), drawn))
    text = compose(sections, bins)
    write_whole(output, text)
    return Written(
        Path(output),
        len(text.encode("utf-8")),
        tuple(section.name for section in sections),
        tuple(section.summary for section in sections),
        tuple(section.seen.missing for section in sections),
    )


def _names(results: Sequence[SavedResult]) -> list[str]:
    """Headings: the runs' names, with their folders where several results are of one run."""
    names = [result.run for result in results]
    return [
        f"{name} ({result.folder})" if names.count(name) > 1 else name
        for name, result in zip(names, results, strict=True)
    ]
