"""A tuned folder of `jaxekf tune` read into memory: the record of the tuning, and comparisons in it."""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxekf._support.errors import RecordingError
from jaxekf.evaluation.spread import Spread, spread_of
from jaxekf.io.documents import codec
from jaxekf.io.documents.tuning import RunScore, TuningDocument

FILE = "tuning.json"
HELD = "hold last"
_AGAIN = "tuning again with this version of jaxekf"


@dataclass(frozen=True)
class SavedTuning:
    """A tuned folder in memory."""

    folder: Path
    document: TuningDocument

    @property
    def judged(self) -> tuple[Sequence[RunScore], str]:
        """The rows that judge the tuning, and the kind of their runs: held-out runs if there are any."""
        rows, folds = self.document.rows, self.document.folds
        if folds is not None and (not rows or self.document.judged_on == "training runs"):
            return folds.rows, "runs held out by folds"
        return rows, self.document.judged_on or ""


def variants(rows: Sequence[RunScore]) -> list[str]:
    """Variants in the order of the rows."""
    return list(dict.fromkeys(row.variant for row in rows))


def before_and_after(rows: Sequence[RunScore]) -> tuple[str, str]:
    """The variants to compare: start and tuned, or the first and the last there are."""
    known = [name for name in variants(rows) if name != HELD]
    if not known:
        return "", ""
    first = "start" if "start" in known else known[0]
    return first, "tuned" if "tuned" in known else known[-1]


def spread(rows: Sequence[RunScore], variant: str, column: str) -> Spread:
    """One column over the runs that have a number there."""
    each = [getattr(row, column) for row in rows if row.variant == variant]
    return spread_of([value for value in each if value is not None], column)


def read_tuning(folder: Path | str) -> SavedTuning:
    """Read `tuning.json` of a tuned folder.

    Raises `RecordingError` for a file that is missing, broken, of another version, or of another tuning
    than `noise.toml`.
    """
    document = codec.read(Path(folder) / FILE, TuningDocument, _AGAIN)
    _check_noise(Path(folder), document.tuning)
    return SavedTuning(Path(folder), document)


def _check_noise(folder: Path, tuning: str | None) -> None:
    """Refuse files of two tunings, which a kill can leave."""
    file = folder / "noise.toml"
    try:
        origin = tomllib.loads(file.read_text("utf-8-sig")).get("origin")
    except (OSError, ValueError):
        return
    beside = origin.get("tuning") if isinstance(origin, dict) else None
    if None not in (beside, tuning) and beside != tuning:
        raise RecordingError(
            folder / FILE,
            f"the record of the tuning {tuning} beside {file.name} of {beside}",
            "both of one, which a kill while they were written may have prevented",
            "tuning again",
        )
