"""The layout file: which files make a recording, what their columns hold, where time and labels come from.

``docs/tutorials/own-data.md`` describes each entry. A layout is checked as a whole when it is read, before any data file
is opened.
"""

from __future__ import annotations

import codecs
import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tacpipe.channels import vocabulary
from tacpipe.errors import UsageError
from tacpipe.formats.containers import kinds
from tacpipe.formats.containers.container import Time
from tacpipe.formats.table import pattern, stamp_formats
from tacpipe.io import regular
from tacpipe.plugins import fields
from tacpipe.plugins.constraints import NonNegativeInt, PositiveInt
from tacpipe.printable import excerpt, plain

MOST_BYTES = 1 << 20  # of a layout file
Format = Literal["csv", "parquet", "npz", "npy", "xlsx", "jsonl", "mcap", "rosbag", "hdf5", "zarr", "xdf", "lerobot"]
Kind = Literal[
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "uint64",
    "float32",
    "float64",
    "bool",
    "text",
    "binary",
]
EXTENSIONS: Mapping[str, Format] = {
    ".csv": "csv",
    ".tsv": "csv",
    ".txt": "csv",
    ".parquet": "parquet",
    ".npz": "npz",
    ".npy": "npy",
    ".xlsx": "xlsx",
    ".xlsm": "xlsx",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
}
TREES = (".json", ".yaml", ".yml")  # files that hold labels by name
TABLES = ("recordings", "streams", "labels", "attributes", "vocabulary")
STAMPS = ".stamps"  # suffix of a stream's name that marks the file of its stamps
GZIP = ".gz"
FILE = "file"  # the placeholder of a container's name, where containers are found by their format
UNKNOWN = "?"  # what a guessed layout could not know
OPEN = 4  # of such entries that are named at once


DECLARED = Time()  # neither a column nor a rate: the container declares it


@dataclass(frozen=True)
class Column:
    """What the columns are whose names match a pattern; placeholders become field metadata, as taxel and axis."""

    match: str
    name: str = ""  # pattern; empty: as in the file
    quantity: str = ""
    unit: str = ""
    type: Kind | None = None  # None: as a container declares it, else float64
    scale: float = 1.0  # a value is what the file holds times this
    component: str = ""
    shape: tuple[PositiveInt, ...] = ()  # shape of the array whose cells are the columns, as (taxel, axis)
    axes: tuple[str, ...] = ()  # names along the last dimension of the shape, or else the first
    about: tuple[tuple[str, str], ...] = ()  # more metadata of the column; a table in the file
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
    files: str = ""  # empty: each container found in the folder
    time: Time = DECLARED  # without a column or a rate: as the container declares it
    columns: tuple[Column, ...] = ()  # of a container: where what it declares is to be replaced
    format: Format | None = None  # None: by the extension
    source: str = ""  # the topic, group or dataset inside a container
    separator: str = ""  # empty: a comma, or a tab in a .tsv
    decimal: Literal[".", ","] = "."
    comment: str = ""  # what lines begin with that hold no row
    header: bool = True  # False: columns are named by ``names``, or column1, column2, …
    names: tuple[str, ...] = ()  # column names, where the layout's ``header`` is a list
    encoding: str = "utf-8"  # text files only
    sheet: str = ""  # workbooks only; empty: the first sheet
    time_axis: NonNegativeInt = 0  # arrays only: the dimension of the rows
    skip_lines: NonNegativeInt = 0  # before the header
    missing: tuple[str, ...] = ()  # cells that hold no value: NaN
    recording: str = ""  # the column that names the recording, where a file holds many
    long: Long | None = None
    optional: bool = False  # whether recordings without this stream are read

    @property
    def contained(self) -> bool:
        """Whether the stream is one of several in a container."""
        return self.format in kinds.KINDS

    def format_of(self, path: Path) -> Format:
        """Return the format of a file: the layout's, or that of its extension. Raises `UsageError` without both."""
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


def why_unreadable(path: str, unmatched: str, kind: str | None = None) -> str:
    """Return why a file is not read: ``unmatched`` where its format is one that the command could read.

    >>> why_unreadable("a/b.csv", "no pattern matches"), why_unreadable("a.mcap", "no pattern matches")
    ('no pattern matches', '`tacpipe ingest mcap` reads such files')
    """
    readable = [name for name in kinds.KINDS if kinds.has_ending(name, path)]
    if unmatched and (kind in readable or extension(Path(path)) in (*EXTENSIONS, *TREES)):
        return unmatched
    if readable and kind not in readable:
        return f"`tacpipe ingest {readable[0]}` reads such files"
    reads = kinds.described(kind) if kind is not None else ", ".join(f"*{ending}" for ending in EXTENSIONS)
    return f"the command reads {reads}"


@dataclass(frozen=True)
class Labels:
    """A source of labels: a table with a row a recording, or YAML or JSON, one file a recording or one of all."""

    file: str
    key: str = ""  # the table's column that names the recording
    columns: tuple[str, ...] = ()  # empty: all


@dataclass(frozen=True)
class Vocabulary:
    """Words that the layout declares in addition to those that tacpipe knows."""

    quantities: tuple[str, ...] = ()
    units: tuple[str, ...] = ()


@dataclass(frozen=True)
class Layout:
    """Everything that a layout file states."""

    streams: tuple[Stream, ...]
    name: str = ""  # pattern of a recording's name; empty: all placeholders with dashes between
    labels: tuple[Labels, ...] = ()
    attributes: Mapping[str, str | int | float | bool] = field(default_factory=dict)

    @property
    def found_by_format(self) -> bool:
        """Whether recordings are the containers in a folder, rather than files that match patterns."""
        return all(not one.files for one in self.streams)

    @property
    def placeholders(self) -> tuple[str, ...]:
        """The placeholders that every stream which must be there has, in the order of the first."""
        if self.found_by_format:
            return ()
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


def of(tables: Mapping[str, Any], where: str = "The layout", container: Format | None = None) -> Layout:
    """Return the layout that these tables of TOML are.

    Of a layout for a ``container`` format streams have that format where they name none, and need neither files, time
    nor columns, as the container declares them; without a stream it is about all that a container holds.
    """
    _refuse_unknown(tables, where)
    for key in tables:
        if key not in TABLES:
            raise UsageError(f"{where}: there is no table [{plain(key)}]; there are {', '.join(TABLES)}.")
    streams = _table(tables.get("streams", {}), where, "streams")
    if not streams and container is None:
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
        tuple(_stream(stream, value, where, container) for stream, value in streams.items()),
        name,
        tuple(_labels(one, f"{where}, [[labels]] {number}") for number, one in enumerate(labels, 1)),
        _attributes(_table(tables.get("attributes", {}), where, "attributes"), where),
    )
    _expect_known_words(made, _table(tables.get("vocabulary", {}), where, "vocabulary"), where)
    named = [one.name for one in made.streams if one.files]
    if named and len(named) < len(made.streams):
        raise UsageError(f"{where}: [streams.{named[0]}] has files and others have none. Give files to all of them.")
    known = [*made.placeholders, "recording", *((FILE,) if made.found_by_format else ())]
    pattern.filled(name, dict.fromkeys(known, "x"))
    return made


def _expect_known_words(layout: Layout, vocabulary_table: Mapping[str, Any], place: str) -> None:
    """Raise `UsageError` for a quantity or unit that is neither in the vocabulary nor declared in the layout."""
    local: Vocabulary = fields.filled(Vocabulary, vocabulary_table, f"{place}, [vocabulary]", "entry")
    for stream in layout.streams:
        for number, column in enumerate(stream.columns, 1):
            for kind, fault, word in (
                (
                    "quantities",
                    vocabulary.describe_unknown_quantity(column.quantity, local.quantities),
                    column.quantity,
                ),
                ("units", vocabulary.describe_unknown_unit(column.unit, local.units), column.unit),
            ):
                if fault:
                    raise UsageError(
                        f"{place}, [streams.{stream.name}], columns {number}: {fault} To use a word of your own, add "
                        f"[vocabulary] with {kind} = [{excerpt(word)}]."
                    )


def _refuse_unknown(value: Any, where: str) -> None:
    """Raise `UsageError` where entries still hold what a guess could not know, naming the first few."""
    found = list(_unknown(value, where))
    if found:
        more = f"; and {len(found) - OPEN} more" if len(found) > OPEN else ""
        raise UsageError(f"{'; '.join(found[:OPEN])}{more}. Write what it is, or skip = true for a column.")


def _unknown(value: Any, where: str) -> Iterator[str]:
    """Yield each entry that still holds what a guess could not know, with what is next to it."""
    for key, inner in value.items() if isinstance(value, dict) else ():
        for one in inner if isinstance(inner, list) else [inner]:
            if one == UNKNOWN:
                known = ", ".join(f"{name} = {excerpt(found)}" for name, found in value.items() if found != UNKNOWN)
                yield f'{where}: {plain(key)} is "?"' + (f" ({known})" if known else "")
            else:
                yield from _unknown(one, f"{where}, {plain(key)}")


def _stream(name: str, value: Any, where: str, container: Format | None) -> Stream:
    where = f"{where}, [streams.{plain(name)}]"
    values = dict(_table(value, where, ""))
    if not name.isidentifier():
        raise UsageError(f"{where}: a stream's name is letters, digits and underscores, as it becomes a file's name.")
    if container is not None:
        values.setdefault("format", container)
    _expect_given(values, where, container)
    if "time" in values:
        values["time"] = _time(_table(values["time"], where, "time"), f"{where}, time")
    columns = values.get("columns", [])
    if not isinstance(columns, list):
        raise UsageError(f"{where}: columns is {excerpt(columns)}; it must be a list of tables.")
    values["columns"] = tuple(_column(one, f"{where}, columns {number}") for number, one in enumerate(columns, 1))
    if "long" in values:
        values["long"] = fields.filled(Long, _table(values["long"], where, "long"), f"{where}, long", "entry")
    if isinstance(values.get("header"), list):
        values["names"], values["header"] = values["header"], False
    if "missing" in values and isinstance(values["missing"], list):
        values["missing"] = tuple(values["missing"])
    made: Stream = fields.filled(Stream, {"name": name, **values}, where, "entry")
    if len(made.separator) > 1:
        raise UsageError(f"{where}: separator is {excerpt(made.separator)}; it must be one character.")
    if made.separator and made.separator == made.decimal:
        raise UsageError(f"{where}: separator and decimal are both {made.decimal!r}; a number could not be read.")
    _expect_encoding(made, where)
    absent = set(pattern.placeholders(made.time.file)) - set(pattern.placeholders(made.files))
    if absent:
        raise UsageError(f"{where}: time.file names {{{min(absent)}}}, which files does not have.")
    return made


def _expect_encoding(stream: Stream, place: str) -> None:
    """Raise `UsageError` for an encoding that Python does not have."""
    try:
        codecs.lookup(stream.encoding)
    except LookupError:
        raise UsageError(
            f"{place}: encoding is {excerpt(stream.encoding)}; it must be one of Python's, as utf-8, utf-16 or cp1252."
        ) from None


def _expect_given(values: Mapping[str, Any], where: str, container: Format | None) -> None:
    """Raise `UsageError` for an entry that is missing: a container declares what a table does not."""
    if values.get("format") in kinds.KINDS:
        if not values.get("source"):
            raise UsageError(f"{where}: source must be given: the topic, group or stream inside the file.")
        if values.get("recording"):
            raise UsageError(f"{where}: recording is for tables; a container names the recordings in it itself.")
        if isinstance(values.get("time"), dict) and values["time"].get("file"):
            raise UsageError(f"{where}: time.file is for tables; a container holds its stamps. Name their column.")
        if "files" not in values and container is None:
            raise UsageError(f'{where}: files must be given, as files = "{{trial}}.{values["format"]}".')
        return
    if values.get("source"):
        raise UsageError(f"{where}: source is for containers ({', '.join(kinds.KINDS)}). Set format to one of them.")
    if "files" not in values:
        raise UsageError(f"{where}: entry files must be given.")
    if "time" not in values:
        raise UsageError(
            f'{where}: time must be given, as time = {{ column = "t", unit = "s" }}, {{ file = "{{trial}}/stamps.npy" }} or '
            "{ rate_hz = 100 }."
        )
    if not values.get("columns"):
        raise UsageError(f'{where}: columns must be given: a list of tables such as {{ match = "taxel{{taxel}}" }}.')


def _time(values: Mapping[str, Any], where: str) -> Time:
    made: Time = fields.filled(Time, values, where, "entry")
    if bool(made.column or made.file) == (made.rate_hz is not None):
        raise UsageError(f"{where}: give either the column or the file with the stamps, or rate_hz.")
    if made.format:
        stamp_formats.check(made.format, where)
    elif made.start and made.origin != "start" and made.rate_hz is None:
        raise UsageError(
            f'{where}: start is for stamps that count from a recording\'s start. Set origin = "start" too.'
        )
    return made


def _column(value: Any, where: str) -> Column:
    values = dict(_table(value, where, ""))
    if "about" in values:
        values["about"] = tuple(sorted(_table(values["about"], where, "about").items()))
    made: Column = fields.filled(Column, values, where, "entry")
    places = ("taxel", "axis") if made.shape else ()
    pattern.filled(made.name, dict.fromkeys((*pattern.placeholders(made.match), *places), "x"))
    if made.axes and (not made.shape or len(made.axes) not in (made.shape[-1], made.shape[0])):
        raise UsageError(
            f"{where}: axes has {len(made.axes)} names, and shape is {list(made.shape)}. Its last dimension needs one each."
        )
    if made.type in ("bool", "text", "binary") and made.scale != 1.0:
        raise UsageError(f"{where}: scale is {made.scale}; only numbers have one.")
    return made


def _labels(value: Any, where: str) -> Labels:
    values = dict(_table(value, where, ""))
    if isinstance(values.get("columns"), list):
        values["columns"] = tuple(values["columns"])
    made: Labels = fields.filled(Labels, values, where, "entry")
    is_tree = made.file.lower().endswith(TREES)  # the names in a tree are those of recordings
    if not pattern.placeholders(made.file) and not made.key and not is_tree:
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


def quoted(text: str) -> str:
    """Return a text as a layout file writes it; control characters are escaped."""
    return json.dumps(plain(text, 500) if not text.isprintable() and text != "\t" else text, ensure_ascii=False)
