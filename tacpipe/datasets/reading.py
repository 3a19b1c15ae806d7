"""Define what functions that read an open dataset need of it and of its recordings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from tacpipe.datasets.manifest import Manifest
from tacpipe.plugins.stage import Attribute

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.columns import Columns


class ReadableRecording(Protocol):
    """A recording with its attributes and tables, which is a `tacpipe.datasets.dataset.Recording`."""

    name: str
    attributes: Mapping[str, Attribute]

    @property
    def streams(self) -> tuple[str, ...]:
        """The names of the recording's streams; ``("",)`` if it is a single table."""
        ...

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        """Return a stream as an arrow table."""
        ...

    def columns(self, stream: str = "") -> Columns:
        """Return a stream whose columns are decoded on demand."""
        ...


class ReadableDataset(Protocol):
    """Recordings by name, with the manifest that lists them, which are a `tacpipe.datasets.dataset.Dataset`."""

    source: Manifest
    path: Path | None

    @property
    def recordings(self) -> Mapping[str, ReadableRecording]:
        """The recordings by name."""
        ...

    @property
    def digest(self) -> str:
        """The dataset's digest."""
        ...

    def __iter__(self) -> Iterator[ReadableRecording]:
        """Yield the recordings in the order of their names."""
        ...

    def __getitem__(self, name: str) -> ReadableRecording:
        """Return the recording with this name."""
        ...

    def __len__(self) -> int:
        """Return the number of recordings."""
        ...
