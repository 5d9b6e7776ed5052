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
        told = f"{place}: got {got}, expected {expected}; try {hint}"
        # Names and texts of a damaged file may hold anything: the message is one line that can be printed.
        super().__init__("".join(c if c.isprintable() else ascii(c)[1:-1] for c in told))


class ModelError(JaxekfError):
    """A model is unknown, malformed, or does not fit the recording."""


class PrecisionError(JaxekfError):
    """JAX is running in float32, in which the covariance recursion is not trustworthy."""


class FilterError(JaxekfError):
    """The recursion lost finiteness or definiteness; the message names run, step, time and sensor."""


class TuningError(JaxekfError):
    """A tuning problem is ill-posed or could not be started."""


class ResourceError(JaxekfError):
    """There is too little memory for what was asked; the message names the run."""


class CacheError(JaxekfError):
    """Compiled programs cannot be kept in the folder that the message names."""


class MissingPackageError(JaxekfError):
    """What was asked needs a package that is not installed; the message says how to install it."""


class SlowModelWarning(UserWarning):
    """A model's function is right but does not become plain arithmetic for many runs at once; the message
    names the operation."""
