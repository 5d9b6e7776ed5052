"""The schemas of all streams: one file each, with a `SCHEMA`. A file that is added here is found by itself.

A stream of plain columns of numbers needs its fields only (see `force_torque`). Streams of a program of
one's own are added with `register`, without a file here.
"""

from importlib import import_module
from pkgutil import iter_modules

from jaxekf._support.errors import RecordingError
from jaxekf.io._section_entries import COMMON
from jaxekf.io.schema import StreamSchema, check_complete
from jaxekf.recordings.types import STREAMS

_RUN = ("schema_version", "name", "sha256", "trust_units")
_FACTS = ("gravity_ref", "field_ref", "p_body_object", "q_body_object")


def _all() -> dict[str, StreamSchema]:
    names = sorted(module.name for module in iter_modules(__path__))
    found = [import_module(f"{__name__}.{name}").SCHEMA for name in names]
    own = {schema.name: schema for schema in found}
    return {label: own[label] for label in (*STREAMS, *(n for n in own if n not in STREAMS))}


SCHEMAS = _all()
"""Schemas by the names of their streams."""


def register(schema: StreamSchema) -> None:
    """Let runs have a further stream of plain columns, from now on in this process.

    It is read from ``NAME.csv`` and the group ``NAME`` of HDF5 and NPZ files, and is `Recording.others`.
    A model reads it with `Recording.samples`.

    Parameters
    ----------
    schema
        The stream; one of the same name that was registered before is replaced.

    Raises
    ------
    RecordingError
        For the name of a stream that comes with the package, and a schema without columns.

    Examples
    --------
    >>> import jaxekf.io
    >>> from jaxekf.io.schema import Field, StreamSchema
    >>> columns = {"level": Field(shape=("N", 1), unit="m", needed=True, columns=("level",))}
    >>> jaxekf.io.register(StreamSchema("water", "Water level.", columns))
    """
    check_complete(schema)
    if schema.name in (*_PACKAGED, *_RUN, *_FACTS):
        raise RecordingError(
            schema.name, "a name that is taken", "a name of its own", "choosing another name"
        )
    SCHEMAS[schema.name] = schema


def run_keys() -> tuple[str, ...]:
    """Entries of `recording.toml` outside of sections, and the names of its sections."""
    return (*SCHEMAS, *_RUN, *_FACTS)


def section_keys() -> tuple[str, ...]:
    """Entries that some stream's section may have."""
    return (*COMMON, *(key for schema in SCHEMAS.values() for key in schema.entries))


_PACKAGED = frozenset(SCHEMAS)
