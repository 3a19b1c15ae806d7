"""Open datasets for reading: recordings and files by name, verified when they are read."""

from __future__ import annotations

import functools
import json
import operator
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, overload
from weakref import WeakValueDictionary

from tacpipe.datasets import guesses, pages, selection
from tacpipe.datasets.manifest import Manifest, ManifestJson
from tacpipe.datasets.paths import shard_path
from tacpipe.datasets.selection import Wanted
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io.hashing import digest
from tacpipe.plugins import extras
from tacpipe.plugins.rows import note_opened
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, suggestion
from tacpipe.store.records import Content, RecordingEntry

if TYPE_CHECKING:
    import duckdb
    import pandas as pd
    import polars as pl
    import pyarrow as pa

    from tacpipe.datasets.arrays import Arrays, Tensors
    from tacpipe.datasets.lineage import CountedRows
    from tacpipe.datasets.window_images import Transform
    from tacpipe.datasets.windows import Windows
    from tacpipe.io.columns import Columns

Reader = Callable[[str, str], bytes]  # (digest, path in the dataset's directory) -> verified content
LARGE_BYTES = 1 << 24  # minimum size of a shard that is read from its file instead of memory
_NAMED = 5  # number of recordings named in an error


class Recording:
    """One recording of a dataset: its attributes, and its tables, which are read on demand."""

    def __init__(self, name: str, entry: RecordingEntry, read: Reader, dataset: Dataset | None = None) -> None:
        """Open a recording of a manifest; ``read`` returns the verified content of its shards.

        ``dataset`` is the dataset that it belongs to, None for the input of a stage.
        """
        self.name = name
        self.attributes: Mapping[str, Attribute] = MappingProxyType(dict(entry["attributes"]))
        self._entry = entry
        self._shards = entry["shards"]
        self._read = read
        self._dataset = dataset
        self._opened: WeakValueDictionary[str, Columns] = WeakValueDictionary()

    def __repr__(self) -> str:
        streams = ", ".join(filter(None, self.streams))
        return f"Recording({self.name!r}{', streams ' * bool(streams)}{streams})"

    def _repr_html_(self) -> str:
        from tacpipe.datasets import overview

        return overview.recording_html(self)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            streams = dict.fromkeys(self.__dict__.get("_shards", ()), f"recording[{name!r}] is the stream")
            raise guesses.missing("A recording", name, {**guesses.RECORDING, **streams})

    def __getitem__(self, stream: str) -> pd.DataFrame:
        """Return a stream as `to_pandas` does."""
        return self.to_pandas(stream)

    def __reduce__(self) -> tuple[Any, ...]:
        if self._dataset is None:
            return Recording, (self.name, self._entry, self._read)
        return operator.getitem, (self._dataset, self.name)

    @property
    def streams(self) -> tuple[str, ...]:
        """The names of the recording's streams; ``("",)`` if it is a single table."""
        return tuple(sorted(self._shards))

    @property
    def digests(self) -> dict[str, str]:
        """The digest of each stream."""
        return {stream: shard["digest"] for stream, shard in self._shards.items()}

    @property
    def sizes(self) -> dict[str, int]:
        """The stored size of each stream in bytes."""
        return {stream: shard["bytes"] for stream, shard in self._shards.items()}

    @property
    def rows(self) -> dict[str, int]:
        """The number of rows of each stream."""
        return {stream: shard["rows"] for stream, shard in self._shards.items()}

    @property
    def digest(self) -> str:
        """The digest of the recording's only stream, or of all of them."""
        digests = self.digests
        return digests[""] if set(digests) == {""} else digest(digests)

    @property
    def alone(self) -> Dataset:
        """The recording's dataset, reduced to this recording.

        Raises `UsageError` for a recording passed to a stage, where its dataset is unknown.
        """
        if self._dataset is None:
            raise UsageError(
                f"Recording {self.name} is not of an opened dataset; take it from one: tacpipe.open(PATH)[{self.name!r}]."
            )
        return self._dataset.only([self.name])

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        """Return a stream as an arrow table with field metadata, after verifying its bytes.

        A synchronized recording is one table with the columns of all streams. There, ``stream`` selects ``t_ns`` and
        the columns of that stream under their recorded names, without masks and ground truth. Without ``stream`` the
        table is returned as stored. ``columns`` are the columns to read, None for all. Raises `UsageError` if the
        stream does not exist, and `DamagedError` if it is damaged.
        """
        from tacpipe.io.parquet import from_parquet

        if stream in self._shards:
            table = from_parquet(self._content(stream), columns)
            note_opened(self.name, stream, table.num_rows)
            return table
        from tacpipe.datasets.overview import stored_columns

        stored = self.columns() if self.streams == ("",) else None
        names_by_stream = {} if stored is None else stored_columns(stored.schema)
        if stored is None or stream not in names_by_stream:
            raise self._missing_stream_error(stream, [name for name in names_by_stream if name])
        names = names_by_stream[stream]
        if columns is not None:
            names = {name: names[name] for name in columns}
        return stored.read(list(names.values())).rename_columns(list(names))

    def to_pandas(self, stream: str = "", columns: Sequence[str] | None = None) -> pd.DataFrame:
        """Return a stream as a frame, with the columns' units in ``attrs["units"]``. Arguments are those of `table`."""
        from tacpipe.datasets import arrays

        return arrays.to_pandas(self.table(stream, columns))

    def columns(self, stream: str = "") -> Columns:
        """Return a stream whose columns are decoded on demand, after verifying its bytes.

        It has the interface of an arrow table (``schema``, ``num_rows``, ``column_names``, ``column(name)``) and needs
        a fraction of the memory for a long recording. While the result is in use, further calls return the same object.
        """
        from tacpipe.io.columns import Columns

        columns = self._opened.get(stream)
        if columns is None:
            columns = self._opened[stream] = Columns(self._content(stream))
            note_opened(self.name, stream, columns.num_rows)
        return columns

    def _content(self, stream: str) -> bytes | Path:
        """Return the verified bytes of a stream, or the path of a large one in the store, which need not fit in memory.

        Raises `UsageError` if the stream does not exist.
        """
        if stream not in self._shards:
            raise self._missing_stream_error(stream, [])
        name, path = self._shards[stream]["digest"], shard_path(self.name, stream)
        large_file = getattr(self._read, "large_file", None)
        file: Path | None = large_file and large_file(name, path, LARGE_BYTES)
        return file or self._read(name, path)

    def _missing_stream_error(self, stream: str, columns_of_streams: Sequence[str]) -> UsageError:
        """Return the error for a missing stream; ``columns_of_streams`` are the streams in a synchronized table."""
        if self.streams == ("",) and not columns_of_streams:
            return UsageError(f"Recording {self.name} has no stream {stream!r}; it is one table.")
        existing = ", ".join(map(repr, columns_of_streams or self.streams))
        if not stream and not columns_of_streams:
            return UsageError(
                f"Recording {self.name} has the streams {existing} and is not one table yet. Run `tacpipe synchronize` "
                "on it first, or name a stream."
            )
        return UsageError(f"Recording {self.name} has no stream {stream!r}; it has {existing}.")


class LazyFiles(Mapping[str, bytes]):
    """The files of a dataset by name; their content is read and verified on access."""

    def __init__(self, files: Mapping[str, Content], read: Reader) -> None:
        self._files, self._read = files, read

    def __getitem__(self, name: str) -> bytes:
        return self._read(self._files[name]["digest"], name)

    def __iter__(self) -> Any:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


class Dataset:
    """A dataset opened for reading: recordings by name, files by name.

    ``len(dataset)`` is the number of recordings, iteration yields them in the order of their names,
    ``dataset["trial-003"]`` and ``dataset[3]`` return one, ``dataset[:3]`` a dataset of three, and ``"trial-003" in
    dataset`` tests for its name. A dataset without recordings, such as a model, is true. Datasets can be pickled; the
    copy reads from the same location.
    """

    def __init__(
        self,
        manifest: Manifest,
        read: Reader,
        names: Iterable[str] | None = None,
        *,
        directory: Path | None = None,
        opener: Callable[[Path | str], Dataset] | None = None,
    ) -> None:
        """Open the dataset of a manifest; ``read`` returns verified content, and ``names`` are its recordings, None for all.

        ``directory`` is where it is, and ``opener`` opens other datasets by path; both are None for the input of a
        stage.
        """
        self.source = manifest
        self.path = directory  # its directory, or None for the input of a stage
        self.recordings: Mapping[str, Recording] = _Recordings(self, manifest.included, read, names)
        self.files: Mapping[str, bytes] = LazyFiles(manifest.files, read)
        self._read, self._opener = read, opener
        self.chain_rows: Sequence[CountedRows] = ()  # rows that were read for it, set by a stage that shows them

    def __len__(self) -> int:
        return len(self.recordings)

    def __iter__(self) -> Iterator[Recording]:
        return iter(self.recordings.values())

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            raise guesses.missing("A dataset", name, guesses.DATASET)

    @overload
    def __getitem__(self, name: str | int) -> Recording: ...

    @overload
    def __getitem__(self, name: slice) -> Dataset: ...

    def __getitem__(self, name: str | int | slice) -> Recording | Dataset:
        """Return the recording with this name or place, or the dataset of a slice. Raises `UsageError` if there is none."""
        if isinstance(name, slice):
            return self.only(self.names[name])
        if isinstance(name, int):
            if not -len(self) <= name < len(self):
                raise IndexError(f"There is no recording {name} in {self._location}; it has {len(self)}.")
            name = self.names[name]
        if name not in self.recordings:
            raise UsageError(
                f"There is no recording {name!r} in {self._location}; it has {listed(self.recordings, _NAMED)}."
                f"{suggestion(name, self.recordings)}"
            )
        return self.recordings[name]

    def __contains__(self, name: object) -> bool:
        return name in self.recordings

    def __bool__(self) -> bool:
        return True

    def __reduce__(self) -> tuple[Any, ...]:
        reopen = functools.partial(Dataset, directory=self.path, opener=self._opener)
        return reopen, (self.source, self._read, tuple(self.recordings))

    def __repr__(self) -> str:
        from tacpipe.datasets import overview

        return overview.text(self)

    def _repr_html_(self) -> str:
        from tacpipe.datasets import overview

        return overview.html(self)

    @property
    def _location(self) -> str:
        return "this dataset" if self.path is None else str(self.path)

    @property
    def names(self) -> list[str]:
        """The names of the recordings."""
        return list(self.recordings)

    @property
    def streams(self) -> dict[str, list[str]]:
        """The columns of each stream of the first recording; a single table is the stream ""."""
        first = next(iter(self), None)
        return {} if first is None else {stream: first.columns(stream).column_names for stream in first.streams}

    @property
    def metrics(self) -> Any:
        """The measures of a result of `evaluate`, as JSON. Raises `UsageError` for other datasets."""
        if "metrics.json" not in self.files:
            raise UsageError(f"{self._location} is not a result; `tacpipe evaluate` writes one.")
        return json.loads(self.files["metrics.json"])

    @property
    def labels(self) -> pd.DataFrame:
        """The attributes of the recordings, with one row per recording name and one column per attribute.

        Attributes include hand-set labels, the sensor, sizes of gaps and whatever stages add.
        """
        from tacpipe.datasets import arrays

        return arrays.labels_frame(self)

    def only(self, names: Iterable[str]) -> Dataset:
        """Return the dataset reduced to the recordings with these names."""
        return Dataset(self.source, self._read, names, directory=self.path, opener=self._opener)

    def select(
        self,
        *names: str,
        split: Path | str | Dataset | None = None,
        role: Literal["train", "val", "calibration", "test"] | str | None = None,
        fold: int = 0,
        labels: Mapping[str, Wanted] | None = None,
        **conditions: Wanted,
    ) -> Dataset:
        """Return the dataset reduced to the recordings that meet every condition; only the split is read.

        ``names`` are names or patterns (``"trial-00?"``), at least one of which must match. ``split`` and ``role``
        select by the role in ``fold`` of a split; without ``role``, all recordings that have one. Each further keyword
        is a label with a value, a collection of values, or a predicate, as in ``select(object="cup", speed_m_s=lambda
        v: v < 1)``; ``labels`` is for labels that share a name with a parameter. A recording without the label does not
        match.

        Raises `UsageError` for a label that no recording has, and if no recording meets the conditions.
        """
        opened = self._open(split) if isinstance(split, str | Path) else split
        roles = selection.roles_of(opened, role, fold)
        return self.only(selection.select_names(self, names, roles, role, {**(labels or {}), **conditions}))

    def _open(self, path: Path | str) -> Dataset:
        """Return the opened dataset at a path. Raises `UsageError` in a stage, whose datasets are given."""
        if self._opener is None:
            raise UsageError(
                f"Open {path} with tacpipe.open first, and give that: this dataset is one that a stage reads."
            )
        return self._opener(path)

    @property
    def manifest(self) -> ManifestJson:
        """The manifest as plain values, with the recordings of all pages."""
        value: ManifestJson = json.loads(self.source.content)
        value.pop("pages", None)
        recordings, labels, sources = (
            dict(self.source.recordings),
            dict(self.source.labels),
            dict(self.source.sources),
        )
        return {**value, "recordings": recordings, "labels": labels, "sources": sources}

    @property
    def digest(self) -> str:
        """The dataset's digest."""
        return self.source.digest

    def table(
        self,
        stream: str | None = None,
        columns: Sequence[str] | None = None,
        *,
        labels: bool | Sequence[str] = False,
    ) -> pa.Table:
        """Return all recordings in one arrow table, with a first column ``recording`` unless the tables have one.

        ``stream`` is optional if each recording is a single table. ``labels`` appends attributes of the recordings as
        columns: all of them, or those named. Raises `TacpipeError` if the dataset has no recordings.
        """
        from tacpipe.io.parquet import one_after_another

        name = self._only_stream() if stream is None else stream
        if not self.recordings:
            raise TacpipeError("This dataset has no recordings to read. `tacpipe show` lists its content.")
        tables = {recording.name: recording.table(name, columns) for recording in self}
        if labels is not False:
            from tacpipe.datasets import arrays

            tables = arrays.add_label_columns(self, tables, None if labels is True else labels)
        return one_after_another(tables)

    to_arrow = table

    def to_pandas(
        self,
        stream: str | None = None,
        columns: Sequence[str] | None = None,
        *,
        labels: bool | Sequence[str] = False,
    ) -> pd.DataFrame:
        """Return all recordings in one frame after a categorical column ``recording``. Arguments are those of `table`.

        ``attrs["units"]`` has the unit of each column. Integers with nulls, for example because only some recordings have
        the column, become pandas' nullable integers: a column of floats would round values beyond 2^53.
        """
        from tacpipe.datasets import arrays

        return arrays.to_pandas(self.table(stream, columns, labels=labels))

    def to_polars(
        self,
        stream: str | None = None,
        columns: Sequence[str] | None = None,
        *,
        labels: bool | Sequence[str] = False,
    ) -> pl.DataFrame:
        """Return all recordings in one polars frame. Arguments are those of `table`."""
        with extras.explain_missing("to_polars"):
            import polars as pl

            frame = pl.from_arrow(self.table(stream, columns, labels=labels))
        assert isinstance(frame, pl.DataFrame)
        return frame

    def duckdb(self) -> duckdb.DuckDBPyConnection:
        """Return an in-memory DuckDB connection with one view per stream, named after it, and a view ``labels``.

        If recordings are single tables, their view is named ``data``. Each view has a first column ``recording``, for
        joins with ``labels``. All streams are read and verified immediately.
        """
        from tacpipe.datasets import arrays

        tables = {
            stream: self.only(recording.name for recording in self if stream in recording.streams).table(stream)
            for stream in sorted({stream for recording in self for stream in recording.streams})
        }
        with extras.explain_missing("duckdb"):
            return arrays.connect_duckdb(self, tables)

    def windows(
        self,
        context: int,
        horizon: int,
        *,
        stream: str | None = None,
        columns: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        targets: Sequence[str] | None = None,
        rest_s: float | None = None,
        scale: bool | Windows = False,
        stride: int = 1,
        dtype: Literal["float32", "float64"] = "float32",
        images: Sequence[str] = (),
        cameras: Dataset | None = None,
        size: int | tuple[int, int] | None = None,
        roi: tuple[int, int, int, int] | None = None,
        difference: bool = False,
        transform: Transform | None = None,
    ) -> Windows:
        """Return the windows of all recordings as a map-style torch dataset; see `tacpipe.datasets.windows.Windows`.

        Each window has ``context`` past rows of the ``inputs`` and ``horizon`` future rows of the ``targets``; the next
        one starts ``stride`` rows later. No window crosses a gap or the end of a recording. Channels are given by names
        or patterns (``"xela1_*"``); ``columns`` are both inputs and targets, and by default all channels are both.

        ``rest_s`` subtracts from each tactile channel its level at rest, the median over the first ``rest_s`` seconds
        of the recording. ``scale`` subtracts each channel's mean and divides by its standard deviation, computed from
        these windows (True) or taken from others, such as the training windows.

        ``images`` names streams of frames. Each window then has the newest frame of each camera at its past rows, and
        rows without a sound frame that is at most three steps old are in no window. The streams are those of the
        recordings, or else of the recordings with the same names in ``cameras``. ``roi`` (left, top, width, height) is
        the part of a frame in pixels, and ``size`` the side of the image, or its height and width. ``difference``
        subtracts the mean of the first five frames, which must show the untouched gel; rows before the fifth are in no
        window. ``transform`` is applied to the images (context, 3, height, width) of a camera.
        """
        with extras.explain_missing("windows"):
            from tacpipe.datasets.window_images import ImageOptions
            from tacpipe.datasets.windows import Windows

        return Windows(
            self,
            context,
            horizon,
            stream=self._only_stream() if stream is None else stream,
            columns=columns,
            inputs=inputs,
            targets=targets,
            rest_s=rest_s,
            scale=scale,
            stride=stride,
            dtype=dtype,
            images=ImageOptions(tuple(images), cameras or self, size, roi, difference, transform) if images else None,
        )

    def to_numpy(self, stream: str | None = None, columns: Sequence[str] | None = None) -> dict[str, Arrays]:
        """Return the arrays of each recording by name: ``values`` (time, channel), ``columns``, ``t_ns`` (time,).

        ``columns`` selects and orders what is read. Clocks, counters, masks and labels are not part of ``values``;
        ``arrays["contact"]`` returns any column (time,) in its own type. See `tacpipe.datasets.arrays.Arrays`.
        """
        from tacpipe.datasets import arrays

        name = self._only_stream() if stream is None else stream
        order = columns and [*dict.fromkeys(columns)]
        arrays_by_name = {}
        for recording in self:
            table = recording.table(name, order)
            arrays_by_name[recording.name] = arrays.arrays_of_table(table if order is None else table.select(order))
        return arrays_by_name

    def to_torch(self, stream: str | None = None, columns: Sequence[str] | None = None) -> dict[str, Tensors]:
        """Return the tensors of each recording by name: ``values`` (time, channel), ``columns``, ``t_ns`` (time,).

        Types are those of `to_numpy`. torch supports few operations on uint16, so call ``values.float()`` first there.
        """
        from tacpipe.datasets import arrays

        with extras.explain_missing("to_torch"):
            return {
                name: arrays.to_tensors(recording_arrays)
                for name, recording_arrays in self.to_numpy(stream, columns).items()
            }

    def _only_stream(self) -> str:
        streams = {stream for recording in self for stream in recording.streams}
        if len(streams) > 1:
            raise UsageError(f"Name the stream to read: the recordings have {', '.join(sorted(streams))}.")
        return next(iter(streams), "")


class _Recordings(Mapping[str, Recording]):
    """Recordings by name, in the order of names, created on access."""

    def __init__(
        self, dataset: Dataset, entries: Mapping[str, RecordingEntry], read: Reader, names: Iterable[str] | None
    ) -> None:
        self._dataset, self._entries, self._read = dataset, entries, read
        self._names: Collection[str] = entries
        if names is not None or not isinstance(entries, pages.Recordings):
            self._names = dict.fromkeys(sorted(entries if names is None else names))
        for name in names or ():
            entries[name]
        self._opened: WeakValueDictionary[str, Recording] = WeakValueDictionary()

    def __getitem__(self, name: str) -> Recording:
        if name not in self._names:
            raise KeyError(name)
        recording = self._opened.get(name)
        if recording is None:
            recording = self._opened[name] = Recording(name, self._entries[name], self._read, self._dataset)
        return recording

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


Model = Dataset  # a dataset whose files contain weights and configuration
Datasets = tuple[Dataset, ...]
