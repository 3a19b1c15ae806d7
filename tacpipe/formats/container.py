"""Recognize and open containers: files with several streams and their description, such as bags, HDF5 or XDF files.

A format is a `Container`: the episodes, a preview of one, and the streams of one episode read in one pass. Each
stream is a `SourceStream`: its name in the file (``source``), a stream name, the origin of its timestamps (`Time`), and
rows whose fields have type, quantity, unit and layout as metadata. Rows are a table, or `Batched` if they do not all
fit in memory. Unreadable sources are listed with reasons in `EpisodeContents.skipped`, missing parts of damaged files
in `EpisodeContents.notes`, and metadata of the file become `EpisodeContents.attributes`.

The layout file of ``ingest table`` is applied to these contents: a stream of the layout refers to one of the container
with ``source``; rules in ``columns`` and ``time`` replace what the file declares and can be omitted if that is right. A
new format is

1. a module with ``opened(path) -> Container``, which imports its library inside functions;
2. an entry in `tacpipe.formats.container.KINDS`, and its name in `Format` of ``tacpipe/formats/table/layout.py``;
3. a stage, created by `tacpipe.formats.table.contained.LayoutCommand`, with an entry point ``tacpipe.formats``.
"""

from __future__ import annotations

import importlib
import json
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar, cast

from tacpipe.errors import UsageError
from tacpipe.io import config_text, regular
from tacpipe.io import files as file_system
from tacpipe.plugins.constraints import NonNegativeFloat, NonNegativeInt, Rate
from tacpipe.plugins.stage import Attribute, Values
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import pyarrow as pa

TimeUnit = Literal["s", "ms", "us", "ns", "iso8601"]


@dataclass(frozen=True)
class Time:
    """The origin of a stream's timestamps: a column, a separate file, or a rate."""

    column: str = ""
    unit: TimeUnit = "s"
    rate_hz: Rate | None = None
    origin: Literal["unix", "start"] = "unix"  # time zero of numbers: 1970, or the start of the recording
    zone: str = "UTC"  # time zone of ISO 8601 timestamps without one, such as Europe/Berlin
    # ISO 8601, UTC: first timestamp of recordings that count from their start, or the date of times of day
    start: str = ""
    file: str = ""  # pattern of a file with the timestamps of all rows
    format: str = ""  # strptime format of text timestamps, such as %d.%m.%Y %H:%M:%S.%f; without %Y, times of day
    batch: bool = False  # rows arrive in batches: timestamps are arrivals, and ``rate_hz`` is the declared rate
    wrap: NonNegativeFloat = 0.0  # value at which the counter starts again from 0, in ``unit``; 0 for none
    offset_s: float = 0.0  # added to each timestamp
    sort: bool = False  # sort rows by timestamp
    split_at_reset: bool = False  # each stretch between two settings of the clock is a recording
    drop_first: NonNegativeInt = 0  # number of first rows to leave out
    ambiguous: Literal["", "earlier", "later"] = ""  # reading of local times that summer time repeats

    def entry(self, **changes: Any) -> str:
        """Return the time as an entry of a layout, with some fields changed. The unit of numbers is always written.

        >>> Time("t", "ms").entry(batch=True)
        '{ column = "t", unit = "ms", batch = true }'
        """
        values = {**self.__dict__, **changes}
        has_unit = bool(self.column or self.file) and not self.format
        written = {
            field.name: values[field.name]
            for field in fields(self)
            if values[field.name] != field.default or (field.name == "unit" and has_unit)
        }
        whole = {name: int(value) for name, value in written.items() if type(value) is float and value.is_integer()}
        return config_text.toml_value(written | whole)

    @property
    def is_text(self) -> bool:
        """Whether timestamps are text."""
        return bool(self.format) or self.unit == "iso8601"

    @property
    def is_declared(self) -> bool:
        """Whether a column, a file or a rate is given."""
        return bool(self.column or self.file) or self.rate_hz is not None


@dataclass(frozen=True)
class Batched:
    """Rows read in batches: each call of ``read`` yields all rows from the start, as tables of the schema."""

    schema: pa.Schema
    rows: int
    read: Callable[[], Iterator[pa.Table]]

    def with_fields(self, fields: Mapping[str, pa.Field]) -> Batched:
        """Return the rows of some columns, each with another field."""
        import pyarrow as pa

        schema = pa.schema(list(fields.values()))
        return self.mapped(schema, lambda table: pa.table([table.column(name) for name in fields], schema))

    def mapped(self, schema: pa.Schema, change: Callable[[pa.Table], pa.Table]) -> Batched:
        """Return the same rows with ``change`` applied to each table; its results have ``schema``."""
        return Batched(schema, self.rows, lambda: map(change, self.read()))


@dataclass(frozen=True)
class SourceStream:
    """A stream in a container.

    Columns are 1-D and have the types of a layout (``tacpipe.formats.table.columns.TYPES``); an array is split into
    columns. Field metadata are ``quantity``, ``unit``, ``component``, and the channel's position in its sensor:
    ``taxel``, ``axis``, ``joint``, …. Metadata of the time field are copied to ``t_ns``.
    """

    source: str  # name in the file: a topic, a group, a dataset
    name: str  # stream name, an identifier
    time: Time
    content: pa.Table | Batched  # all rows, or only the first rows in a preview
    rows: int | None = None  # number of rows, if known in a preview
    arrivals: str = ""  # column with the arrival times of the rows, empty if there is none
    dropped: Mapping[str, int] = field(default_factory=dict)  # rows of the file that the content lacks, by reason

    @property
    def schema(self) -> pa.Schema:
        """The schema of the rows."""
        return self.content.schema

    @property
    def table(self) -> pa.Table:
        """All rows as one table in memory."""
        import pyarrow as pa

        if not isinstance(self.content, Batched):
            return self.content
        return pa.concat_tables([self.schema.empty_table(), *self.content.read()])

    def blocks(self) -> Iterator[pa.Table]:
        """Yield all rows, in batches if the content is `Batched`."""
        if isinstance(self.content, Batched):
            yield from self.content.read()
        else:
            yield self.content


@dataclass(frozen=True)
class EpisodeContents:
    """The streams and attributes of one episode of a container."""

    streams: Sequence[SourceStream]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)  # attributes of the recording stored in the file
    skipped: Mapping[str, str] = field(default_factory=dict)  # reason for each unreadable source
    notes: Sequence[str] = ()  # sentences about missing parts, for example of a truncated file


@dataclass(frozen=True)
class Share:
    """The files and values that an episode, and its key, depend on."""

    files: Mapping[str, Path]  # files by path in the container
    values: Values = field(default_factory=dict)  # further JSON values that the episode depends on


class Container(Protocol):
    """An open container. Its methods raise `TacpipeError` with the file's name if the file is invalid."""

    path: Path

    @property
    def names_itself(self) -> bool:
        """Whether episode names are used without the container's name as prefix, as those from before an export."""
        return False

    def episodes(self) -> Sequence[str]:
        """Return the names of the recordings in the container, or an empty sequence if it is one recording."""
        return ()

    def look(self, episode: str | None) -> EpisodeContents:
        """Return a preview: tables have all fields, and no rows or the first few."""
        return self.read(None, episode)

    def read(self, sources: Collection[str] | None, episode: str | None) -> EpisodeContents:
        """Return the streams of these sources, or all if None, in one pass. Missing sources are ignored."""

    def share(self, sources: Collection[str] | None, episode: str | None) -> Share | None:
        """Return the files that these streams of an episode are read from, or None if it is all files of the container.

        Then a changed file affects only the episodes that use it.
        """
        return None


@dataclass(frozen=True)
class Kind:
    """A kind of containers: files with certain suffixes, folders with certain files, or both."""

    opener: str  # ``module:function``, imported when a file is opened because it may need an extra
    endings: tuple[str, ...] = ()  # file suffixes in lower case
    marks: tuple[str, ...] = ()  # a folder with one of these files is a container
    marked: bytes = b""  # bytes that occur in the first 4 KiB of such a file


KINDS: Mapping[str, Kind] = {
    "mcap": Kind("tacpipe.formats.bags.container:open_bag", (".mcap",)),
    "rosbag": Kind(
        "tacpipe.formats.bags.container:open_bag",
        (".bag", ".bag.active", ".db3", ".mcap", ".db3.zstd", ".mcap.zstd"),
        ("metadata.yaml",),
        b"rosbag2_bagfile_information",
    ),
    "hdf5": Kind("tacpipe.formats.arrays.container:open_hdf5", (".hdf5", ".h5")),
    "zarr": Kind(
        "tacpipe.formats.arrays.container:open_zarr",
        (".zarr.zip", ".zarr"),
        (".zgroup", ".zarray", "zarr.json"),
    ),
    "xdf": Kind("tacpipe.formats.xdf_streams:XdfFile", (".xdf", ".xdfz", ".xdf.gz")),
    "lerobot": Kind("tacpipe.formats.lerobot.container:LeRobotContainer", (), ("meta/info.json",)),
}


def open_container(kind: str, path: Path) -> Container:
    """Return the container at ``path``."""
    module, _, function = KINDS[kind].opener.partition(":")
    return cast(Container, getattr(importlib.import_module(module), function)(path))


def is_container(kind: str, path: Path) -> bool:
    """Return whether a path looks like a container of this kind."""
    if path.is_dir():
        return any(_has_mark(path / mark, KINDS[kind].marked) for mark in KINDS[kind].marks)
    return path.name.lower().endswith(KINDS[kind].endings)


def has_ending(kind: str, name: str) -> bool:
    """Return whether a file name has a suffix of this kind."""
    return bool(KINDS[kind].endings) and name.lower().endswith(KINDS[kind].endings)


def _has_mark(path: Path, content: bytes) -> bool:
    if not content or not path.is_file():
        return path.is_file()
    with regular.failing(path), regular.opened(path) as file:
        return content in file.read(4096)


def find_containers(kind: str, source: Path) -> list[Path]:
    """Return the containers of this kind at or below ``source``, sorted. Containers inside a container are not listed."""
    paths = [source] if not source.is_dir() and is_container(kind, source) else []
    for folder, folders, names in file_system.walk(source) if source.is_dir() else ():
        if is_container(kind, Path(folder)):
            paths.append(Path(folder))
            folders.clear()
            continue
        paths += [Path(folder, name) for name in names if name.lower().endswith(KINDS[kind].endings)]
    return sorted(paths)


def describe_kind(kind: str) -> str:
    """Return a phrase for error messages about how containers of this kind are recognized."""
    container_kind = KINDS[kind]
    files = (
        [f"files named {', '.join(f'*{ending}' for ending in container_kind.endings)}"]
        if container_kind.endings
        else []
    )
    folders = [f"folders with {' or '.join(container_kind.marks)}"] if container_kind.marks else []
    return " or ".join([*files, *folders])


def no_container_error(kind: str, source: Path) -> UsageError:
    """Return the error for a source without a container of this kind."""
    if not source.exists():
        return UsageError(f"There is no {source} to read recordings from.")
    verb = "holds no" if source.is_dir() else "is not a"
    return UsageError(f"{source} {verb} recording for ingest {kind}, which reads {describe_kind(kind)}.")


def container_files(path: Path) -> dict[str, Path]:
    """Return the files of a container by path in its folder; a single file has the key ""."""
    if not path.is_dir():
        return {"": path}
    return {
        Path(folder, name).relative_to(path).as_posix(): Path(folder, name)
        for folder, _, names in file_system.walk(path)
        for name in sorted(names)
    }


def container_names(paths: Sequence[Path], source: Path) -> dict[Path, str]:
    """Return a unique name for each container: its file name without suffix, preceded by parent folders if needed."""
    stems = {path: _name_stem(path) for path in paths}
    shared = [stem.casefold() for stem in stems.values()]
    return {
        path: stem if shared.count(stem.casefold()) == 1 else "-".join([*path.relative_to(source).parts[:-1], stem])
        for path, stem in stems.items()
    }


def _name_stem(path: Path) -> str:
    """Return a container's file name without the suffix of its kind."""
    ending = max(
        (ending for kind in KINDS.values() for ending in kind.endings if path.name.lower().endswith(ending)),
        key=len,
        default="",
    )
    return path.resolve().name.removesuffix(ending) if path.is_dir() else path.name[: len(path.name) - len(ending)]


def natural_order(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts names with numbers by value.

    >>> sorted(["demo_10", "demo_9", "demo"], key=natural_order)
    ['demo', 'demo_9', 'demo_10']
    """
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.findall(r"\d+|\D+", text)]


def identifiers(sources: Sequence[str]) -> dict[str, str]:
    """Return a unique stream name for each source: an identifier that is unique regardless of case.

    >>> identifiers(["/left/skin", "/joint_states", "left.skin", "3d"])
    {'/left/skin': 'left_skin', '/joint_states': 'joint_states', 'left.skin': 'left_skin_2', '3d': 'stream_3d'}
    """
    names: dict[str, str] = {}
    used: set[str] = set()
    for source in sources:
        spaced = "".join(
            letter if letter.isascii() and (letter.isalnum() or letter == "_") else " " for letter in source
        )
        name = "_".join(spaced.split()).strip("_") or "stream"
        name = f"stream_{name}" if name[0].isdigit() else name
        number = 2
        candidate = name
        while candidate.casefold() in used:
            candidate, number = f"{name}_{number}", number + 1
        used.add(candidate.casefold())
        names[source] = candidate
    return names


Part = TypeVar("Part")


def parts_by_name(parts: Iterable[tuple[str, Part]], path: Path, kind: str) -> dict[str, Part]:
    """Return parts by name. Raises `UsageError` with the file's name if two parts of a ``kind`` share a name.

    >>> parts_by_name([("a", 1), ("b", 2)], Path("x.npz"), "column")
    {'a': 1, 'b': 2}
    """
    parts_by_name: dict[str, Part] = {}
    for name, part in parts:
        if name in parts_by_name:
            raise UsageError(
                f"{path} has more than one {kind} {plain(name)}. Only one of them can be kept. Rename or remove the "
                f"others."
            )
        parts_by_name[name] = part
    return parts_by_name


def json_value(text: str | bytes, path: Path) -> Any:
    """Return the JSON value in a file. Raises `ValueError` or `RecursionError` if it is invalid."""
    return json.loads(text, object_pairs_hook=lambda pairs: parts_by_name(pairs, path, "entry"))


def json_object(text: str | bytes) -> Values:
    """Return the JSON object in a text, or an empty object if it is none.

    >>> json_object('{"a": 1}'), json_object("[1]"), json_object("")
    ({'a': 1}, {}, {})
    """
    try:
        value = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def plain_values(values: Mapping[Any, Any]) -> dict[str, Attribute]:
    """Return the values that are text, numbers, true, false or None, as the attributes in an export of tacpipe."""
    is_plain = str | int | float | bool | None
    return {str(name): value for name, value in values.items() if isinstance(value, is_plain)}


def flatten(values: Mapping[Any, Any], before: str = "", max_depth: int | None = None) -> dict[str, Any]:
    """Return nested mappings, up to ``max_depth`` levels, as one mapping with dotted names.

    >>> flatten({"sensor": {"name": "mine", "size": {"x": 1}}, "fps": 20}, max_depth=1)
    {'sensor.name': 'mine', 'sensor.size': {'x': 1}, 'fps': 20}
    """
    flat: dict[str, Any] = {}
    for name, value in values.items():
        is_nested = isinstance(value, dict) and (max_depth is None or before.count(".") < max_depth)
        flat |= flatten(value, f"{before}{name}.", max_depth) if is_nested else {f"{before}{name}": value}
    return flat


EXAMPLES = 3  # number of example paths per group
Reason = Callable[[str], str]  # maps a path in the source to the reason why it is not read, or ""


def describe_unread(
    source: Path, read_files: Collection[Path], reason: Reason, output: Path | None = None
) -> list[str]:
    """Return one sentence per suffix and reason for the files below ``source`` that are not in ``read_files``.

    Hidden files and the folder ``output``, to which the command writes, are ignored.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    read_paths = {os.fspath(path) for path in read_files}
    for path in _visible(source, output):
        if path in read_paths:
            continue
        path_within = os.path.relpath(path, source)
        problem = reason(path_within)
        if problem:
            extension = os.path.splitext(path_within)[1].lower()  # noqa: PTH122  (once per file, on every hit)
            groups.setdefault((extension, problem), []).append(path_within)
    return [
        f"{len(paths)} {extension or 'extensionless'} file{'s' * (len(paths) != 1)} below {source} "
        f"{'are' if len(paths) > 1 else 'is'} not read ({listed(paths, EXAMPLES)}): {problem}."
        for (extension, problem), paths in sorted(groups.items())
    ]


def _visible(source: Path, output: Path | None) -> Iterator[str]:
    """Yield the path of each visible file below a folder, except those in ``output``."""
    output_path = os.path.realpath(output) if output is not None else None
    for folder, folders, names in file_system.walk(source) if source.is_dir() else ():
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".") and (output_path is None or os.path.realpath(f"{folder}/{name}") != output_path)
        ]
        yield from (os.fspath(Path(folder, name)) for name in names if not name.startswith("."))
