"""The schema of a stream: its arrays, CSV columns, units, frames and entries of `recording.toml`.

A stream is described once, by one `StreamSchema`. Run folders, HDF5 and NPZ files, the checks of what is
read, and the manual's tables are made from it. `jaxekf.io.streams` holds the schemas, one file each.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from jaxekf._support.errors import RecordingError
from jaxekf.io import _section_entries as section_entries
from jaxekf.io.csv_table import (
    QUATERNION,
    Sheet,
    Table,
    flags,
    need_columns,
    numbers,
    reported,
    stamps,
    words,
)
from jaxekf.io.description import Source, latency_entry, latency_ns
from jaxekf.io.units import factors, scaled
from jaxekf.recordings import facts, screening
from jaxekf.recordings.accounts import Intake, Place
from jaxekf.recordings.types import PlainStream

TIME, COUNT, NUMBER, FLAG, TEXT = "time", "count", "number", "flag", "text"


class Field(NamedTuple):
    """One array of a stream."""

    kind: str = NUMBER
    """``time``, ``count``, ``number``, ``flag`` or ``text``."""
    shape: tuple[str | int, ...] = ("N",)
    """N samples, M markers, L landmarks."""
    unit: str = ""
    """SI."""
    frame: str = ""
    needed: bool = False
    columns: tuple[str, ...] = ()
    """CSV columns that hold it, if any."""
    about: str = ""
    """A noun phrase for the manual."""
    least: float | None = None
    """Smallest sensible value of a figure that the sensor reports; NaN means not reported."""
    hideable: bool = False
    """Whether cells of samples that are not valid are written blank."""
    option: str = ""
    """Entry of the stream's section in `recording.toml` that holds it, where it is no column."""
    stored: bool = True
    """Whether HDF5 and NPZ files have it."""

    @property
    def described(self) -> dict[str, str]:
        """Its attributes in HDF5 and NPZ files."""
        about = {"unit": self.unit, "frame": self.frame}
        return {key: text for key, text in about.items() if text}


class Option(NamedTuple):
    """An entry of a stream's section in `recording.toml`, for the check of names and the manual."""

    form: str
    """How it is written, such as ``[x, y, z]``, with its unit."""
    about: str
    """A noun phrase, and the default."""
    held: bool = True
    """Whether the stream itself holds it once it is read."""
    parse: Callable[[Mapping[str, Any], str, Path | str], Any] | None = None
    """Makes of a section, the stream's name and the place of the section what `screen` gets by this
    name."""


def times() -> Field:
    """The time stamps that every stream has."""
    return Field(TIME, ("N",), "ns", needed=True, columns=("time",), about="time stamp")


def latency() -> Field:
    """The latency of a stream whose samples arrive late."""
    about = "delay of the stamps after the measurement (default 0)"
    return Field(COUNT, (), "ns", about=about, option="latency")


def attitude(about: str, *, hideable: bool = False) -> Field:
    """The quaternions of a stream, body to reference."""
    return Field(
        shape=("N", 4),
        unit="1",
        frame=facts.BODY_TO_REFERENCE,
        needed=True,
        columns=QUATERNION,
        about=about,
        hideable=hideable,
    )


def validity() -> Field:
    """Flags of the usable samples of a stream; CSV files have blank cells for the others instead."""
    return Field(FLAG, unit="1", about="whether the sample is usable")


def triple(head: str, unit: str, frame: str, about: str, *, needed: bool = False) -> Field:
    """A vector with the columns `head` and x, y, z.

    Examples
    --------
    >>> from jaxekf.io import schema
    >>> force = schema.triple("f", "N", "sensor", "force")
    >>> force.columns, force.shape, force.unit
    (('fx', 'fy', 'fz'), ('N', 3), 'N')
    """
    columns = tuple(f"{head}{axis}" for axis in "xyz")
    return Field(
        shape=("N", 3), unit=unit, frame=frame, needed=needed, columns=columns, about=about
    )


Screen = Callable[[Place, Mapping[str, Any], bool], tuple[Any, Intake]]


@dataclass(frozen=True)
class StreamSchema:
    """A stream, described once.

    A stream of plain columns of numbers needs no more than `name`, `about` and `fields`; it is read as a
    `PlainStream` into `Recording.others`. The other fields are for streams with a class of their own.

    Examples
    --------
    >>> from jaxekf.io.schema import Field, StreamSchema
    >>> pressure = StreamSchema(
    ...     "pressure",
    ...     "Static pressure.",
    ...     {"pressure": Field(shape=("N", 1), unit="Pa", needed=True, columns=("p",))},
    ... )
    >>> pressure.layouts
    ('time,p',)
    """

    name: str
    """Name of the stream, of its CSV file and of its section in `recording.toml`."""
    about: str
    """One sentence for the manual."""
    fields: Mapping[str, Field]
    """Arrays by name; ``time_ns`` is added where it is not given."""
    options: Mapping[str, Option] = field(default_factory=dict)
    """Entries of the section besides those that every stream may have."""
    described: Mapping[str, str] = field(default_factory=dict)
    """Entries ``kind``, ``frame``, ``unit`` and ``quaternion`` that are written, and checked where
    stated."""
    units: tuple[str, ...] | None = None
    """SI units of the parts of ``unit``; those of the columns in their order unless given."""
    layouts: tuple[str, ...] = ()
    """CSV headers, optional columns in brackets; made from the fields unless given."""
    screen: Screen | None = None
    """Makes the stream and the account of its rows from arrays: a place, arrays by name, whether to
    sort."""
    read: Callable[..., tuple[Any, Intake]] | None = None
    """Reads a table, a `Source` and the tables of the files `beside`; unless given, `screen` gets
    arrays."""
    write: Callable[[Any, dict[str, Any]], tuple[Sheet, dict[str, Any]]] | None = None
    """Makes the sheet and the section that are written from a stream and what its section held."""
    beside: Mapping[str, Callable[[Any, Path], None]] = field(default_factory=dict)
    """Further files of the stream by name, and what writes each."""
    held: frozenset[str] = field(init=False)
    """Entries of the section that are of no more use once the stream is read."""

    def __post_init__(self) -> None:
        whole = {"time_ns": times(), **self.fields}
        object.__setattr__(self, "fields", MappingProxyType(whole))
        if self.units is None:
            found = [f.unit for f in self.fields.values() if f.columns and f.kind == NUMBER]
            object.__setattr__(self, "units", tuple(dict.fromkeys(u for u in found if u)))
        if not self.layouts:
            object.__setattr__(self, "layouts", (_layout(self.fields),))
        held = {key for key, one in self.options.items() if one.held}
        held |= {one.option for one in self.fields.values() if one.option}
        object.__setattr__(self, "held", frozenset({*held, *section_entries.OF_THE_FILE}))

    @property
    def stored(self) -> dict[str, Field]:
        """Fields that HDF5 and NPZ files have."""
        return {name: one for name, one in self.fields.items() if one.stored}

    @property
    def entries(self) -> tuple[str, ...]:
        """Names of all entries of the section besides those that every stream may have."""
        return (*self.options, *(one.option for one in self.fields.values() if one.option))

    def read_table(self, table: Table, source: Source, *beside: Table) -> tuple[Any, Intake]:
        """The stream of a CSV file, and the account of its rows. Raises `RecordingError`."""
        need_columns(table, *self.layouts)
        if self.read is not None:
            return self.read(table, source, *beside)
        return self.make(table.place, self._arrays(table, source), source.sort)

    def make(self, place: Place, arrays: Mapping[str, Any], sort: bool) -> tuple[Any, Intake]:
        """The stream of arrays by field, and the account of its rows. Raises `RecordingError`."""
        return (self.screen or self._plain)(place, arrays, sort)

    def write_table(self, stream: Any, section: dict[str, Any]) -> tuple[Sheet, dict[str, Any]]:
        """Sheet and section of `recording.toml` to write for a stream."""
        if self.write is not None:
            return self.write(stream, section)
        columns: list[str] = []
        values = []
        for name, one in self.fields.items():
            value = self.value(stream, name)
            if one.option and value is not None:
                section |= _option_entry(one, value, f"{self.name}.{one.option}")
            elif one.columns and one.kind == NUMBER and value is not None:
                if one.hideable:
                    value = np.where(stream.seen[:, None], value, np.nan)
                columns += one.columns
                values.append(value.reshape(len(stream.time_ns), -1))
        section |= self.described
        return Sheet(columns, stream.time_ns, np.concatenate(values, axis=1)), section

    def value(self, stream: Any, name: str) -> Any:
        """A field of a stream; None where it has none."""
        if isinstance(stream, PlainStream) and name not in ("time_ns", "latency_ns"):
            return stream.values.get(name)
        return getattr(stream, name, None)

    def _arrays(self, table: Table, source: Source) -> dict[str, Any]:
        """Arrays by field, SI units, of a table that has a column for each number."""
        section, place = source.about, source.place
        assert self.units is not None
        scale = dict(zip(self.units, factors(self.name, self.units, section, place), strict=True))
        turning = section_entries.turning(self.name, section, place)
        found: dict[str, Any] = {"time_ns": stamps(table)}
        for name, option in self.options.items():
            if option.parse is not None:
                found[name] = option.parse(section, self.name, place)
        plain: dict[str, tuple[str, ...]] = {}
        for name, one in self.fields.items():
            if one.option:
                if one.option in section:
                    found[name] = _option_value(one, section, place, self.name)
            elif not one.columns or one.kind == TIME or not set(one.columns) <= set(table.columns):
                continue
            elif one.kind == TEXT:
                found[name] = words(table, one.columns[0])
            elif one.kind == FLAG:
                found[name] = flags(table, one.columns[0])
            elif one.least is not None:
                value = reported(table, one.columns[0], least=one.least)
                found[name] = value if value is None else scale.get(one.unit, 1.0) * value
            elif one.frame == facts.BODY_TO_REFERENCE:
                plain[name] = turning.columns(table.columns)
            else:
                plain[name] = one.columns
        # All at once: a file is taken apart only once for them.
        every = numbers(table, [column for names in plain.values() for column in names], blank=True)
        at = 0
        for name, names in plain.items():
            value, at = np.ascontiguousarray(every[:, at : at + len(names)]), at + len(names)
            one = self.fields[name]
            value = turning.standard(value) if one.frame == facts.BODY_TO_REFERENCE else value
            found[name] = scaled(value, scale.get(one.unit, 1.0))
        return found

    def _plain(
        self, place: Place, arrays: Mapping[str, Any], sort: bool
    ) -> tuple[PlainStream, Intake]:
        """A stream of plain columns; rows without any finite field are masked."""
        values = {name: arrays[name] for name in self.fields if arrays.get(name) is not None}
        time_ns, late = values.pop("time_ns"), int(values.pop("latency_ns", 0))
        order, account = screening.in_order(place, time_ns, list(values.values()), sort=sort)
        kept = PlainStream(time_ns[order], {k: v[order] for k, v in values.items()}, late)
        screening.check_rate(place.take(order), kept.time_ns)
        reasons = {"not finite": ~kept.seen}
        seen, account = screening.mask_first(place.take(order), kept.time_ns, account, reasons)
        screening.need_usable(place, seen, account, "row", "recording again")
        return kept, account


def _layout(fields: Mapping[str, Field]) -> str:
    """The header of a CSV file, optional columns in brackets."""
    with_columns = [one for one in fields.values() if one.columns]
    needed = [",".join(one.columns) for one in with_columns if one.needed]
    optional = [f"[,{','.join(one.columns)}]" for one in with_columns if not one.needed]
    return ",".join(needed) + "".join(optional)


def _option_value(one: Field, section: Mapping[str, Any], place: Path | str, label: str) -> Any:
    """A field that an entry of the section holds."""
    key = f"{label}.{one.option}"
    if one.option == "latency":
        return latency_ns(section, label, place)
    value = section[one.option]
    if one.shape:
        return facts.finite_vector(value, int(one.shape[0]), place, key)
    return facts.finite_number(value, place, key)


def _option_entry(one: Field, value: Any, key: str) -> dict[str, Any]:
    """The entry that holds a field."""
    if one.option == "latency":
        return latency_entry(value)
    if one.shape:
        vector = facts.finite_vector(value, int(one.shape[0]), facts.FILE, key)
        return {one.option: vector.tolist()}
    return {one.option: float(value)} if value else {}


def check_complete(schema: StreamSchema) -> None:
    """Raise `RecordingError` for a schema that cannot describe a stream."""
    wrong = ""
    if not schema.name.isidentifier():
        wrong = f"the name {schema.name!r}"
    elif not any(one.columns and one.kind == NUMBER for one in schema.fields.values()):
        wrong = "no field with columns"
    if wrong:
        raise RecordingError(
            schema.name, wrong, "a name that Python allows, and columns of numbers", "giving them"
        )
