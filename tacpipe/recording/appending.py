"""Store a sealed recording, read it back, and append it to its dataset."""

from __future__ import annotations

import functools
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from tacpipe.channels.streams import EVENTS
from tacpipe.datasets import directory, paths
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets.manifest import ACQUIRE, Manifest
from tacpipe.datasets.pages import Item
from tacpipe.engine import keys, provenance
from tacpipe.errors import DamagedError, TacpipeError, UsageError
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import plain
from tacpipe.recording.rig import Rig
from tacpipe.recording.sealing import Sealed, events_table
from tacpipe.recording.spool import Spooled
from tacpipe.store.records import Provenance, RecordingEntry, Shard, StoredResult
from tacpipe.store.store import Object, Store

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = 1
BYTES = "bytes"  # name of the attached spool, where a driver could not decode all bytes
RIG = "rig.toml"  # name of the attached rig file


class NothingError(TacpipeError):
    """A recording without a single sample."""


def append(store: Store, output: Path, spooled: Spooled, rig: Rig, sealed: Mapping[str, Sealed]) -> str:
    """Append a recording to the dataset at ``output`` and return its name.

    Its shards are durable, and read again and compared, before the manifest names them. Raises `NothingError` if no stream
    gave anything (`TacpipeError` if they gave no sample), and `DamagedError` if what was written is not what is read.
    """
    began_s = time.perf_counter()
    streams = {name: stream.batches for name, stream in sealed.items() if stream.rows}
    if not streams:
        _raise_empty(spooled, sealed)
    events = events_table(sealed, spooled)
    if events.num_rows:
        streams[EVENTS] = events.to_reader
    shards = {name: _shard(store, name, batches) for name, batches in sorted(streams.items())}
    text = store.put(rig.text.encode(), durable=True).to_json()
    entry: RecordingEntry = {"attributes": _attributes(spooled, rig, sealed), "shards": shards}
    files = {RIG: text}
    if any(stream.undecoded for stream in sealed.values()):  # a later driver may decode them
        with (spooled.folder / "bytes").open("rb") as spool:
            copied = functools.partial(shutil.copyfileobj, spool)
            files[BYTES] = store.put_written(copied, durable=True).to_json()
    result: StoredResult = {"recordings": {"": entry}, "files": files}
    identity = keys.identity(ACQUIRE, VERSION, {"rig": text["digest"]}, {"spool": spooled.folder.name})
    provenance_entry: Provenance = {
        **provenance.describe_provenance(round(time.perf_counter() - began_s, 4)),
        "irreplaceable": True,
    }
    store.commit(identity, result, provenance_entry, durable=True)
    output, rig_name = output.absolute(), f"rig-{text['digest'][:8]}.toml"
    names: list[str] = []  # the name of the recording, last

    def appended() -> directory.DirectoryChange:
        before = existing(output)
        recordings = {} if before is None else before.recordings
        existing_name = next((name for name, entry in recordings.items() if entry["shards"] == shards), None)
        if before is not None and existing_name is not None:  # a crash came after an earlier append
            names.append(existing_name)
            return directory.DirectoryChange(before, may_lack=_other_paths(before, existing_name, rig_name))
        name = _free_name(spooled.header["recording"], recordings)
        now = before or Manifest(ACQUIRE, VERSION)
        now = now.with_recordings({name: Item(entry, None, {RIG: text["digest"]})})
        now = replace(now, files=dict(sorted({**now.files, rig_name: text}.items())))
        try:
            manifest_of.check_pages(now, fresh=True)
            now.content  # noqa: B018  (what JSON cannot hold is refused here)
        except (ValueError, TypeError, KeyError) as error:  # never publish what every reader would refuse
            raise TacpipeError(
                f"Recording {plain(name)} cannot be added to {output}: {plain(str(error), 200)}."
            ) from error
        names.append(name)
        return directory.DirectoryChange(now, may_lack=_other_paths(now, name, rig_name))

    directory.change(store, output, appended)
    return names[-1]


def _other_paths(manifest: Manifest, name: str, rig: str) -> set[str]:
    """Return the paths of all recordings and rig files except these."""
    return {path for path, _ in manifest.objects() if not path.startswith(f"{name}/") and path != rig}


def _raise_empty(spooled: Spooled, sealed: Mapping[str, Sealed]) -> NoReturn:
    """Raise the error for a spool without samples, and remove a spool without bytes."""
    received = sum(stream.received for stream in sealed.values())
    if not received and not spooled.damage:
        spooled.remove()
        raise NothingError(f"No stream sent any data ({', '.join(sealed)}), so there is no recording.")
    spoiled = sum(damage.bytes for damage in spooled.damage)
    raise TacpipeError(
        f"{received:,} bytes came from {', '.join(sealed)} and hold no sample; {spoiled:,} more are spoiled. "
        f"`tacpipe acquire --dry-run` states what each device sends."
    )


def existing(output: Path) -> Manifest | None:
    """Return the manifest of the acquired recordings at ``output``, or None if there is no dataset yet.

    Raises `UsageError` if another command wrote the dataset.
    """
    if not (output / manifest_of.NAME).exists():
        return None
    manifest = manifest_of.find(output).manifest
    if manifest.stage != ACQUIRE:
        raise UsageError(
            f"{output} was made by {manifest.stage}, and acquire appends only to acquired recordings. Give -o another "
            f"directory; later stages read several datasets as one."
        )
    return manifest


def refuse_taken(output: Path, names: Sequence[str]) -> None:
    """Raise `UsageError` if a recording at ``output`` has one of these names, in upper or lower case.

    Some file systems do not distinguish case. Raises it also if another command wrote the dataset.
    """
    before = existing(output)
    existing_names = {} if before is None else {paths.folded_name(name): name for name in before.recordings}
    folded_names = [paths.folded_name(name) for name in names]
    conflicts = sorted(existing_names[folded] for folded in folded_names if folded in existing_names)
    if conflicts:
        raise UsageError(
            f"{output} has recordings of these names already: {', '.join(map(plain, conflicts[:5]))}. Give another --name, "
            f"in more than upper and lower case, or -o another directory."
        )


def _free_name(requested: str, existing_names: Iterable[str]) -> str:
    """Return ``requested``, with a number appended if another process used that name meanwhile.

    Names that differ only in case count as equal, as on some file systems.
    """
    name, number, folded = requested, 2, {paths.folded_name(existing) for existing in existing_names}
    while paths.folded_name(name) in folded:
        name, number = f"{requested}-{number}", number + 1
    return name


def _shard(store: Store, stream: str, batches: Callable[[], pa.RecordBatchReader]) -> Shard:
    from tacpipe.io import columns, parquet

    rows: list[int] = []
    stored: Object = store.put_written(lambda file: rows.append(parquet.write(batches(), file)), durable=True)
    columns.release()
    for _ in store.blocks(stored.digest, stored.bytes):
        pass  # read every block back, which compares the digest
    if not _equal_batches(parquet.stored_batches(store.object_path(stored.digest)), batches()):
        raise DamagedError(f"Stream {stream} differs from the data that were written. Do not trust this disk.")
    return {**stored.to_json(), "rows": rows[0]}


def _equal_batches(stored: pa.RecordBatchReader, expected: pa.RecordBatchReader) -> bool:
    """Return whether a shard has the rows of the expected batches bit by bit, compared in batches."""
    import pyarrow as pa

    if not stored.schema.equals(expected.schema):
        return False
    waiting: list[pa.RecordBatch] = []  # batches of the shard
    for batch in expected:
        count = batch.num_rows
        while sum(part.num_rows for part in waiting) < count:
            next_batch = next(stored, None)
            if next_batch is None:
                return False
            waiting.append(next_batch)
        table = pa.Table.from_batches(waiting)
        if not _equal_tables(table.slice(0, count), pa.Table.from_batches([batch])):
            return False
        waiting = [part for part in table.slice(count).to_batches() if part.num_rows]
    return not waiting and next(stored, None) is None


def _equal_tables(ours: pa.Table, theirs: pa.Table) -> bool:
    """Return whether two tables are equal bit by bit, so that NaN equals NaN."""
    import pyarrow as pa

    for kind, *columns in zip(theirs.schema, ours.columns, theirs.columns, strict=True):
        if pa.types.is_floating(kind.type):
            left, right = (column.to_numpy().view(f"u{kind.type.bit_width // 8}") for column in columns)
            if not np.array_equal(left, right):
                return False
        elif not columns[0].equals(columns[1]):
            return False
    return True


def _attributes(spooled: Spooled, rig: Rig, sealed: Mapping[str, Sealed]) -> dict[str, Attribute]:
    """Return the labels and, for each stream, the number of lost samples and the losses of a crash."""
    master = rig.streams[rig.master]
    attributes: dict[str, Attribute] = {"sensor": master.sensor.product or master.kind, "master": rig.master}
    attributes |= {**rig.labels, **spooled.header["attributes"]}
    attributes["ended"] = spooled.ended
    if (duration_s := spooled.header.get("duration_s")) is not None:
        attributes["requested_duration_s"] = float(duration_s)
    for name, stream in sealed.items():
        attributes[f"{name}_lost"] = stream.lost
        if not stream.rows:
            attributes[f"{name}_missing"] = True
        if stream.undecoded:
            attributes[f"{name}_undecoded_bytes"] = stream.undecoded
        if stream.uncertain:
            attributes[f"{name}_uncertain_samples"] = stream.uncertain
        if stream.crashed[0]:
            reads, size = stream.crashed
            attributes |= {f"{name}_crash_lost_reads": reads, f"{name}_crash_lost_bytes": size}
    return attributes
