"""Errors and warnings of the package. Each message has what was got, what was expected and what to do."""

from pathlib import Path
from typing import Any


class JaxekfError(Exception):
    """Base class of all errors of this package.

    Examples
    --------
    A run that cannot be estimated is left out of a batch:

    >>> import jaxekf
    >>> for name in ("free-5", "free-7"):
    ...     try:
    ...         print(jaxekf.load(jaxekf.demo.FOLDER / name).name)
    ...     except jaxekf.JaxekfError as error:
    ...         print(f"{name} is left out: {type(error).__name__}")
    free-5
    free-7 is left out: RecordingError
    """


class ArgumentError(JaxekfError, ValueError):
    """An argument of a function has a type, shape or value that cannot be used; the message names it.

    Examples
    --------
    >>> import jaxekf
    >>> try:
    ...     jaxekf.every("fast")
    ... except jaxekf.ArgumentError as error:
    ...     print(str(error).split("; try")[0])
    seconds: got values of type <U4, expected real numbers
    """


class RecordingError(JaxekfError):
    """A recorded run cannot be read, or its data do not fit its description.

    The error has the place: ``path`` is the file, the folder, or the name of a run in memory; ``line``
    (from 1 on) and ``column`` (or entry of `recording.toml`) are None if it is not about one.

    Examples
    --------
    >>> import jaxekf
    >>> try:
    ...     jaxekf.load("no-such-run")
    ... except jaxekf.RecordingError as error:
    ...     print(error)
    no-such-run: got no such folder, expected a recorded run's folder; try another path
    """

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

    def __reduce__(self) -> tuple[Any, ...]:
        # By the message: a worker process passes its errors on.
        return _restored, (type(self), self.args, vars(self))


def _restored(cls: type[RecordingError], args: tuple[Any, ...], state: dict[str, Any]) -> Any:
    error = cls.__new__(cls, *args)
    vars(error).update(state)
    return error


class ModelError(JaxekfError):
    """A model is unknown, is not valid, or does not fit the recording.

    Examples
    --------
    >>> import jaxekf
    >>> try:
    ...     jaxekf.get_model("loose").sensor("magnetometer")
    ... except jaxekf.ModelError as error:
    ...     print(error)  # doctest: +NORMALIZE_WHITESPACE
    model 'loose' got the sensor name 'magnetometer', expected one of ['optical'];
    check the spelling
    """


class PrecisionError(JaxekfError):
    """JAX is set to float32, which is not accurate enough for the covariance recursion.

    Examples
    --------
    >>> import jax
    >>> import jaxekf
    >>> jax.config.update("jax_enable_x64", False)  # JAX's own default
    >>> try:
    ...     jaxekf.estimate(jaxekf.demo.FOLDER / "free-5")
    ... except jaxekf.PrecisionError as error:
    ...     print(error)  # doctest: +NORMALIZE_WHITESPACE
    got JAX in float32, expected float64; call jaxekf.set_up() before the first array,
    or set JAX_ENABLE_X64=1
    >>> jaxekf.set_up()
    """


class FilterError(JaxekfError):
    """A covariance is no longer finite and positive definite; the message has run, step and sensor.

    Examples
    --------
    The noise of the tracker is far out of range:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> params = jaxekf.get_model("loose").parameters
    >>> params = params._replace(noise=params.noise._replace(optical=1e200))
    >>> try:
    ...     jaxekf.estimate(jaxekf.demo.FOLDER / "free-5", params=params)
    ... except jaxekf.FilterError as error:
    ...     print(str(error).split(", expected")[0])  # doctest: +NORMALIZE_WHITESPACE
    run 'free-5': got a covariance that is not finite and definite at step 1, 0.000000 s,
    in the update by sensor optical of model 'loose'
    """


class TuningError(JaxekfError):
    """A tuning problem is ill-posed or could not be started.

    Examples
    --------
    >>> import jaxekf, tuning
    >>> jaxekf.set_up()
    >>> try:
    ...     tuning.tune(jaxekf.demo.paths(("free-1",)), iterations=0)
    ... except jaxekf.TuningError as error:
    ...     print(error)
    got 0 iterations, expected at least one; ask for more
    """


class ResourceError(JaxekfError):
    """There is too little memory; the message has the name of the run.

    Examples
    --------
    One run at a time needs less memory than all together:

    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> runs = jaxekf.demo.paths(("free-4", "free-5"))
    >>> try:
    ...     estimates = jaxekf.estimate_many(runs)
    ... except jaxekf.ResourceError:
    ...     estimates = [jaxekf.estimate(run) for run in runs]
    >>> len(estimates)
    2
    """


class CacheError(JaxekfError):
    """The folder for compiled programs cannot be written; the message has its path.

    Examples
    --------
    The path is that of a file:

    >>> import tempfile
    >>> import jaxekf
    >>> with tempfile.NamedTemporaryFile() as file:
    ...     try:
    ...         jaxekf.keep_programs(file.name)
    ...     except jaxekf.CacheError as error:
    ...         print(str(error).partition(": got ")[2])  # doctest: +NORMALIZE_WHITESPACE
    'Not a directory', expected a folder that can be written, to keep compiled programs;
    pass another folder
    """


class MissingPackageError(JaxekfError):
    """A required package is not installed; the message has the command that installs it.

    Examples
    --------
    >>> import jaxekf
    >>> from jaxekf._support import optional
    >>> try:
    ...     optional.need("no_such_package", extra="ros")
    ... except jaxekf.MissingPackageError as error:
    ...     print(error)  # doctest: +NORMALIZE_WHITESPACE
    got no package 'no_such_package', expected it to be installed;
    install it: pip install "jaxekf[ros]"
    """


class SlowModelWarning(UserWarning):
    """A model's function cannot be lowered to batched arithmetic and is slow; the message has the
    operation.

    Examples
    --------
    A transition that sorts. Tracing the filter is enough for the warning; nothing is compiled:

    >>> import warnings
    >>> from dataclasses import replace
    >>> import jax
    >>> import jaxekf
    >>> jaxekf.set_up()
    >>> loose = jaxekf.get_model("loose")
    >>> def transition(x, u, dt, w, params):
    ...     after = loose.transition(x, u, dt, w, params)
    ...     return after._replace(bias=jax.numpy.sort(after.bias))
    >>> model = replace(loose, name="sorting", transition=transition)
    >>> line = jaxekf.timeline.build(model, jaxekf.load(jaxekf.demo.FOLDER / "free-5"))
    >>> belief = jaxekf.initial_belief(model, model.parameters, line.first)
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always", jaxekf.SlowModelWarning)
    ...     shapes = jax.eval_shape(
    ...         lambda params: jaxekf.run_filter(model, params, belief, line.steps),
    ...         model.parameters,
    ...     )
    >>> print(str(caught[0].message).partition(", ")[0])
    model 'sorting'
    >>> "got the operations sort" in str(caught[0].message)
    True
    """
