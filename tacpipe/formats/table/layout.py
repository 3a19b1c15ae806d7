"""The layout file: which files belong to a recording, the meaning of columns, and the source of time and labels.

``docs/reference/layout.md`` describes each entry. A layout is validated completely before any data file is opened.
"""

from __future__ import annotations

import codecs
import json
import tomllib
import zoneinfo
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from tacpipe.channels import schema
from tacpipe.errors import UsageError
from tacpipe.formats.container import KINDS, Time, describe_kind, has_ending
from tacpipe.formats.table import pattern, stamps
from tacpipe.plugins import fields
from tacpipe.plugins.constraints import NonNegativeInt, PositiveInt
from tacpipe.plugins.stage import Values
from tacpipe.printable import excerpt, plain
from tacpipe.video.files import DEMUXERS, IMAGE_CODECS

Format = Literal[
    "csv",
    "parquet",
    "npz",
    "npy",
    "xlsx",
    "jsonl",
    "video",
    "images",
    "mcap",
    "rosbag",
    "hdf5",
    "zarr",
    "xdf",
    "lerobot",
]
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
CAMERA = ("video", "images")  # formats of streams of frames: a video file, and a folder of images
CAMERA_EXTENSIONS = (*DEMUXERS, *IMAGE_CODECS)
IMAGE_NAME = "name"  # time column of images whose file names contain the timestamps
TREES = (".json", ".yaml", ".yml")  # files with labels by name
TABLES = ("recordings", "streams", "labels", "attributes", "vocabulary")
STAMPS = ".stamps"  # suffix of a stream's name for its file of timestamps
GZIP = ".gz"
ROW = "number of the row"  # added column of a table of which each row is a recording
ONE_ROW = {"rate_hz": 1.0}  # time of a recording of one row without a time: it is at 0
FILE = "file"  # placeholder for a container's name if containers are found by format
UNKNOWN = "?"  # marks an entry of a guessed layout that a person must fill in
MAX_NAMED = 4  # maximum number of unknown entries named in an error


REPAIRS = ("batch", "wrap", "offset_s", "sort", "split_at_reset", "drop_first", "ambiguous")  # entries of ``time``
DECLARED = Time()  # no column or rate: the container declares the time


@dataclass(frozen=True)
class ColumnRule:
    """A rule for columns whose names match a pattern. Placeholders such as taxel and axis become field metadata."""

    match: str
    name: str = ""  # pattern of the new name; empty to keep the name
    quantity: str = ""
    unit: str = ""
    type: Kind | None = None  # None for the declared type, or float64 if there is none
    scale: float = 1.0  # factor applied to values of the file
    component: str = ""
    shape: tuple[PositiveInt, ...] = ()  # shape of the array that the columns are flattened from, such as (taxel, axis)
    axes: tuple[str, ...] = ()  # names along the last axis of the shape, or along the first
    about: tuple[tuple[str, str], ...] = ()  # additional metadata; a table in the file
    skip: bool = False


@dataclass(frozen=True)
class LongColumns:
    """Columns of a table in long form: one row per channel and time."""

    channel: str
    value: str


@dataclass(frozen=True)
class StreamLayout:
    """One stream of each recording."""

    name: str
    files: str = ""  # pattern of paths; empty for each container in the folder
    time: Time = DECLARED  # a container's own time, unless a column or a rate is given
    columns: tuple[ColumnRule, ...] = ()  # for containers, only the rules that replace declared metadata
    format: Format | None = None  # None to derive it from the file's suffix
    source: str = ""  # topic, group or dataset in a container
    separator: str = ""  # empty for a comma, or a tab in .tsv files
    decimal: Literal[".", ","] = "."
    comment: str = ""  # prefix of lines to ignore
    header: bool = True  # False if the file has no header: columns are named by ``names``, or column1, column2, …
    names: tuple[str, ...] = ()  # column names, if ``header`` in the layout is a list
    encoding: str = "utf-8"  # encoding of text files
    sheet: str = ""  # sheet of a workbook; empty for the first sheet
    time_axis: NonNegativeInt = 0  # axis of the rows in arrays
    array: str = ""  # NPZ and NPY only: name of an array of decoded images, each of which is a row
    skip_lines: NonNegativeInt = 0  # number of lines above the header
    missing: tuple[str, ...] = ()  # cells that mean a missing value (NaN)
    recording: str = ""  # column with the recording's name, if a file contains several recordings
    long: LongColumns | None = None
    optional: bool = False  # whether recordings without this stream are accepted

    @property
    def camera(self) -> str:
        """``video`` or ``images`` for a stream of frames, from its format or file suffix; otherwise ""."""
        if self.format is None:
            return "video" if extension(Path(self.files)) in DEMUXERS else ""
        return self.format if self.format in CAMERA else ""

    @property
    def contained(self) -> bool:
        """Whether the stream is one of several in a container."""
        return self.format in KINDS

    def format_of(self, path: Path) -> Format:
        """Return the format in the layout, or the one for the file's suffix. Raises `UsageError` if there is neither."""
        if self.format is not None:
            return self.format
        last = extension(path)
        if last not in EXTENSIONS:
            raise UsageError(
                f"{path} has none of the extensions {', '.join(EXTENSIONS)}. Set format in [streams.{self.name}]."
            )
        return EXTENSIONS[last]

    def separator_of(self, path: Path) -> str:
        """Return the cell separator of a text file."""
        return self.separator or ("\t" if ".tsv" in [suffix.lower() for suffix in path.suffixes] else ",")


def extension(path: Path) -> str:
    """Return the suffix of a file in lower case, without .gz.

    >>> extension(Path("a.CSV")), extension(Path("a.csv.gz")), extension(Path("a"))
    ('.csv', '.csv', '')
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    return suffixes[-2] if suffixes[-1:] == [GZIP] and len(suffixes) > 1 else "".join(suffixes[-1:])


def why_unreadable(path: str, unmatched: str, kind: str | None = None) -> str:
    """Return the reason why a file is not read: ``unmatched`` if the command supports its format.

    >>> why_unreadable("a/b.csv", "no pattern matches"), why_unreadable("a.mcap", "no pattern matches")
    ('no pattern matches', '`tacpipe ingest mcap` reads such files')
    """
    readable = [name for name in KINDS if has_ending(name, path)]
    if unmatched and (kind in readable or extension(Path(path)) in (*EXTENSIONS, *CAMERA_EXTENSIONS, *TREES)):
        return unmatched
    if readable and kind not in readable:
        return f"`tacpipe ingest {readable[0]}` reads such files"
    formats = (
        describe_kind(kind)
        if kind is not None
        else ", ".join(f"*{ending}" for ending in (*EXTENSIONS, *CAMERA_EXTENSIONS))
    )
    return f"the command reads {formats}"


@dataclass(frozen=True)
class LabelSource:
    """A source of labels: a table with one row per recording, or YAML or JSON files, one per recording or one for all."""

    file: str
    key: str = ""  # table column with the recording's name
    columns: tuple[str, ...] = ()  # columns of the table; empty for all columns


@dataclass(frozen=True)
class Vocabulary:
    """Quantities and units that the layout declares in addition to the built-in ones."""

    quantities: tuple[str, ...] = ()
    units: tuple[str, ...] = ()


@dataclass(frozen=True)
class RecordingsTable:
    """The table ``[recordings]``: how recordings are named, and whether each row of a stream is one."""

    name: str = ""
    per_row: str = ""
    labels: tuple[str, ...] = ()


@dataclass(frozen=True)
class Layout:
    """The contents of a layout file."""

    streams: tuple[StreamLayout, ...]
    name: str = ""  # pattern of a recording's name; empty for all placeholders joined by dashes
    labels: tuple[LabelSource, ...] = ()
    attributes: Mapping[str, str | int | float | bool] = field(default_factory=dict)
    per_row: str = ""  # stream of which each row is a recording; empty for recordings that are files
    row_labels: tuple[str, ...] = ()  # columns of that stream that are labels of the recordings

    @property
    def row_streams(self) -> tuple[StreamLayout, ...]:
        """The streams whose files the cells of a row name, such as the image of each row."""
        table = next((stream for stream in self.streams if stream.name == self.per_row), None)
        in_table = set() if table is None else set(pattern.placeholders(table.files))
        return tuple(
            stream for stream in self.streams if table and not set(pattern.placeholders(stream.files)) <= in_table
        )

    @property
    def row_columns(self) -> tuple[str, ...]:
        """The columns of the table of recordings that are labels, or placeholders in the files of other streams."""
        table_placeholders = {
            name
            for stream in self.streams
            if stream.name == self.per_row
            for name in pattern.placeholders(stream.files)
        }
        named = [name for stream in self.row_streams for name in pattern.placeholders(stream.files)]
        return tuple(dict.fromkeys([*self.row_labels, *(name for name in named if name not in table_placeholders)]))

    @property
    def found_by_format(self) -> bool:
        """Whether recordings are containers found by format rather than files that match patterns."""
        return all(not stream.files for stream in self.streams)

    @property
    def placeholders(self) -> tuple[str, ...]:
        """The placeholders in the patterns of all required streams, in the order of the first."""
        if self.found_by_format:
            return ()
        found_by_path = [stream for stream in self.streams if stream not in self.row_streams]
        required = [stream for stream in found_by_path if not stream.optional] or found_by_path
        shared = set.intersection(*(set(pattern.placeholders(stream.files)) for stream in required))
        return tuple(name for name in pattern.placeholders(required[0].files) if name in shared)


def parse_layout(text: str, place: str = "The layout") -> Layout:
    """Return the layout in a TOML text; ``place`` names it in errors. Raises `UsageError` if it is invalid."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{place} is not TOML: {plain(str(error), 200)}.") from error
    return layout_from_tables(tables, place)


def layout_from_tables(tables: Values, place: str = "The layout", container: Format | None = None) -> Layout:
    """Return the layout described by parsed TOML tables.

    With a ``container`` format, streams default to that format and need no files, time or columns, because the
    container declares them. A layout without streams then covers everything in the container. Raises `UsageError` if a
    table or an entry is invalid.
    """
    _refuse_unknown(tables, place)
    for key in tables:
        if key not in TABLES:
            raise UsageError(f"{place}: there is no table [{plain(key)}]; there are {', '.join(TABLES)}.")
    streams = _expect_table(tables.get("streams", {}), place, "streams")
    if not streams and container is None:
        raise UsageError(f"{place} has no stream. Add a table such as [streams.skin] with files, time and columns.")
    recordings = _expect_table(tables.get("recordings", {}), place, "recordings")
    given: RecordingsTable = fields.build_dataclass(RecordingsTable, recordings, f"{place}, [recordings]", "entry")
    if given.labels and not given.per_row:
        raise UsageError(f"{place}, [recordings]: labels are columns of the stream that per_row names. Add per_row.")
    name = given.name
    labels = tables.get("labels", [])
    if not isinstance(labels, list):
        raise UsageError(f"{place}: labels is a list of tables. Write [[labels]].")
    layout = Layout(
        tuple(_parse_stream(stream, value, place, container, given) for stream, value in streams.items()),
        name,
        tuple(_parse_labels(value, f"{place}, [[labels]] {number}") for number, value in enumerate(labels, 1)),
        _parse_attributes(tables.get("attributes", {}), place),
        given.per_row,
        given.labels,
    )
    if layout.per_row:
        layout = _with_rows(layout, f"{place}, [recordings]")
    words = _expect_table(tables.get("vocabulary", {}), place, "vocabulary")
    _expect_known_words(layout, fields.build_dataclass(Vocabulary, words, f"{place}, [vocabulary]", "entry"), place)
    with_files = [value.name for value in layout.streams if value.files]
    if with_files and len(with_files) < len(layout.streams):
        raise UsageError(
            f"{place}: [streams.{with_files[0]}] has files and others have none. Give files to all of them."
        )
    available = [*layout.placeholders, "recording", *((FILE,) if layout.found_by_format else ())]
    pattern.fill_pattern(name, dict.fromkeys(available, "x"))
    return layout


def _with_rows(layout: Layout, place: str) -> Layout:
    """Return the layout with rules that skip the columns of the table of recordings that describe these.

    Raises `UsageError` unless ``per_row`` names a table with one row per time.
    """
    table = next((stream for stream in layout.streams if stream.name == layout.per_row), None)
    if table is None:
        raise UsageError(
            f"{place}: per_row is {excerpt(layout.per_row)}; it must be one of the streams "
            f"{', '.join(stream.name for stream in layout.streams)}."
        )
    if table.camera or table.array or table.contained or table.long or table.recording != ROW:
        raise UsageError(f"{place}: per_row is for a table with one row per time, and {table.name} is none.")
    if table.time.file or any(getattr(table.time, name) for name in REPAIRS if name != "offset_s"):
        raise UsageError(f"{place}: each row of {table.name} is a recording, so its time is a column, or left out.")
    exact = {rule.match for rule in table.columns}
    skipped = tuple(ColumnRule(name, skip=True) for name in layout.row_columns if name not in exact)
    changed = replace(table, columns=(*skipped, *table.columns))
    return replace(layout, streams=tuple(changed if stream is table else stream for stream in layout.streams))


def _expect_known_words(layout: Layout, local: Vocabulary, place: str) -> None:
    """Raise `UsageError` for a quantity or unit that is neither built in nor declared in the layout."""
    for stream in layout.streams:
        for number, column in enumerate(stream.columns, 1):
            quantity_fault = schema.describe_unknown_quantity(column.quantity, local.quantities)
            unit_fault = schema.describe_unknown_unit(column.unit, local.units)
            for kind, fault, word in (
                ("quantities", quantity_fault, column.quantity),
                ("units", unit_fault, column.unit),
            ):
                if fault:
                    raise UsageError(
                        f"{place}, [streams.{stream.name}], columns {number}: {fault} To use a word of your own, add "
                        f"[vocabulary] with {kind} = [{excerpt(word)}]."
                    )


def _refuse_unknown(value: Any, place: str) -> None:
    """Raise `UsageError` if entries of a guessed layout have not been filled in, naming the first few."""
    unknown_entries = list(_unknown_entries(value, place))
    if unknown_entries:
        ending = f"; and {len(unknown_entries) - MAX_NAMED} more" if len(unknown_entries) > MAX_NAMED else ""
        raise UsageError(
            f"{'; '.join(unknown_entries[:MAX_NAMED])}{ending}. Write what it is, or skip = true for a column."
        )


def _unknown_entries(value: Any, place: str) -> Iterator[str]:
    """Yield a sentence for each entry of a guessed layout that has not been filled in, with its neighbours."""
    for key, inner in value.items() if isinstance(value, dict) else ():
        for element in inner if isinstance(inner, list) else [inner]:
            if element == UNKNOWN:
                context = ", ".join(f"{name} = {excerpt(text)}" for name, text in value.items() if text != UNKNOWN)
                yield f'{place}: {plain(key)} is "?"' + (f" ({context})" if context else "")
            else:
                yield from _unknown_entries(element, f"{place}, {plain(key)}")


def _parse_stream(
    name: str, value: Any, place: str, container: Format | None, recordings: RecordingsTable
) -> StreamLayout:
    """Return the layout of a stream from its table. Raises `UsageError` for a missing, unknown or contradictory entry."""
    stream_place = f"{place}, [streams.{plain(name)}]"
    values = dict(_expect_table(value, stream_place, ""))
    if not name.isidentifier():
        raise UsageError(
            f"{stream_place}: a stream's name is letters, digits and underscores, as it becomes a file's name."
        )
    if container is not None:
        values.setdefault("format", container)
    if recordings.per_row:
        values = _row_defaults(values, is_table=name == recordings.per_row)
    if isinstance(values.get("columns"), list):
        numbered = enumerate(values["columns"], 1)
        values["columns"] = [_with_pairs(column, f"{stream_place}, columns {number}") for number, column in numbered]
    if isinstance(values.get("header"), list):
        values["names"], values["header"] = values["header"], False
    stream: StreamLayout = fields.build_dataclass(
        StreamLayout, {"name": name, **values}, stream_place, "entry", "entry"
    )
    if stream.contained:
        _expect_contained(stream, stream_place, container)
    else:
        _expect_table_entries(stream, stream_place, has_time="time" in values)
    if "time" in values:
        _expect_time(stream.time, f"{stream_place}, time")
    for number, column in enumerate(stream.columns, 1):
        _expect_column(column, f"{stream_place}, columns {number}")
    if len(stream.separator) > 1:
        raise UsageError(f"{stream_place}: separator is {excerpt(stream.separator)}; it must be one character.")
    if stream.separator and stream.separator == stream.decimal:
        raise UsageError(
            f"{stream_place}: separator and decimal are both {stream.decimal!r}; a number could not be read."
        )
    _expect_encoding(stream, stream_place)
    _expect_repairs(stream, stream_place)
    absent = set(pattern.placeholders(stream.time.file)) - set(pattern.placeholders(stream.files))
    if absent:
        raise UsageError(f"{stream_place}: time.file names {{{min(absent)}}}, which files does not have.")
    return stream


def _row_defaults(values: Values, *, is_table: bool) -> dict[str, Any]:
    """Return the entries of a stream whose recordings are rows, with those that are understood."""
    is_video = StreamLayout("", str(values.get("files", "")), format=values.get("format")).camera == "video"
    defaults: dict[str, Any] = {} if is_video else {"time": ONE_ROW}
    return {**defaults, **({"recording": ROW} if is_table else {}), **values}


def _with_pairs(column: Any, place: str) -> Any:
    """Return a column of a layout with the table ``about`` as sorted pairs. Raises `UsageError` if it is no table."""
    if not isinstance(column, dict) or "about" not in column:
        return column
    return {**column, "about": sorted(_expect_table(column["about"], place, "about").items())}


def _expect_encoding(stream: StreamLayout, place: str) -> None:
    """Raise `UsageError` for an encoding unknown to Python."""
    try:
        codecs.lookup(stream.encoding)
    except LookupError:
        raise UsageError(
            f"{place}: encoding is {excerpt(stream.encoding)}; it must be one of Python's, as utf-8, utf-16 or cp1252."
        ) from None


def _expect_contained(stream: StreamLayout, place: str, container: Format | None) -> None:
    """Raise `UsageError` for a missing or unfit entry of a stream in a container."""
    if not stream.source:
        raise UsageError(f"{place}: source must be given: the topic, group or stream inside the file.")
    if stream.recording:
        raise UsageError(f"{place}: recording is for tables; a container names the recordings in it itself.")
    if stream.time.file:
        raise UsageError(f"{place}: time.file is for tables; a container holds its stamps. Name their column.")
    if not stream.files and container is None:
        raise UsageError(f'{place}: files must be given, as files = "{{trial}}.{stream.format}".')


def _expect_table_entries(stream: StreamLayout, place: str, *, has_time: bool) -> None:
    """Raise `UsageError` for a missing or unfit entry of a stream of tables, images or a video."""
    if stream.array and (stream.format or EXTENSIONS.get(extension(Path(stream.files)))) not in ("npz", "npy"):
        raise UsageError(f"{place}: array is for npz and npy. Use source for HDF5 and Zarr, and format for images.")
    if stream.source:
        raise UsageError(f"{place}: source is for containers ({', '.join(KINDS)}). Set format to one of them.")
    if not stream.files:
        raise UsageError(f"{place}: entry files must be given.")
    entries: dict[str, object] = {"columns": stream.columns, "recording": stream.recording, "long": stream.long}
    entries |= {"header": stream.names, "separator": stream.separator} if stream.camera else {}
    table_entries = [name for name, value in entries.items() if value]
    if (stream.camera or stream.array) and table_entries:
        noun = f"A {stream.camera} stream" if stream.camera else "A stream of images"
        raise UsageError(f"{place}: {table_entries[0]} is for tables. {noun} has a row per frame; remove it.")
    if stream.camera == "images" and not has_time:
        raise UsageError(
            f'{place}: time must be given, as time = {{ column = "{IMAGE_NAME}", unit = "ns" }} (the last number in the '
            'names of the images), { file = "{trial}/stamps.csv" } or { rate_hz = 25 }.'
        )
    column = "" if stream.time.file else stream.time.column
    if stream.camera and column and (stream.camera == "video" or column != IMAGE_NAME):
        is_images = stream.camera == "images"
        expected = f'column = "{IMAGE_NAME}", file or rate_hz' if is_images else "file or rate_hz, or no time"
        raise UsageError(f"{place}: time.column is {excerpt(column)}; a stream of {stream.camera} takes {expected}.")
    if not stream.camera and not has_time:
        raise UsageError(
            f'{place}: time must be given, as time = {{ column = "t", unit = "s" }}, {{ file = "{{trial}}/stamps.npy" }} or '
            "{ rate_hz = 100 }."
        )
    if not (stream.camera or stream.columns or stream.array):
        raise UsageError(f'{place}: columns must be given: a list of tables such as {{ match = "taxel{{taxel}}" }}.')


def _expect_time(time: Time, place: str) -> None:
    """Raise `UsageError` unless a time has stamps or a rate, and for entries that do not fit."""
    if not time.is_declared:
        raise UsageError(f"{place}: give the column or the file with the stamps, or rate_hz.")
    repairs = [name for name in REPAIRS if getattr(time, name)]
    if repairs and not (time.column or time.file):
        raise UsageError(f"{place}: {repairs[0]} repairs stamps. Give their column or file.")
    try:
        zoneinfo.ZoneInfo(time.zone)
    except (ValueError, OSError, zoneinfo.ZoneInfoNotFoundError):
        raise UsageError(f"{place}: zone is {excerpt(time.zone)}; it must be one such as Europe/Berlin.") from None
    if time.format:
        stamps.check_format(time.format, place)
    elif time.start and time.origin != "start" and time.rate_hz is None:
        raise UsageError(
            f'{place}: start is for stamps that count from a recording\'s start. Set origin = "start" too.'
        )


def _expect_repairs(stream: StreamLayout, place: str) -> None:
    """Raise `UsageError` for repairs of stamps that do not fit the kind of stream."""
    unfit = [name for name in REPAIRS if getattr(stream.time, name) and name not in ("offset_s", "ambiguous")]
    if (stream.camera or stream.array) and unfit:
        raise UsageError(f"{place}: time.{unfit[0]} is for tables. A camera keeps its frames as they come.")
    if stream.time.split_at_reset and stream.time.sort:
        raise UsageError(f"{place}: time.sort and time.split_at_reset exclude each other.")
    if stream.time.split_at_reset and (stream.recording or stream.long or stream.contained):
        raise UsageError(f"{place}: time.split_at_reset is for tables of one recording, one row per time.")


def _expect_column(column: ColumnRule, place: str) -> None:
    """Raise `UsageError` for an invalid name pattern of a column, and for axes or a scale that do not fit."""
    placeholder_names = ("taxel", "axis") if column.shape else ()
    pattern.fill_pattern(column.name, dict.fromkeys((*pattern.placeholders(column.match), *placeholder_names), "x"))
    if column.axes and (not column.shape or len(column.axes) not in (column.shape[-1], column.shape[0])):
        raise UsageError(
            f"{place}: axes has {len(column.axes)} names, and shape is {list(column.shape)}. Its last dimension needs one "
            "each."
        )
    if column.type in ("bool", "text", "binary") and column.scale != 1.0:
        raise UsageError(f"{place}: scale is {column.scale}; only numbers have one.")


def _parse_labels(value: Any, place: str) -> LabelSource:
    """Return a source of labels. Raises `UsageError` if it is one table for all recordings without a key column."""
    labels: LabelSource = fields.build_dataclass(LabelSource, _expect_table(value, place, ""), place, "entry")
    is_tree = labels.file.lower().endswith(TREES)  # names in a YAML or JSON file are recording names
    if not pattern.placeholders(labels.file) and not labels.key and not is_tree:
        raise UsageError(
            f"{place}: {plain(labels.file)} is one file for all recordings. Set key to the column that names them."
        )
    return labels


def _parse_attributes(table: Any, place: str) -> Mapping[str, str | int | float | bool]:
    """Return the attributes of all recordings. Raises `UsageError` if one is not plain."""
    values = _expect_table(table, place, "attributes")
    for key, value in values.items():
        if not isinstance(value, str | int | float | bool):
            raise UsageError(
                f"{place}, [attributes]: {plain(key)} is {excerpt(value)}; it must be text, a number or true or false."
            )
    return dict(values)


def _expect_table(value: Any, place: str, key: str) -> Values:
    if not isinstance(value, dict):
        raise UsageError(f"{place}: {key or 'this'} is {excerpt(value)}; it must be a table.")
    return value


def quoted(text: str) -> str:
    """Return a text quoted for a layout file, with control characters escaped."""
    return json.dumps(plain(text, 500) if not text.isprintable() and text != "\t" else text, ensure_ascii=False)
