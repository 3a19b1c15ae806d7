"""Recognise and open containers: files with several streams and their own description, as a bag, an HDF5 or an XDF file.

A container is read by a `tacpipe.formats.container.Container`, which a format implements: its episodes, what a
look at it shows, and the streams of one episode read in one pass. Each stream comes as a `SourceStream`: its name inside the
file (``source``), a name for the stream, where its stamps are (`Time`), and rows whose fields have type, quantity, unit
and layout in their metadata: a table, or `Batched`, of which memory holds some at a time. What cannot be read is named with
a reason in `Contents.skipped`, what is missing of a damaged file in `Contents.notes`, and what the file states of itself
becomes `Contents.attributes`.

The layout file of ``ingest table`` is applied to that: a stream of a layout names the container's with ``source``; rules of
``columns`` and ``time`` replace what the file declares, and are left out where it is right. A new format is

1. a module with ``opened(path) -> Container``, which imports its library inside functions;
2. an entry in `tacpipe.formats.container.KINDS`, and its name in `Format` of ``tacpipe/formats/table/layout.py``;
3. a stage, made by `tacpipe.formats.table.contained.ContainerCommand`, with an entry point ``tacpipe.formats``.
"""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar, cast, runtime_checkable

from tacpipe.errors import UsageError
from tacpipe.io import files as file_system
from tacpipe.io import regular
from tacpipe.plugins.constraints import Rate
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import pyarrow as pa

TimeUnit = Literal["s", "ms", "us", "ns", "iso8601"]


@dataclass(frozen=True)
class Time:
    """The origin of the stamps of a stream: a column, a file next to the stream's own, or a rate."""

    column: str = ""
    unit: TimeUnit = "s"
    rate_hz: Rate | None = None
    origin: Literal["unix", "start"] = "unix"  # zero of numbers: 1970, or the start of the recording
    zone: str = "UTC"  # time zone of ISO 8601 stamps that name none, as Europe/Berlin
    start: str = ""  # UTC, ISO 8601: the first stamp of recordings that count from their start, the day of times of day
    file: str = ""  # pattern of a file that holds the stamps of all rows, one after another
    format: str = ""  # strptime format of text stamps, as %d.%m.%Y %H:%M:%S.%f; without %Y the time of day

    @property
    def is_text(self) -> bool:
        """Return whether stamps are text."""
        return bool(self.format) or self.unit == "iso8601"

    @property
    def is_declared(self) -> bool:
        """True if a column, a file or a rate is named."""
        return bool(self.column or self.file) or self.rate_hz is not None


@dataclass(frozen=True)
class Batched:
    """Rows that memory need not hold: ``read`` yields them as tables of the schema, from the first each time."""

    schema: pa.Schema
    rows: int
    read: Callable[[], Iterator[pa.Table]]

    def mapped(self, schema: pa.Schema, change: Callable[[pa.Table], pa.Table]) -> Batched:
        """Return the same rows with each table changed to one of ``schema``."""
        return Batched(schema, self.rows, lambda: map(change, self.read()))


@dataclass(frozen=True)
class SourceStream:
    """A stream inside a container.

    Columns of the rows are 1-D and of the types that a layout has (``tacpipe.formats.table.columns.TYPES``); those of one
    array are a column each. Metadata of the fields are ``quantity``, ``unit``, ``component``, and what places a channel in
    its sensor: ``taxel``, ``axis``, ``joint``, …. Metadata of the field with the stamps goes to ``t_ns``.
    """

    source: str  # its name inside the file: a topic, a group, a dataset
    name: str  # name of the stream, an identifier
    time: Time
    content: pa.Table | Batched  # all rows, or the first few where it was looked at
    rows: int | None = None  # how many there are, where a look shows it

    @property
    def schema(self) -> pa.Schema:
        """The columns."""
        return self.content.schema

    @property
    def table(self) -> pa.Table:
        """The rows as one table, in memory."""
        import pyarrow as pa

        if not isinstance(self.content, Batched):
            return self.content
        return pa.concat_tables([self.schema.empty_table(), *self.content.read()])

    def blocks(self) -> Iterator[pa.Table]:
        """Yield the rows, some at a time where memory need not hold all."""
        if isinstance(self.content, Batched):
            yield from self.content.read()
        else:
            yield self.content


@dataclass(frozen=True)
class EpisodeContents:
    """The streams and attributes of one episode of a container."""

    streams: Sequence[SourceStream]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)  # attributes of the recording in the file
    skipped: Mapping[str, str] = field(default_factory=dict)  # reasons by source that cannot be read
    notes: Sequence[str] = ()  # sentences about what is missing, as of a file that was cut off


@dataclass(frozen=True)
class Share:
    """The files and values that one episode of a container, and its key, depend on."""

    files: Mapping[str, Path]  # files by their path within the container
    values: Mapping[str, Any] = field(default_factory=dict)  # further JSON values that it depends on


@runtime_checkable
class Sharing(Protocol):
    """A container in which a changed file costs only the episodes that are read from it."""

    def share(self, sources: Collection[str] | None, episode: str | None) -> Share | None:
        """Return what these streams of an episode, or all, are read from; None: all files of the container."""


@runtime_checkable
class NamedContainer(Protocol):
    """A container that may hold recordings which have had their names before, in a dataset that it was exported from."""

    @property
    def names_itself(self) -> bool:
        """True if its episodes are named without the container's name before theirs."""


class Container(Protocol):
    """An open container. Its methods raise `TacpipeError`, naming the file, for what is not of its format."""

    @property
    def path(self) -> Path:
        """The file, or the folder where the format is one."""

    def episodes(self) -> Sequence[str]:
        """Return the names of the recordings inside, or nothing if the whole is one recording."""

    def look(self, episode: str | None) -> EpisodeContents:
        """Return what is there without reading all of it: tables have the right fields, and no or the first rows."""

    def read(self, sources: Collection[str] | None, episode: str | None) -> EpisodeContents:
        """Return the streams of these sources, or all, in one pass; a source that is not there is left out."""


@dataclass(frozen=True)
class Kind:
    """A format of containers: files with an ending, folders with a mark, or both."""

    opener: str  # module:function, imported when a file is opened, as it may need an extra
    endings: tuple[str, ...] = ()  # endings of files, in lower case
    marks: tuple[str, ...] = ()  # a folder that holds one of these files is one container
    marked: bytes = b""  # content of the first 4 KiB of such a file


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
    "lerobot": Kind("tacpipe.formats.lerobot.container:open_lerobot", (), ("meta/info.json",)),
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
    """Return whether a file's name ends as those of containers of this kind do."""
    return bool(KINDS[kind].endings) and name.lower().endswith(KINDS[kind].endings)


def _has_mark(path: Path, content: bytes) -> bool:
    if not content or not path.is_file():
        return path.is_file()
    with regular.failing(path), regular.opened(path) as file:
        return content in file.read(4096)


def find_containers(kind: str, source: Path) -> list[Path]:
    """Return the containers of this kind at or below ``source``, sorted; what lies within one is part of it."""
    paths = [source] if not source.is_dir() and is_container(kind, source) else []
    for place, folders, names in file_system.walk(source) if source.is_dir() else ():
        if is_container(kind, Path(place)):
            paths.append(Path(place))
            folders.clear()
            continue
        paths += [Path(place, name) for name in names if name.lower().endswith(KINDS[kind].endings)]
    return sorted(paths)


def describe_kind(kind: str) -> str:
    """Return how containers of this kind are recognised, for errors."""
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
    """Return the files of a container: "" and its path, or of a folder each file by its path within."""
    if not path.is_dir():
        return {"": path}
    return {
        Path(place, name).relative_to(path).as_posix(): Path(place, name)
        for place, _, names in file_system.walk(path)
        for name in sorted(names)
    }


def container_names(paths: Sequence[Path], source: Path) -> dict[Path, str]:
    """Return a name for each container: that of its file without the ending, with folders above where two share one."""
    stems = {path: _name_stem(path) for path in paths}
    shared = [stem.casefold() for stem in stems.values()]
    return {
        path: stem if shared.count(stem.casefold()) == 1 else "-".join([*path.relative_to(source).parts[:-1], stem])
        for path, stem in stems.items()
    }


def _name_stem(path: Path) -> str:
    ending = max(
        (ending for kind in KINDS.values() for ending in kind.endings if path.name.lower().endswith(ending)),
        key=len,
        default="",
    )
    return path.resolve().name.removesuffix(ending) if path.is_dir() else path.name[: len(path.name) - len(ending)]


def identifiers(sources: Sequence[str]) -> dict[str, str]:
    """Return a stream's name for each source: an identifier, no two alike but for case.

    >>> identifiers(["/left/skin", "/joint_states", "left.skin", "3d"])
    {'/left/skin': 'left_skin', '/joint_states': 'joint_states', 'left.skin': 'left_skin_2', '3d': 'stream_3d'}
    """
    names: dict[str, str] = {}
    used: set[str] = set()
    for source in sources:
        letters = "".join(
            letter if letter.isascii() and (letter.isalnum() or letter == "_") else " " for letter in source
        )
        name = "_".join(letters.split()).strip("_") or "stream"
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
    """Return parts by their names. Raises `UsageError`, naming the file, where two of a ``kind`` have the same name.

    >>> parts_by_name([("a", 1), ("b", 2)], Path("x.npz"), "column")
    {'a': 1, 'b': 2}
    """
    parts_by_name: dict[str, Part] = {}
    for name, part in parts:
        if name in parts_by_name:
            raise UsageError(
                f"{path} has more than one {kind} {plain(name)}. Only one of them could be kept: rename the others, or take "
                f"them away."
            )
        parts_by_name[name] = part
    return parts_by_name


def json_value(text: str | bytes, path: Path) -> Any:
    """Return a JSON value of a file. Raises `ValueError` or `RecursionError` if it is none, and as `by_name`."""
    return json.loads(text, object_pairs_hook=lambda pairs: parts_by_name(pairs, path, "entry"))


EXAMPLES = 3  # paths named per group
Reason = Callable[[str], str]  # maps a path within the source to the reason why it is not read, "" if it is


def describe_unread(source: Path, read: Collection[Path], reason: Reason, output: Path | None = None) -> list[str]:
    """Return one sentence per extension and reason for the files below ``source`` that are not in ``read``.

    Hidden files and folders are passed over, and so is the folder ``output``, to which the command writes.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    read_paths = {os.fspath(path) for path in read}
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
    """Yield the path of each file below a folder."""
    output_path = os.path.realpath(output) if output is not None else None
    for place, folders, names in file_system.walk(source) if source.is_dir() else ():
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".") and (output_path is None or os.path.realpath(f"{place}/{name}") != output_path)
        ]
        yield from (os.fspath(Path(place, name)) for name in names if not name.startswith("."))
