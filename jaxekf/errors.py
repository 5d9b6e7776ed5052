"""Errors a caller can meet. Each message says what was got, what was expected and what to do."""

from pathlib import Path


class JaxekfError(Exception):
    """Base of every error this package raises on purpose."""


class RecordingError(JaxekfError):
    """A recorded run cannot be read, or does not hold what its description says."""

    def __init__(
        self,
        path: Path | str,
        got: str,
        expected: str,
        hint: str,
        *,
        line: int | None = None,
        column: str | None = None,
    ) -> None:
        self.path, self.line, self.column = Path(path), line, column
        place = ":".join(str(part) for part in (path, line, column) if part is not None)
        message = f"{place}: got {got}, expected {expected}; try {hint}"
        # A cell that is quoted in it may hold the end of a line.
        super().__init__(message.replace("\r", "\\r").replace("\n", "\\n"))


class ModelError(JaxekfError):
    """A model is unknown, malformed, or does not fit the recording."""


class PrecisionError(JaxekfError):
    """JAX is running in float32, in which the covariance recursion is not trustworthy."""


class FilterError(JaxekfError):
    """The recursion lost finiteness or definiteness; the message names run, step, time and sensor."""


class TuningError(JaxekfError):
    """A tuning problem is ill-posed or could not be started."""
