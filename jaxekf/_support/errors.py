"""Errors and warnings of the package. Each message has what was got, what was expected and what to do."""

from pathlib import Path


class JaxekfError(Exception):
    """Base class of all errors of this package."""


class RecordingError(JaxekfError):
    """A recorded run cannot be read, or its data do not fit its description."""

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
        # The text of a damaged file may hold any characters; the message is one printable line.
        super().__init__("".join(c if c.isprintable() else ascii(c)[1:-1] for c in message))


class ModelError(JaxekfError):
    """A model is unknown, is not valid, or does not fit the recording."""


class PrecisionError(JaxekfError):
    """JAX is set to float32, which is not accurate enough for the covariance recursion."""


class FilterError(JaxekfError):
    """A covariance is no longer finite and positive definite; the message has run, step and sensor."""


class TuningError(JaxekfError):
    """A tuning problem is ill-posed or could not be started."""


class ResourceError(JaxekfError):
    """There is too little memory; the message has the name of the run."""


class CacheError(JaxekfError):
    """The folder for compiled programs cannot be written; the message has its path."""


class MissingPackageError(JaxekfError):
    """A required package is not installed; the message has the command that installs it."""


class SlowModelWarning(UserWarning):
    """A model's function cannot be lowered to batched arithmetic and is slow; the message has the
    operation."""
