"""A dataset opened for reading: shards and files by name, their bytes verified when asked for."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from tacpipe.datasets.manifest import Manifest, shard_path
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io.hashing import digest
from tacpipe.plugins import extras
from tacpipe.plugins.stage import Attribute

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

    from tacpipe.datasets.arrays import Arrays, Tensors
    from tacpipe.io.columns import Columns

Reader = Callable[[str, str], bytes]  # digest, path within the dataset directory -> verified content


class Recording:
    """One recording of a dataset: its attributes, and its tables when asked for."""

    def __init__(self, name: str, entry: Mapping[str, Any], read: Reader, manifest: Manifest | None = None) -> None:
        self.name = name
        self.attributes: Mapping[str, Attribute] = MappingProxyType(dict(entry["attributes"]))
        self._shards = entry["shards"]
        self._read = read
        self._manifest = manifest

    @property
    def streams(self) -> tuple[str, ...]:
        """The names of the recording's streams; ``("",)`` where one table holds all."""
        return tuple(sorted(self._shards))

    @property
    def digests(self) -> dict[str, str]:
        """The digest of each stream."""
        return {stream: shard["digest"] for stream, shard in self._shards.items()}

    @property
    def digest(self) -> str:
        """The digest of the recording's only stream, or of all of them."""
        digests = self.digests
        return digests[""] if set(digests) == {""} else digest(digests)

    @property
    def alone(self) -> Dataset:
        """The dataset that it was opened from, with this recording alone.

        Raises `UsageError` for one that a stage was given: what it is part of is unknown there.
        """
        if self._manifest is None:
            raise UsageError(
                f"Recording {self.name} is not of an opened dataset; take it from one: tacpipe.open(PATH)[{self.name!r}]."
            )
        return Dataset(self._manifest, self._read, [self.name])

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        """Return a stream as an arrow table with field metadata; its bytes are verified first."""
        from tacpipe.io.parquet import from_parquet

        return from_parquet(self._content(stream), columns)

    def columns(self, stream: str = "") -> Columns:
        """Return a stream whose columns are decoded when asked for, some at a time; its bytes are verified first.

        It reads like an arrow table (``schema``, ``num_rows``, ``column_names``, ``column(name)``), and of a long
        recording it takes a fraction of the memory.
        """
        from tacpipe.io.columns import Columns

        return Columns(self._content(stream))

    def _content(self, stream: str) -> bytes:
        if stream not in self._shards:
            raise UsageError(
                f"Recording {self.name} has no stream {stream!r}; it has {', '.join(map(repr, self.streams))}."
            )
        return self._read(self._shards[stream]["digest"], shard_path(self.name, stream))


class LazyFiles(Mapping[str, bytes]):
    """The files of a dataset by name; their content is read and verified when asked for."""

    def __init__(self, files: Mapping[str, Any], read: Reader) -> None:
        self._files, self._read = files, read

    def __getitem__(self, name: str) -> bytes:
        return self._read(self._files[name]["digest"], name)

    def __iter__(self) -> Any:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


class Dataset:
    """A dataset opened for reading: recordings by name, files by name."""

    def __init__(self, manifest: Manifest, read: Reader, names: Iterable[str] | None = None) -> None:
        included = manifest.included
        chosen = sorted(included if names is None else names)
        self.source = manifest
        self.recordings: dict[str, Recording] = {
            name: Recording(name, included[name], read, manifest) for name in chosen
        }
        self.files: Mapping[str, bytes] = LazyFiles(manifest.files, read)

    @property
    def manifest(self) -> dict[str, Any]:
        """The manifest as plain values."""
        value: dict[str, Any] = json.loads(self.source.content)
        return value

    @property
    def digest(self) -> str:
        """The dataset's digest."""
        return self.source.digest

    def table(self, stream: str | None = None, columns: Sequence[str] | None = None) -> pa.Table:
        """Return all recordings in one arrow table, after a first column ``recording`` (but where it has one already).

        ``stream`` may be left out where the recordings have one table each.
        """
        from tacpipe.io.parquet import one_after_another

        name = self._only_stream() if stream is None else stream
        if not self.recordings:
            raise TacpipeError("This dataset has no recordings to read; `tacpipe show` lists what it holds.")
        return one_after_another({shard.name: shard.table(name, columns) for shard in self.recordings.values()})

    def to_pandas(self, stream: str | None = None, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """Return all recordings in one frame, after a categorical column ``recording``.

        Integers with nulls, as where only some recordings have the column, are pandas' nullable integers: a column of
        floats would round those beyond 2^53.
        """
        import pandas as pd
        import pyarrow as pa

        table = self.table(stream, columns)
        frame: pd.DataFrame = table.to_pandas()
        for field, column in zip(table.schema, table.columns, strict=True):
            if pa.types.is_integer(field.type) and column.null_count:
                nullable = pd.api.types.pandas_dtype(str(field.type).replace("u", "U").replace("i", "I"))
                frame[field.name] = column.to_pandas(types_mapper={field.type: nullable}.get)
        return frame

    def to_numpy(self, stream: str | None = None, columns: Sequence[str] | None = None) -> dict[str, Arrays]:
        """Return the arrays of each recording by its name: ``values`` (time, channel), ``columns``, ``t_ns`` (time,).

        ``columns`` chooses what is read and in which order. Clocks, counters, masks and labels are never mixed with the
        channels: ``arrays["contact"]`` is any column (time,) in its own type. See `tacpipe.datasets.arrays.Arrays`.
        """
        from tacpipe.datasets import arrays

        name = self._only_stream() if stream is None else stream
        order = columns and [*dict.fromkeys(columns)]
        return {
            shard.name: arrays.of_table(table if order is None else table.select(order))
            for shard in self.recordings.values()
            for table in [shard.table(name, order)]
        }

    def to_torch(self, stream: str | None = None, columns: Sequence[str] | None = None) -> dict[str, Tensors]:
        """Return the tensors of each recording by its name: ``values`` (time, channel), ``columns``, ``t_ns`` (time,).

        As `to_numpy`, with the same types; torch computes little in uint16, so ``values.float()`` comes first there.
        """
        from tacpipe.datasets import arrays

        with extras.named("to_torch"):
            return {name: arrays.to_tensors(found) for name, found in self.to_numpy(stream, columns).items()}

    def _only_stream(self) -> str:
        streams = {stream for shard in self.recordings.values() for stream in shard.streams}
        if len(streams) > 1:
            raise UsageError(f"Name the stream to read: the recordings have {', '.join(sorted(streams))}.")
        return next(iter(streams), "")


Model = Dataset  # whose files hold weights and configuration
Datasets = tuple[Dataset, ...]
