"""Log the frames that an emulated stream sent, with their faults, to compare them with a recording."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.sensor import Frames, Samples, Sensor
from tests.emulation import byte_faults
from tests.emulation.byte_faults import CAUSES, SentItem
from tests.emulation.source import Sampled


def decode_frames(sensor: Sensor, frames: Frames) -> Samples:
    """Return the samples of encoded frames. ``rows`` has the index of the frame of each sample."""
    parts = (
        list(_group_by_size(frames))
        if isinstance(frames, list) and isinstance(sensor.framer(), ByteFramer)
        else [frames]
    )
    decoded_parts = []
    for part in parts:
        samples = sensor.decode(part)
        rows = np.arange(len(samples), dtype=np.int64) if samples.rows is None else samples.rows
        decoded_parts.append(replace(samples, rows=rows, t_device_ns=samples.t_device_ns))
    return concatenate(decoded_parts, [len(part) for part in parts])


def concatenate(parts: Sequence[Samples], frames: Sequence[int] | None = None) -> Samples:
    """Concatenate samples. ``frames`` is the number of frames of each part, by default the highest one in its ``rows``."""
    counts = frames or [int(part.rows.max(initial=-1)) + 1 for part in parts if part.rows is not None]
    values = tuple(np.concatenate(blocks) for blocks in zip(*(part.values for part in parts), strict=True))
    starts = np.cumsum([0, *counts])
    rows = [part.rows + start for part, start in zip(parts, starts, strict=False) if part.rows is not None]
    seq, t_device_ns, device_seq = (_concatenate_column(parts, name) for name in ("seq", "t_device_ns", "device_seq"))
    return Samples(values, seq, t_device_ns, device_seq, np.concatenate(rows) if rows else None)


def _concatenate_column(parts: Sequence[Samples], name: str) -> Int64s | None:
    columns = [column for part in parts if (column := getattr(part, name)) is not None]
    return np.concatenate(columns) if columns else None


def _group_by_size(frames: Sequence[bytes]) -> Iterator[Any]:
    """Yield runs of frames of one size as arrays (frame, byte)."""
    start = 0
    for stop in range(1, len(frames) + 1):
        if stop == len(frames) or len(frames[stop]) != len(frames[start]):
            data = np.frombuffer(b"".join(frames[start:stop]), np.uint8)
            yield data.reshape(stop - start, len(frames[start]))
            start = stop


UNHARMED = (byte_faults.SOUND, byte_faults.STALL, byte_faults.REORDER, byte_faults.DUPLICATE)
CODES = {cause: code for code, cause in enumerate(CAUSES)}


@dataclass(frozen=True)
class LedgerEntry:
    """A frame that was or should have been sent."""

    due_ns: int  # time on this computer's monotonic clock
    sent_ns: int  # actual time on the same clock; 0: it was not sent
    number: int  # number of the sample in its source; -1 if it is not a frame
    size: int  # sent bytes
    cause: str
    invisible: bool  # has a fault that the protocol's own checks do not detect
    source: int  # number of the source; a change of the rate starts a new source


class Ledger:
    """The sent items and the events of one stream, in order."""

    def __init__(self, name: str) -> None:
        """Start an empty ledger of the stream ``name``."""
        self.name = name
        self.sources: list[Sampled] = []
        self.events: list[tuple[int, str, str]] = []  # time on the monotonic clock in ns, event, detail
        self.harmed: dict[int, bytes] = {}  # bytes sent instead of the frame, by row of the entry
        self._due_ns, self._sent_ns, self._number = array("q"), array("q"), array("q")
        self._size, self._cause, self._invisible, self._source = array("q"), array("b"), array("b"), array("h")

    def __len__(self) -> int:
        return len(self._source)  # the column that is written last, because a ledger may be read while it grows

    def add(self, item: SentItem, due_ns: int, sent_ns: int, size: int, cause: str) -> None:
        """Add an item and the number of its bytes, ``size``, that were sent at ``sent_ns``."""
        if cause not in UNHARMED and size:
            self.harmed[len(self)] = item.data[:size]
        self._due_ns.append(due_ns)
        self._sent_ns.append(sent_ns if size else 0)
        self._number.append(item.number)
        self._size.append(size)
        self._cause.append(CODES[cause])
        self._invisible.append(item.invisible)
        self._source.append(len(self.sources) - 1)

    def add_event(self, t_ns: int, event: str, detail: str = "") -> None:
        """Add an event: opened, closed, unplug, replug, heard, rate, clock."""
        self.events.append((t_ns, event, detail))

    @property
    def entries(self) -> list[LedgerEntry]:
        """All entries."""
        return [self.entry(row) for row in range(len(self))]

    def entry(self, row: int) -> LedgerEntry:
        """Return one entry."""
        cause = CAUSES[self._cause[row]]
        size, invisible = self._size[row], bool(self._invisible[row])
        sent_ns, number = self._sent_ns[row], self._number[row]
        return LedgerEntry(self._due_ns[row], sent_ns, number, size, cause, invisible, self._source[row])

    def column(self, name: str) -> AnyArray:
        """Return a column (entry,): ``due_ns``, ``sent_ns``, ``number``, ``size``, ``cause`` (code), ..."""
        values: array[int] = getattr(self, f"_{name}")
        return np.array(values[: len(self)], dtype=np.int64)

    @property
    def counts(self) -> dict[str, int]:
        """The number of entries by cause. Entries without a fault are counted as "sent"."""
        codes = self.column("cause")
        counts = {cause or "sent": int((codes == code).sum()) for code, cause in enumerate(CAUSES)}
        return {cause: count for cause, count in counts.items() if count}

    @property
    def intact_rows(self) -> Int64s:
        """Indices of the entries that were sent unchanged (entry,)."""
        codes = np.array([CODES[cause] for cause in UNHARMED])
        count = len(self)  # same length for all columns; another thread may append meanwhile
        size, cause, number = (self.column(name)[:count] for name in ("size", "cause", "number"))
        return np.flatnonzero((size > 0) & np.isin(cause, codes) & (number >= 0))

    def samples(self, rows: Sequence[int] | Int64s | None = None) -> Samples:
        """Return the samples that a perfect link returns for entries, by default for all `intact_rows`.

        They are generated again from the source, encoded and decoded. ``rows`` has the index of the entry of each sample.
        """
        entries = self.intact_rows if rows is None else np.asarray(rows, dtype=np.int64)
        sensor = self.sources[-1].sensor
        parts = [decode_frames(sensor, sensor.encode(part)) for part in self._parts(entries)]
        return concatenate(parts)

    def frames(self, rows: Sequence[int] | Int64s | None = None) -> list[bytes]:
        """Return the frames of entries without faults, by default of all `intact_rows`."""
        entries = self.intact_rows if rows is None else np.asarray(rows, dtype=np.int64)
        frames: list[bytes] = []
        for part in self._parts(entries):
            sensor = self.sources[-1].sensor
            frames += split_frames(sensor, sensor.encode(part))
        return frames

    def _parts(self, rows: Int64s) -> Iterator[Samples]:
        """Yield the samples of entries in runs from one block of a source."""
        numbers, sources = self.column("number")[rows], self.column("source")[rows]
        blocks = np.array(
            [number // self.sources[source].rows for number, source in zip(numbers, sources, strict=True)]
        )
        edges = np.flatnonzero((np.diff(blocks) != 0) | (np.diff(sources) != 0)) + 1
        for part in np.split(np.arange(len(rows)), edges):
            if len(part):
                source, block = self.sources[sources[part[0]]], int(blocks[part[0]])
                yield take_rows(source.block(block), numbers[part] - block * source.rows)


def take_rows(samples: Samples, rows: Int64s) -> Samples:
    """Return the samples of the frames ``rows``, in this order."""
    if samples.rows is not None:  # several samples per frame, such as the points of a cloud
        parts = [np.flatnonzero(samples.rows == row) for row in rows]
        positions = np.repeat(np.arange(len(rows), dtype=np.int64), [len(part) for part in parts])
        return Samples(tuple(values[np.concatenate(parts)] for values in samples.values), rows=positions)
    seq, t_device_ns, device_seq = (
        None if column is None else column[rows] for column in (samples.seq, samples.t_device_ns, samples.device_seq)
    )
    return Samples(tuple(values[rows] for values in samples.values), seq, t_device_ns, device_seq)


STAMPS = ("t_ns", "t_uncertain_ns", "t_device_ns", "seq", "device_seq")  # columns of a stream that are not channels


def sent_columns(samples: Samples) -> list[AnyArray]:
    """Return the values of each channel (sample,)."""
    return [column for block in samples.values for column in block.T]


def recorded_columns(table: pa.Table) -> list[AnyArray]:
    """Return the values of each channel of a recorded stream (sample,), without stamps and counters."""
    names = [name for name in table.column_names if name not in STAMPS]
    return [table.column(name).to_numpy(zero_copy_only=False) for name in names]


def keys(columns: Sequence[AnyArray]) -> list[bytes]:
    """Return all values of each sample as bytes (sample,), by which samples can be compared within one process.

    Texts are represented by their hashes.
    """
    text_columns = [column for column in columns if column.dtype.kind == "O"]
    number_columns = [column for column in columns if column.dtype.kind != "O"]
    number_columns += [np.array([hash(str(cell)) for cell in column.tolist()]) for column in text_columns]
    column_bytes = [np.ascontiguousarray(column).view(np.uint8).reshape(len(column), -1) for column in number_columns]
    return [row.tobytes() for row in np.hstack(column_bytes)]


def start_of(table: pa.Table, samples: Samples) -> int | None:
    """Return the row of ``samples`` from which on they are those of a recorded stream, one by one; None if nowhere.

    The stream must be one of a sensor that counts: its first count shows where to look.
    """
    assert samples.seq is not None
    recorded, sent = recorded_columns(table), sent_columns(samples)
    for start in np.flatnonzero(samples.seq == table.column("seq")[0].as_py()).tolist():
        stop = start + table.num_rows
        if all(
            np.array_equal(recorded_column, sent_column[start:stop], equal_nan=True)
            for recorded_column, sent_column in zip(recorded, sent, strict=True)
        ):
            return int(start)
    return None
