"""Store a sealed recording, read it back, and append it to its dataset."""

from __future__ import annotations

import functools
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import pyarrow as pa

from tacpipe.channels.streams import EVENTS
from tacpipe.datasets import directory, paths
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets.manifest import ACQUIRE, Manifest
from tacpipe.datasets.pages import Item
from tacpipe.engine import keys, provenance
from tacpipe.errors import DamagedError, TacpipeError, UsageError
from tacpipe.io.hashing import digest
from tacpipe.plugins.rows import StageRows, stage_rows_from_json
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import plain
from tacpipe.recording.rig import Rig
from tacpipe.recording.sealing import Sealed, events_table
from tacpipe.recording.spool import Spooled
from tacpipe.store import records
from tacpipe.store.records import Provenance, RecordingEntry, Shard, StoredResult
from tacpipe.store.store import Object, Store

VERSION = 1
BYTES = "bytes"  # name of the attached raw bytes, which are stored if a driver could not decode all of them
RIG = "rig.toml"  # name of the attached rig file


class NothingError(TacpipeError):
    """No stream of a recording received any bytes."""


def append(store: Store, output: Path, spooled: Spooled, rig: Rig, sealed: Mapping[str, Sealed]) -> str:
    """Append a recording to the dataset at ``output`` and return its name.

    The shards are synced to disk, read back and compared before the manifest refers to them. Raises `NothingError` if no
    stream received bytes, `TacpipeError` if the bytes contain no sample, and `DamagedError` if a shard reads back wrong.
    """
    start_s = time.perf_counter()
    streams = {name: stream.batches for name, stream in sealed.items() if stream.rows}
    if not streams:
        _raise_empty(spooled, sealed)
    events = events_table(sealed, spooled)
    if events.num_rows:
        streams[EVENTS] = events.to_reader
    shards = {name: _store_shard(store, name, batches) for name, batches in sorted(streams.items())}
    stored_rig = store.put(rig.text.encode(), durable=True).to_json()
    entry: RecordingEntry = {"attributes": _attributes(spooled, rig, sealed), "shards": shards}
    files = {RIG: stored_rig}
    if any(stream.undecoded for stream in sealed.values()):  # a later driver may decode them
        with (spooled.folder / "bytes").open("rb") as spool:
            copy_spool = functools.partial(shutil.copyfileobj, spool)
            files[BYTES] = store.put_written(copy_spool, durable=True).to_json()
    stored_result: StoredResult = {"recordings": {"": entry}, "files": files}
    identity = keys.identity(ACQUIRE, VERSION, {"rig": stored_rig["digest"]}, {"spool": spooled.folder.name})
    path, rig_name = output.absolute(), f"rig-{stored_rig['digest'][:8]}.toml"
    rows, total = StageRows(1, {name: stream.counts for name, stream in sealed.items()}), _total_rows(store, path)
    total.add(rows)
    provenance_entry: Provenance = {
        **provenance.describe_provenance(round(time.perf_counter() - start_s, 4)),
        "irreplaceable": True,
        "rows": rows.to_json(),
        "stage_rows": {ACQUIRE: total.to_json()},
    }
    store.commit(identity, stored_result, provenance_entry, durable=True)
    names: list[str] = []  # names under which the recording was added; a retry appends another

    def add_recording() -> directory.DirectoryChange:
        current = existing_manifest(path)
        recordings = {} if current is None else current.recordings
        existing_name = next((name for name, entry in recordings.items() if entry["shards"] == shards), None)
        if current is not None and existing_name is not None:  # an earlier run appended it and then crashed
            names.append(existing_name)
            return directory.DirectoryChange(current, may_lack=_other_paths(current, existing_name, rig_name))
        name = _free_name(spooled.header["recording"], recordings)
        updated = current or Manifest(ACQUIRE, VERSION)
        updated = updated.with_recordings({name: Item(entry, None, {RIG: stored_rig["digest"]})})
        updated = replace(updated, files=dict(sorted({**updated.files, rig_name: stored_rig}.items())))
        try:
            manifest_of.check_pages(updated, fresh=True)
            updated.content  # noqa: B018  (raises if a value cannot be written as JSON)
        except (ValueError, TypeError, KeyError) as error:  # a manifest that readers would reject must not be published
            raise TacpipeError(
                f"Recording {plain(name)} cannot be added to {path}: {plain(str(error), 200)}."
            ) from error
        names.append(name)
        may_lack = _other_paths(updated, name, rig_name)
        return directory.DirectoryChange(updated, may_lack=may_lack, key=digest(identity))

    directory.change(store, path, add_recording)
    return names[-1]


def _total_rows(store: Store, path: Path) -> StageRows:
    """Return the rows of all recordings of the dataset at ``path``, from the record of the last one."""
    record = store.record(key) if (key := directory.stored_key(store, path)) else None
    return stage_rows_from_json(records.summary(record).get("stage_rows") if record else None).get(ACQUIRE, StageRows())


def _other_paths(manifest: Manifest, name: str, rig: str) -> set[str]:
    """Return the paths of all other recordings and rig files."""
    return {path for path, _ in manifest.objects() if not path.startswith(f"{name}/") and path != rig}


def _raise_empty(spooled: Spooled, sealed: Mapping[str, Sealed]) -> NoReturn:
    """Raise the error for a spool without samples, and remove the spool if it is also without bytes.

    Raises `NothingError` if no bytes were received, else `TacpipeError`.
    """
    received = sum(stream.received for stream in sealed.values())
    if not received and not spooled.damage:
        spooled.remove()
        raise NothingError(f"No stream received any bytes ({', '.join(sealed)}), so there is no recording.")
    damaged = sum(damage.bytes for damage in spooled.damage)
    raise TacpipeError(
        f"{received:,} bytes from {', '.join(sealed)} contain no sample; {damaged:,} more bytes are damaged. "
        f"`tacpipe acquire --dry-run` shows what each device sends."
    )


def existing_manifest(output: Path) -> Manifest | None:
    """Return the manifest of the acquired recordings at ``output``, or None if there is no dataset.

    Raises `UsageError` if another command wrote the dataset.
    """
    if not (output / manifest_of.NAME).exists():
        return None
    manifest = manifest_of.find(output).manifest
    if manifest.stage != ACQUIRE:
        raise UsageError(
            f"{output} was written by {manifest.stage}, and acquire appends only to acquired recordings. Give -o another "
            f"directory; later stages can read several datasets."
        )
    return manifest


def refuse_existing_names(output: Path, names: Sequence[str]) -> None:
    """Raise `UsageError` if a recording at ``output`` has one of these names. Case is ignored.

    Some file systems do not distinguish case. Also raises `UsageError` if another command wrote the dataset.
    """
    manifest = existing_manifest(output)
    existing_names = {} if manifest is None else {paths.folded_name(name): name for name in manifest.recordings}
    folded_names = [paths.folded_name(name) for name in names]
    conflicts = sorted(existing_names[folded] for folded in folded_names if folded in existing_names)
    if conflicts:
        raise UsageError(
            f"{output} already has recordings with these names: {', '.join(map(plain, conflicts[:5]))}. Give a --name that "
            f"differs in more than case, or give -o another directory."
        )


def _free_name(requested: str, existing_names: Iterable[str]) -> str:
    """Return ``requested``, with a number appended if the dataset already has that name.

    Another process may have used the name since it was checked. Names that differ only in case count as equal.
    """
    name, number, folded = requested, 2, {paths.folded_name(existing) for existing in existing_names}
    while paths.folded_name(name) in folded:
        name, number = f"{requested}-{number}", number + 1
    return name


def _store_shard(store: Store, stream: str, batches: Callable[[], pa.RecordBatchReader]) -> Shard:
    """Store a stream as a shard, compare it with what was written, and return its entry.

    Raises `DamagedError` if it differs.
    """
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
    """Return whether a shard equals the expected batches bit by bit."""
    if not stored.schema.equals(expected.schema):
        return False
    uncompared: list[pa.RecordBatch] = []  # batches of the shard that are not compared yet
    for batch in expected:
        count = batch.num_rows
        while sum(part.num_rows for part in uncompared) < count:
            next_batch = next(stored, None)
            if next_batch is None:
                return False
            uncompared.append(next_batch)
        table = pa.Table.from_batches(uncompared)
        if not _equal_tables(table.slice(0, count), pa.Table.from_batches([batch])):
            return False
        uncompared = [part for part in table.slice(count).to_batches() if part.num_rows]
    return not uncompared and next(stored, None) is None


def _equal_tables(stored: pa.Table, expected: pa.Table) -> bool:
    """Return whether two tables are equal bit by bit; NaN equals NaN."""
    for field, *columns in zip(expected.schema, stored.columns, expected.columns, strict=True):
        if pa.types.is_floating(field.type):
            left, right = (column.to_numpy().view(f"u{field.type.bit_width // 8}") for column in columns)
            if not np.array_equal(left, right):
                return False
        elif not columns[0].equals(columns[1]):
            return False
    return True


def _attributes(spooled: Spooled, rig: Rig, sealed: Mapping[str, Sealed]) -> dict[str, Attribute]:
    """Return the labels and, for each stream, the numbers of lost, uncertain and undecoded samples or bytes."""
    master = rig.streams[rig.master]
    attributes: dict[str, Attribute] = {"sensor": master.sensor.product or master.kind, "master": rig.master}
    attributes |= {**rig.labels, **spooled.header["attributes"]}
    attributes["ended"] = spooled.ended
    if (duration_s := spooled.header.get("duration_s")) is not None:
        attributes["requested_duration_s"] = float(duration_s)
    for name, stream in sealed.items():
        attributes[f"{name}_lost"] = stream.losses.certain
        if stream.losses.by_clock:
            attributes[f"{name}_lost_by_clock"] = stream.losses.by_clock
        if stream.losses.estimated:
            attributes[f"{name}_lost_estimated"] = stream.losses.estimated
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
