"""What a container of streams gives: its episodes, and the streams of one, as the file itself declares them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

from tacpipe.plugins.constraints import Rate
from tacpipe.plugins.stage import Attribute

if TYPE_CHECKING:
    import pyarrow as pa

TimeUnit = Literal["s", "ms", "us", "ns", "iso8601"]


@dataclass(frozen=True)
class Time:
    """Where the stamps of a stream come from: a column, or a rate."""

    column: str = ""
    unit: TimeUnit = "s"
    rate_hz: Rate | None = None
    origin: Literal["unix", "start"] = "unix"  # what a number counts from: 1970, or the start of the recording
    zone: str = "UTC"  # of ISO 8601 stamps that name none, as Europe/Berlin
    start: str = ""  # UTC, ISO 8601: the first stamp of recordings that count from their start

    @property
    def given(self) -> bool:
        """Whether it states where stamps come from."""
        return bool(self.column) or self.rate_hz is not None


@dataclass(frozen=True)
class SourceStream:
    """A stream inside a container.

    Columns of the table are 1-D and of the types that a layout has (``tacpipe.formats.table.columns.TYPES``); those of one
    array are a column each. Metadata of the fields are ``quantity``, ``unit``, ``component``, and what places a channel in
    its sensor: ``taxel``, ``axis``, ``joint``, …. Metadata of the field with the stamps goes to ``t_ns``.
    """

    source: str  # its name inside the file: a topic, a group, a dataset
    name: str  # of the stream: an identifier
    time: Time
    table: pa.Table  # all rows, or the first few where it was looked at
    rows: int | None = None  # how many there are, where a look shows it


@dataclass(frozen=True)
class Contents:
    """What a container holds of one episode."""

    streams: Sequence[SourceStream]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)  # of the recording, as the file states them
    skipped: Mapping[str, str] = field(default_factory=dict)  # what cannot be read, by source: the reason
    notes: Sequence[str] = ()  # sentences about what is missing, as of a file that was cut off


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
