"""The interface of containers: episodes, and the streams of one as the file itself declares them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

from tacpipe.plugins.constraints import Rate
from tacpipe.plugins.stage import Attribute

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
        """True where a column, a file or a rate is named."""
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
class Contents:
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
class Naming(Protocol):
    """A container that may hold recordings which have had their names before, in a dataset that it was exported from."""

    @property
    def names_itself(self) -> bool:
        """True where its episodes are named without the container's name before theirs."""


class Container(Protocol):
    """An open container. Its methods raise `TacpipeError`, naming the file, for what is not of its format."""

    @property
    def path(self) -> Path:
        """The file, or the folder where the format is one."""

    def episodes(self) -> Sequence[str]:
        """Return the names of the recordings inside, nothing where the whole is one recording."""

    def look(self, episode: str | None) -> Contents:
        """Return what is there without reading all of it: tables have the right fields, and no or the first rows."""

    def read(self, sources: Collection[str] | None, episode: str | None) -> Contents:
        """Return the streams of these sources, or all, in one pass; a source that is not there is left out."""
