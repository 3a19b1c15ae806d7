"""The layout file: which files make a recording, what their columns hold, where time and labels come from.

``docs/tutorials/own-data.md`` describes each entry. A layout is checked as a whole when it is read, before any data file
is opened.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tacpipe.errors import UsageError
from tacpipe.formats.table import pattern
from tacpipe.io import regular
from tacpipe.plugins import fields
from tacpipe.plugins.constraints import NonNegativeInt, Rate
from tacpipe.printable import excerpt, plain

MOST_BYTES = 1 << 20  # of a layout file
Format = Literal["csv", "parquet", "npz", "jsonl"]
Kind = Literal["int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "float32", "float64", "bool", "text"]
TimeUnit = Literal["s", "ms", "us", "ns", "iso8601"]
EXTENSIONS: Mapping[str, Format] = {
    ".csv": "csv",
    ".tsv": "csv",
    ".txt": "csv",
    ".parquet": "parquet",
    ".npz": "npz",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
}
GZIP = ".gz"
UNKNOWN = "?"  # what a guessed layout could not know
OPEN = 4  # of such entries that are named at once


@dataclass(frozen=True)
class Time:
    """Where the stamps of a stream come from: a column, or a rate."""

    column: str = ""
    unit: TimeUnit = "s"
    rate_hz: Rate | None = None
    origin: Literal["unix", "start"] = "unix"  # what a number counts from: 1970, or the start of the recording
    zone: str = "UTC"  # of ISO 8601 stamps that name none, as Europe/Berlin
    start: str = ""  # UTC, ISO 8601: the first stamp of recordings that count from their start


@dataclass(frozen=True)
class Column:
    """What the columns are whose names match a pattern; placeholders become field metadata, as taxel and axis."""

    match: str
    name: str = ""  # pattern; empty: as in the file
    quantity: str = ""
    unit: str = ""
    type: Kind = "float64"
    scale: float = 1.0  # a value is what the file holds times this
    component: str = ""
    skip: bool = False


@dataclass(frozen=True)
class Long:
    """Columns of a table in long form: one row a channel and moment."""

    channel: str
    value: str


@dataclass(frozen=True)
class Stream:
    """One stream of each recording."""

    name: str
    files: str
    time: Time
    columns: tuple[Column, ...]
    format: Format | None = None  # None: by the extension
    separator: str = ""  # empty: a comma, or a tab in a .tsv
    decimal: Literal[".", ","] = "."
    comment: str = ""  # what lines begin with that hold no row
    header: bool = True  # without one, columns are named column1, column2, …
    skip_lines: NonNegativeInt = 0  # before the header
    missing: tuple[str, ...] = ()  # cells that hold no value: NaN
    recording: str = ""  # the column that names the recording, where a file holds many
    long: Long | None = None
    optional: bool = False  # whether recordings without this stream are read

    def format_of(self, path: Path) -> Format:
        """Return the format of a file: the layout's, or that of its extension. Raises `UsageError` where neither says."""
        if self.format is not None:
            return self.format
        last = extension(path)
        if last not in EXTENSIONS:
            raise UsageError(
                f"{path} has none of the extensions {', '.join(EXTENSIONS)}. Set format in [streams.{self.name}]."
            )
        return EXTENSIONS[last]

    def separator_of(self, path: Path) -> str:
        """Return what stands between the cells of a text file."""
        return self.separator or ("\t" if ".tsv" in [suffix.lower() for suffix in path.suffixes] else ",")


def extension(path: Path) -> str:
    """Return the extension of a file, that below .gz where it is compressed.

    >>> extension(Path("a.CSV")), extension(Path("a.csv.gz")), extension(Path("a"))
    ('.csv', '.csv', '')
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    return suffixes[-2] if suffixes[-1:] == [GZIP] and len(suffixes) > 1 else "".join(suffixes[-1:])


@dataclass(frozen=True)
class Labels:
    """A source of labels: a table with a row a recording, or a YAML or JSON file a recording."""

    file: str
    key: str = ""  # the table's column that names the recording
    columns: tuple[str, ...] = ()  # empty: all


@dataclass(frozen=True)
class Layout:
    """Everything that a layout file says."""

    streams: tuple[Stream, ...]
    name: str = ""  # pattern of a recording's name; empty: all placeholders with dashes between
    labels: tuple[Labels, ...] = ()
    attributes: Mapping[str, str | int | float | bool] = field(default_factory=dict)

    @property
    def placeholders(self) -> tuple[str, ...]:
        """The placeholders that every stream which must be there has, in the order of the first."""
        required = [one for one in self.streams if not one.optional] or list(self.streams)
        shared = set.intersection(*(set(pattern.placeholders(one.files)) for one in required))
        return tuple(name for name in pattern.placeholders(required[0].files) if name in shared)


def read(path: Path) -> Layout:
    """Return the layout in a file. Raises `UsageError`, naming file and entry, for what is not one."""
    content = regular.content(path, MOST_BYTES)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UsageError(
            f"{path} is not UTF-8: byte {error.start} is {excerpt(content[error.start : error.end])}."
        ) from error
    return parse(text, str(path))


def parse(text: str, where: str = "The layout") -> Layout:
    """Return the layout in a TOML text; ``where`` names it in errors."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{where} is not TOML: {plain(str(error), 200)}.") from error
    return of(tables, where)


def of(tables: Mapping[str, Any], where: str = "The layout") -> Layout:
    """Return the layout that these tables of TOML are."""
    _refuse_unknown(tables, where)
    for key in tables:
        if key not in ("recordings", "streams", "labels", "attributes"):
            raise UsageError(
                f"{where}: there is no table [{plain(key)}]; there are recordings, streams, labels, attributes."
            )
    streams = _table(tables.get("streams", {}), where, "streams")
    if not streams:
        raise UsageError(f"{where} has no stream. Add a table such as [streams.skin] with files, time and columns.")
    recordings = _table(tables.get("recordings", {}), where, "recordings")
    for key in recordings:
        if key != "name":
            raise fields.unknown(key, {"name": str}, f"{where}, [recordings]", "entry")
    name = fields.check(recordings.get("name", ""), str, "name", f"{where}, [recordings]")
    labels = tables.get("labels", [])
    if not isinstance(labels, list):
        raise UsageError(f"{where}: labels is a list of tables. Write [[labels]].")
    made = Layout(
        tuple(_stream(stream, value, where) for stream, value in streams.items()),
        name,
        tuple(_labels(one, f"{where}, [[labels]] {number}") for number, one in enumerate(labels, 1)),
        _attributes(_table(tables.get("attributes", {}), where, "attributes"), where),
    )
    pattern.filled(name, dict.fromkeys([*made.placeholders, "recording"], "x"))
    return made


def _refuse_unknown(value: Any, where: str) -> None:
    """Raise `UsageError` where entries still hold what a guess could not know, naming the first few."""
    found = list(_unknown(value, where))
    if found:
        more = f"; and {len(found) - OPEN} more" if len(found) > OPEN else ""
        raise UsageError(f"{'; '.join(found[:OPEN])}{more}. Write what it is, or skip = true for a column.")


def _unknown(value: Any, where: str) -> Iterator[str]:
    """Yield each entry that still holds what a guess could not know, with what stands beside it."""
    for key, inner in value.items() if isinstance(value, dict) else ():
        for one in inner if isinstance(inner, list) else [inner]:
            if one == UNKNOWN:
                known = ", ".join(f"{name} = {excerpt(found)}" for name, found in value.items() if found != UNKNOWN)
                yield f'{where}: {plain(key)} is "?"' + (f" ({known})" if known else "")
            else:
                yield from _unknown(one, f"{where}, {plain(key)}")


def _stream(name: str, value: Any, where: str) -> Stream:
    where = f"{where}, [streams.{plain(name)}]"
    values = dict(_table(value, where, ""))
    if not name.isidentifier():
        raise UsageError(f"{where}: a stream's name is letters, digits and underscores, as it becomes a file's name.")
    if "time" not in values:
        raise UsageError(
            f'{where}: time must be given, as time = {{ column = "t", unit = "s" }} or {{ rate_hz = 100 }}.'
        )
    values["time"] = _time(_table(values["time"], where, "time"), f"{where}, time")
    columns = values.get("columns", [])
    if not isinstance(columns, list) or not columns:
        raise UsageError(f'{where}: columns must be given: a list of tables such as {{ match = "taxel{{taxel}}" }}.')
    values["columns"] = tuple(_column(one, f"{where}, columns {number}") for number, one in enumerate(columns, 1))
    if "long" in values:
        values["long"] = fields.filled(Long, _table(values["long"], where, "long"), f"{where}, long", "entry")
    if "missing" in values and isinstance(values["missing"], list):
        values["missing"] = tuple(values["missing"])
    made: Stream = fields.filled(Stream, {"name": name, **values}, where, "entry")
    if len(made.separator) > 1:
        raise UsageError(f"{where}: separator is {excerpt(made.separator)}; it must be one character.")
    if made.separator and made.separator == made.decimal:
        raise UsageError(f"{where}: separator and decimal are both {made.decimal!r}; a number could not be read.")
    pattern.placeholders(made.files)
    return made


def _time(values: Mapping[str, Any], where: str) -> Time:
    made: Time = fields.filled(Time, values, where, "entry")
    if bool(made.column) == (made.rate_hz is not None):
        raise UsageError(f"{where}: give either the column with the stamps or rate_hz.")
    if made.start and made.origin != "start" and made.rate_hz is None:
        raise UsageError(
            f'{where}: start is for stamps that count from a recording\'s start. Set origin = "start" too.'
        )
    return made


def _column(value: Any, where: str) -> Column:
    made: Column = fields.filled(Column, _table(value, where, ""), where, "entry")
    pattern.filled(made.name, dict.fromkeys(pattern.placeholders(made.match), "x"))
    if made.type in ("bool", "text") and made.scale != 1.0:
        raise UsageError(f"{where}: scale is {made.scale}; only numbers have one.")
    return made


def _labels(value: Any, where: str) -> Labels:
    values = dict(_table(value, where, ""))
    if isinstance(values.get("columns"), list):
        values["columns"] = tuple(values["columns"])
    made: Labels = fields.filled(Labels, values, where, "entry")
    if not pattern.placeholders(made.file) and not made.key:
        raise UsageError(
            f"{where}: {plain(made.file)} is one file for all recordings. Set key to the column that names them."
        )
    return made


def _attributes(values: Mapping[str, Any], where: str) -> Mapping[str, str | int | float | bool]:
    for key, value in values.items():
        if not isinstance(value, str | int | float | bool):
            raise UsageError(
                f"{where}, [attributes]: {plain(key)} is {excerpt(value)}; it must be text, a number or true or false."
            )
    return dict(values)


def _table(value: Any, where: str, key: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise UsageError(f"{where}: {key or 'this'} is {excerpt(value)}; it must be a table.")
    return value
