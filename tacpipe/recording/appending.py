"""A sealed recording put into the store and appended to its dataset, looked at once more before success is reported."""

from __future__ import annotations

import functools
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from tacpipe.channels.streams import EVENTS
from tacpipe.datasets import directory, recording_names
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets.manifest import ACQUIRE, Entry, Manifest
from tacpipe.datasets.pages import Item
from tacpipe.engine import keys, provenance
from tacpipe.errors import DamagedError, TacpipeError, UsageError
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import plain
from tacpipe.recording.rig import Rig
from tacpipe.recording.sealing import Sealed, events_table
from tacpipe.recording.spooled import Spooled
from tacpipe.store.store import Object, Store

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = 1
BYTES = "bytes"  # and under this one its spool, where a driver could not read all of it
RIG = "rig.toml"  # under this name the rig file goes along with a recording


class NothingError(TacpipeError):
    """A recording without a single sample."""


def append(store: Store, output: Path, spooled: Spooled, rig: Rig, sealed: Mapping[str, Sealed]) -> str:
    """Append a recording to the dataset at ``output`` and return its name.

    Its shards are durable, and read again and compared, before the manifest names them. Raises `NothingError` if no stream
    gave anything (`TacpipeError` if they gave no sample), and `DamagedError` if what was written is not what is read.
    """
    began_s = time.perf_counter()
    streams = {name: one.batches for name, one in sealed.items() if one.rows}
    if not streams:
        _refuse(spooled, sealed)
    events = events_table(sealed, spooled)
    if events.num_rows:
        streams[EVENTS] = events.to_reader
    shards = {name: _shard(store, name, batches) for name, batches in sorted(streams.items())}
    text = vars(store.put(rig.text.encode(), durable=True))
    entry: Entry = {"attributes": _attributes(spooled, rig, sealed), "shards": shards}
    files = {RIG: text}
    if any(one.undecoded for one in sealed.values()):  # what no driver could read today, a better one may
        with (spooled.folder / "bytes").open("rb") as spool:
            copied = functools.partial(shutil.copyfileobj, spool)
            files[BYTES] = vars(store.put_written(copied, durable=True))
    result = {"recordings": {"": entry}, "files": files}
    identity = keys.identity(ACQUIRE, VERSION, {"rig": text["digest"]}, {"spool": spooled.folder.name})
    made = {**provenance.of(round(time.perf_counter() - began_s, 4)), "irreplaceable": True}
    store.commit(identity, result, made, durable=True)
    output, named = output.absolute(), f"rig-{text['digest'][:8]}.toml"
    names: list[str] = []  # of the recording

    def appended() -> directory.Change:
        before = existing(output)
        there = {} if before is None else before.recordings
        known = next((name for name, other in there.items() if other["shards"] == shards), None)
        if before is not None and known is not None:  # a crash came between this and the spool's end
            names.append(known)
            return directory.Change(before, may_lack=_others(before, known, named))
        name = _free(spooled.header["recording"], there)
        now = before or Manifest(ACQUIRE, VERSION)
        now = now.with_recordings({name: Item(entry, None, {RIG: text["digest"]})})
        now = replace(now, files=dict(sorted({**now.files, named: text}.items())))
        try:
            manifest_of.check_pages(now, fresh=True)
            now.content  # noqa: B018  (what JSON cannot hold is refused here)
        except (ValueError, TypeError, KeyError) as error:  # what every reader would refuse is never published
            raise TacpipeError(
                f"Recording {plain(name)} cannot be added to {output}: {plain(str(error), 200)}."
            ) from error
        names.append(name)
        return directory.Change(now, may_lack=_others(now, name, named))

    directory.change(store, output, appended)
    return names[-1]


def _others(manifest: Manifest, name: str, rig: str) -> set[str]:
    """Return the paths of all recordings and rig files but these."""
    return {path for path, _ in manifest.objects() if not path.startswith(f"{name}/") and path != rig}


def _refuse(spooled: Spooled, sealed: Mapping[str, Sealed]) -> NoReturn:
    """Report that there is no recording; what holds no byte at all is removed."""
    received = sum(one.received for one in sealed.values())  # what was read and never written is gone
    if not received and not spooled.damage:
        spooled.remove()
        raise NothingError(f"No stream gave a single byte ({', '.join(sealed)}), so there is no recording.")
    spoiled = sum(one.bytes for one in spooled.damage)
    raise TacpipeError(
        f"{received:,} bytes came from {', '.join(sealed)} and hold no sample; {spoiled:,} more are spoiled. "
        f"`tacpipe acquire --dry-run` states what each device sends."
    )


def existing(output: Path) -> Manifest | None:
    """Return the manifest of the acquired recordings at ``output``, None if nothing is there yet.

    Raises `UsageError` if another command made what is there.
    """
    if not (output / manifest_of.NAME).exists():
        return None
    found = manifest_of.find(output).manifest
    if found.stage != ACQUIRE:
        raise UsageError(
            f"{output} was made by {found.stage}, and acquire appends to acquired recordings alone. Give -o another "
            f"directory; later stages read several datasets as one."
        )
    return found


def refuse_taken(output: Path, names: Sequence[str]) -> None:
    """Raise `UsageError` if a recording at ``output`` has one of these names but for case, which some file systems fold.

    Raises it too if another command made what is there.
    """
    before = existing(output)
    there = {} if before is None else {recording_names.folded(name): name for name in before.recordings}
    taken = sorted(there[folded] for name in names if (folded := recording_names.folded(name)) in there)
    if taken:
        raise UsageError(
            f"{output} has recordings of these names already: {', '.join(map(plain, taken[:5]))}. Give another --name, in "
            f"more than upper and lower case, or -o another directory."
        )


def _free(wanted: str, taken: Mapping[str, Any]) -> str:
    """Return ``wanted``, with a number behind it if another process took that name since: what is recorded is kept.

    Names that differ only in case are one, as on some file systems.
    """
    name, number, folded = wanted, 2, {recording_names.folded(one) for one in taken}
    while recording_names.folded(name) in folded:
        name, number = f"{wanted}-{number}", number + 1
    return name


def _shard(store: Store, stream: str, batches: Callable[[], pa.RecordBatchReader]) -> dict[str, Any]:
    from tacpipe.io import columns, parquet

    rows: list[int] = []
    stored: Object = store.put_written(lambda file: rows.append(parquet.write(batches(), file)), durable=True)
    columns.release()
    for _ in store.blocks(stored.digest, stored.bytes):
        pass  # each is read back, and all are hashed
    if not _same(parquet.stored_batches(store.object_path(stored.digest)), batches()):
        raise DamagedError(f"Stream {stream} does not read as it was written: the disk is not to be trusted.")
    return {"digest": stored.digest, "rows": rows[0], "bytes": stored.bytes}


def _same(stored: pa.RecordBatchReader, written: pa.RecordBatchReader) -> bool:
    """Return whether a shard holds the rows of batches to the bit, NaN equal to itself; some rows at a time."""
    import pyarrow as pa

    if not stored.schema.equals(written.schema):
        return False
    waiting: list[pa.RecordBatch] = []  # of the shard
    for batch in written:
        count = batch.num_rows
        while sum(one.num_rows for one in waiting) < count:
            more = next(stored, None)
            if more is None:
                return False
            waiting.append(more)
        there = pa.Table.from_batches(waiting)
        if not _equal(there.slice(0, count), pa.Table.from_batches([batch])):
            return False
        waiting = [one for one in there.slice(count).to_batches() if one.num_rows]
    return not waiting and next(stored, None) is None


def _equal(ours: pa.Table, theirs: pa.Table) -> bool:
    import pyarrow as pa

    for kind, *columns in zip(theirs.schema, ours.columns, theirs.columns, strict=True):
        if pa.types.is_floating(kind.type):
            one, other = (column.to_numpy().view(f"u{kind.type.bit_width // 8}") for column in columns)
            if not np.array_equal(one, other):
                return False
        elif not columns[0].equals(columns[1]):
            return False
    return True


def _attributes(spooled: Spooled, rig: Rig, sealed: Mapping[str, Sealed]) -> dict[str, Attribute]:
    """Return labels, and for each stream how many samples were lost; what a crash cost where there was one."""
    master = rig.streams[rig.master]
    attributes: dict[str, Attribute] = {"sensor": master.sensor.product or master.kind, "master": rig.master}
    attributes |= {**rig.labels, **spooled.header["attributes"]}
    attributes["ended"] = spooled.ended
    if spooled.header.get("duration_s") is not None:
        attributes["requested_duration_s"] = float(spooled.header["duration_s"])
    for name, one in sealed.items():
        attributes[f"{name}_lost"] = one.lost
        if not one.rows:
            attributes[f"{name}_missing"] = True
        if one.undecoded:
            attributes[f"{name}_undecoded_bytes"] = one.undecoded
        if one.uncertain:
            attributes[f"{name}_uncertain_samples"] = one.uncertain
        if one.crashed[0]:
            attributes |= {f"{name}_crash_lost_reads": one.crashed[0], f"{name}_crash_lost_bytes": one.crashed[1]}
    return attributes
