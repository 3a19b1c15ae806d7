"""Build recordings and datasets for tests, without a store for functions that read them, and published in one."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.datasets import directory
from tacpipe.datasets.manifest import ACQUIRE, Manifest
from tacpipe.io.columns import Columns
from tacpipe.io.hashing import digest
from tacpipe.io.parquet import ParquetTable, to_parquet
from tacpipe.store.records import RecordingEntry, Shard
from tacpipe.store.store import Store


class _Fake:
    """A recording as a stage sees it."""

    tables: Mapping[str, pa.Table]
    name: str

    @property
    def streams(self) -> tuple[str, ...]:
        return tuple(sorted(self.tables))

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        return self.tables[stream] if columns is None else self.tables[stream].select(list(columns))

    def columns(self, stream: str = "") -> Columns:
        return Columns(to_parquet(self.tables[stream]))

    @property
    def digest(self) -> str:
        return digest([self.name, *(table.num_rows for table in self.tables.values())])


@dataclass
class FakeRecording(_Fake):
    """A recording of several streams: tables by name."""

    tables: Mapping[str, pa.Table]
    name: str = "trial"
    attributes: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class FakeShard(_Fake):
    """A recording of one table, as `synchronize` and what follows it make them."""

    name: str
    content: pa.Table
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def tables(self) -> Mapping[str, pa.Table]:  # type: ignore[override]
        return {"": self.content}


@dataclass
class FakeDataset:
    """A dataset as a stage sees it: recordings by name, and files."""

    recordings: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)
    manifest: dict[str, Any] = field(default_factory=dict)
    chain_rows: Sequence[Any] = ()

    def __post_init__(self) -> None:
        self.manifest = json.loads(Manifest("evaluate", 1, {}).content) | self.manifest

    def __len__(self) -> int:
        return len(self.recordings)

    def __bool__(self) -> bool:
        return True

    @property
    def source(self) -> Manifest:
        """The manifest with the attributes of the recordings."""
        entries: dict[str, RecordingEntry] = {
            name: {"attributes": dict(recording.attributes), "shards": {}}
            for name, recording in self.recordings.items()
        }
        return Manifest("evaluate", 1, {}, recordings=entries)


def dataset(*recordings: FakeRecording | FakeShard, files: Mapping[str, bytes] | None = None) -> Any:
    """Return a dataset of these recordings."""
    return FakeDataset({recording.name: recording for recording in recordings}, files or {})


def stored_entry(store: Store, tables: Mapping[str, pa.Table], attributes: Mapping[str, Any]) -> RecordingEntry:
    """Store the streams of a recording, and return its entry in a manifest."""
    shards: dict[str, Shard] = {
        stream: {**store.put(to_parquet(table)).to_json(), "rows": table.num_rows}
        for stream, table in sorted(tables.items())
    }
    return {"attributes": dict(sorted(attributes.items())), "shards": shards}


def publish_dataset(
    store: Store, path: Path, tables: Mapping[str, Mapping[str, pa.Table]], **labels: list[Any]
) -> None:
    """Publish recordings by name and stream as a result of the stage scale, each label a list of one value per recording."""
    store.prepare()
    entries = {
        name: stored_entry(
            store, streams, {label: values[place] for label, values in labels.items() if values[place] is not None}
        )
        for place, (name, streams) in enumerate(tables.items())
    }
    manifest = Manifest("scale", 1, {"factor": 2}, recordings=entries)
    store.put(manifest.content)
    directory.publish(store, manifest, path)


def write_dataset(folder: Path, recordings: Mapping[str, tuple[Mapping[str, pa.Table], Mapping[str, Any]]]) -> Path:
    """Write acquired recordings, each streams and attributes, as a dataset of the project in the working directory."""
    store = Store(Path(".tacpipe").absolute())
    store.prepare()
    entries = {name: stored_entry(store, *content) for name, content in recordings.items()}
    output = Manifest(ACQUIRE, 1, {}, recordings=entries)
    directory.change(store, folder, lambda: directory.DirectoryChange(output))
    return folder


def column(table: pa.Table, name: str) -> np.ndarray[Any, Any]:
    """Return a column (row,) as an array."""
    values: np.ndarray[Any, Any] = table.column(name).to_numpy()
    return values


def decode_few_rows_at_a_time(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    """Make every stored table yield batches of ``rows`` rows, whichever number its reader asks for."""
    for kind in (ParquetTable, Columns):
        batches = kind.batches
        monkeypatch.setattr(
            kind, "batches", lambda self, columns=None, _=0, batches=batches, **_rows: batches(self, columns, rows)
        )
