"""An XDF file as a container: each stream of LSL with its stamps on the recorder's clock, and the clock offsets beside it.

``lsl_ns`` is when a sample was taken, on the clock of the computer that recorded: the stamp as it was sent, moved by our own
fit of the offsets that were measured meanwhile. The stamp as it was sent stays in ``t_device_ns``. Both count from when a
computer started, as LSL's clock does.
"""

from __future__ import annotations

import mmap
import struct
import tempfile
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree as ET

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Floats, Int64s, Times
from tacpipe.channels import lsl
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats import xdf_chunks
from tacpipe.formats.containers import kinds
from tacpipe.formats.containers.container import Batched, Contents, SourceStream, Time
from tacpipe.formats.xdf_chunks import Chunk, Damage
from tacpipe.io import regular
from tacpipe.io.spill import Piece, Spill, unpack
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, plain
from tacpipe.signals import clock_offsets, clocks

STAMP = "lsl_ns"
RAW = "t_device_ns"
OFFSETS = " clock offsets"  # what the name of a stream's offsets ends with
UNDESCRIBED = "the file does not describe it"
CLOCK = "LSL's, of the computer that recorded"
ASIDE_ROWS = 1 << 16  # samples of a stream, before they are put aside
PASSED_BYTES = 1 << 26  # of a file that was read, before memory lets go of them
COMPRESSED_BYTES = 1 << 20  # that are decompressed at once


@dataclass
class _Stream:
    """What was read of a stream so far."""

    about: lsl.Description
    aside: Spill
    stamps: list[Floats] = field(default_factory=list)
    values: list[AnyArray] = field(default_factory=list)  # (sample, channel), of samples that are not put aside
    pieces: list[Piece] = field(default_factory=list)
    waiting: int = 0  # samples of ``values``
    offsets: list[tuple[float, float]] = field(default_factory=list)  # reading of the sender's clock, and what to add
    rows_before: list[int] = field(default_factory=list)  # (offset,), samples that stand before it in the file
    rows: int = 0
    missing: int = 0  # samples of chunks that are not whole
    declared: int | None = None  # samples that the footer counts

    def take(self, content: bytes) -> None:
        """Take the samples of a chunk."""
        channels = len(self.about.channels)
        found = (
            xdf_chunks.texts(content, channels)
            if self.about.is_text
            else xdf_chunks.numbers(content, np.dtype(self.about.dtype), channels)
        )
        if found is None:
            self.missing += 1
            return
        last = float(self.stamps[-1][-1]) if self.rows else 0.0
        period_s = 1 / self.about.rate_hz if self.about.rate_hz else 0.0
        self.missing += found.missing
        if len(found.stamps):
            self.stamps.append(xdf_chunks.deduced(found.stamps, last, period_s))
            self.values.append(found.values)
            self.rows += len(found.stamps)
            self.waiting += len(found.stamps)
            if self.waiting >= ASIDE_ROWS:
                self.pieces.append(self.aside.add(pa.table(self._columns(), pa.schema(self.fields))))
                self.values, self.waiting = [], 0

    @property
    def fields(self) -> list[pa.Field]:
        """The fields of the channels."""
        taken = [STAMP, RAW, "t_ns"]
        kind = pa.string() if self.about.is_text else pa.from_numpy_dtype(self.about.dtype)
        return [
            pa.field(one.name if one.name not in taken else f"{one.name}_channel", kind, metadata=one.metadata)
            for one in self.about.channels
        ]

    def channels(self) -> Iterator[list[pa.ChunkedArray]]:
        """Yield the values of the channels, some samples at a time."""
        for piece in self.pieces:
            yield self.aside.read(piece).columns
        if self.waiting:
            yield self._columns()

    def _columns(self) -> list[pa.ChunkedArray]:
        values = np.concatenate(self.values)
        return [pa.chunked_array([pa.array(values[:, at], one.type)]) for at, one in enumerate(self.fields)]


@dataclass
class _Read:
    """What was read of a file."""

    aside: Spill = field(default_factory=Spill)
    streams: dict[int, _Stream] = field(default_factory=dict)
    headers: dict[int, bytes] = field(default_factory=dict)  # XML descriptions of the streams
    unknown: dict[int, str] = field(default_factory=dict)  # streams whose description cannot be read, with the reason
    header: bytes = b""
    damage: list[Damage] = field(default_factory=list)
    cut_at: int | None = None  # where the chunk begins that the file ends within

    def notes(self, path: Path) -> list[str]:
        """Return what is missing, in words."""
        found = []
        if self.damage:
            size, first = sum(one.bytes for one in self.damage), self.damage[0].at
            places = (
                f"in {len(self.damage)} places, the first at byte {first:,},"
                if len(self.damage) > 1
                else f"from byte {first:,} on"
            )
            found.append(f"{path}: {size:,} bytes {places} are not XDF and were left out.")
        if self.cut_at is not None:
            found.append(f"{path} was cut off at byte {self.cut_at:,}, within a chunk; what stands before is read.")
        undescribed = sum(why == UNDESCRIBED for why in self.unknown.values())
        if undescribed:
            found.append(f"{path} has samples of {undescribed} streams that it does not describe; they were left out.")
        return found


@dataclass(frozen=True)
class XdfFile:
    """An XDF file; `kinds.opened` gives one."""

    path: Path

    def episodes(self) -> Sequence[str]:
        """Return nothing: a file is one recording."""
        return ()

    def look(self, episode: str | None) -> Contents:
        """Return all that is in the file: it has no index, so a look reads it."""
        return self.read(None, episode)

    def read(self, sources: Collection[str] | None, episode: str | None) -> Contents:
        """Return the streams, and for each whose clock was compared with the recorder's its offsets as another one.

        Raises `TacpipeError` for a file that is not XDF.
        """
        read = self._read()
        named = _sources(read.streams)
        names = kinds.identifiers([one for source in named.values() for one in (source, source + OFFSETS)])
        found: list[SourceStream] = []
        attributes = _attributes(read.header)
        notes = read.notes(self.path)
        skipped = {f"stream {number}": why for number, why in read.unknown.items() if why != UNDESCRIBED}
        for number, source in named.items():
            stream = read.streams[number]
            if not stream.rows:
                skipped[source] = "it has no samples"
                continue
            made = _timed(stream)
            if isinstance(made, str):
                skipped[source] = made
                continue
            t_ns, facts, described = made
            notes += [f"{self.path}: {plain(source)} {one}" for one in [*described, *_losses(stream)]]
            attributes |= {f"{names[source]}_{name}": value for name, value in facts.items()}
            found.append(SourceStream(source, names[source], Time(STAMP, "ns"), _content_of(stream, t_ns), stream.rows))
            if stream.offsets:
                source += OFFSETS
                offsets = _offsets_table(stream)
                found.append(SourceStream(source, names[source], Time(STAMP, "ns"), offsets, offsets.num_rows))
        chosen = [one for one in found if sources is None or one.source in sources]
        return Contents(chosen, attributes, skipped, notes)

    def _read(self) -> _Read:
        read = _Read()
        try:
            content = _content(self.path)
            passed = 0  # bytes
            for chunk in xdf_chunks.chunks(content):
                _take(read, chunk, self.path)
                if isinstance(content, mmap.mmap) and chunk.at >= passed + PASSED_BYTES:
                    content.madvise(
                        mmap.MADV_DONTNEED, passed, PASSED_BYTES
                    )  # else the whole file stays mapped in memory
                    passed += PASSED_BYTES
        except (OSError, zlib.error) as error:
            raise TacpipeError(f"{self.path} cannot be read: {error}.") from error
        except UsageError:
            raise
        except TacpipeError as error:
            raise TacpipeError(f"{self.path} is not an XDF file: {error}.") from error
        return read


def _content(path: Path) -> xdf_chunks.Content:
    """Return the bytes of a file, decompressed; of a compressed one that was cut off those that are there."""
    with regular.failing(path), regular.opened(path) as file, tempfile.TemporaryFile() as unpacked:
        head = file.read(2)
        if head == b"\x1f\x8b":
            file.seek(0)
            unpack(_unpacked(file), unpacked, path)
            unpacked.flush()
            head = b"" if not unpacked.tell() else head
        if not head:
            return b""
        return mmap.mmap((unpacked if head == b"\x1f\x8b" else file).fileno(), 0, access=mmap.ACCESS_READ)


def _unpacked(file: BinaryIO) -> Iterator[bytes]:
    """Yield what a file of gzip holds, of which several may follow one another, up to where it was cut off."""
    stream = zlib.decompressobj(wbits=31)
    while data := file.read(COMPRESSED_BYTES):
        while data:
            if stream.eof:
                stream = zlib.decompressobj(wbits=31)
            yield stream.decompress(data, COMPRESSED_BYTES)
            data = stream.unused_data if stream.eof else stream.unconsumed_tail
    while not stream.eof and (block := stream.decompress(stream.unconsumed_tail, COMPRESSED_BYTES)):
        yield block


def _take(read: _Read, chunk: Chunk | Damage, path: Path) -> None:
    """Take a chunk into what was read."""
    if isinstance(chunk, Damage):
        read.damage.append(chunk)
        return
    if not chunk.whole:
        read.cut_at = chunk.at
    if chunk.tag == xdf_chunks.FILE_HEADER:
        read.header = chunk.content
    elif chunk.stream is None:
        return
    elif chunk.tag == xdf_chunks.STREAM_HEADER:
        _describe(read, chunk.stream, chunk, path)
    elif chunk.stream not in read.streams:
        read.unknown.setdefault(chunk.stream, UNDESCRIBED)
    elif chunk.tag == xdf_chunks.SAMPLES:
        read.streams[chunk.stream].take(chunk.content)
    elif chunk.tag == xdf_chunks.CLOCK_OFFSET and len(chunk.content) >= 16:
        one = read.streams[chunk.stream]
        one.offsets.append(struct.unpack_from("<dd", chunk.content))
        one.rows_before.append(one.rows)
    elif chunk.tag == xdf_chunks.STREAM_FOOTER:
        read.streams[chunk.stream].declared = _counted(chunk.content)


def _describe(read: _Read, stream: int, chunk: Chunk, path: Path) -> None:
    """Take the description of a stream. Raises `UsageError` for a second one that differs."""
    before = read.headers.get(stream)
    if before is None:
        read.headers[stream] = chunk.content
        try:
            read.streams[stream] = _Stream(lsl.parse(chunk.content), read.aside)
        except TacpipeError as error:
            read.unknown[stream] = str(error)
    elif before != chunk.content:
        raise UsageError(
            f"{path} describes the stream {stream} twice, again at byte {chunk.at:,} and otherwise, so its samples cannot "
            f"be assigned. If files were joined to it, take them apart."
        )


def _counted(footer: bytes) -> int | None:
    try:
        text = ET.fromstring(footer.decode(errors="replace")).findtext("sample_count", "")
    except ET.ParseError:
        return None
    return int(text) if text.isdecimal() else None


def _sources(streams: Mapping[int, _Stream]) -> dict[int, str]:
    """Return how each stream is named: by its name, with its number where two share one."""
    named = {number: one.about.name or one.about.kind or f"stream {number}" for number, one in streams.items()}
    several = list(named.values())
    return {number: name if several.count(name) == 1 else f"{name} {number}" for number, name in named.items()}


def _attributes(header: bytes) -> dict[str, Attribute]:
    try:
        stamp = ET.fromstring(header.decode(errors="replace")).findtext("datetime", "").strip()
    except ET.ParseError:
        return {}
    return {"recorded_at": stamp} if stamp else {}


def _losses(stream: _Stream) -> list[str]:
    """Return what of a stream is not there, in words."""
    found = [f"lacks {stream.missing} samples of a chunk that is not whole."] if stream.missing else []
    if stream.declared is not None and stream.declared != stream.rows:
        found.append(f"has {stream.rows:,} samples, and its footer counts {stream.declared:,}.")
    return found


def _timed(stream: _Stream) -> tuple[Times, dict[str, Attribute], list[str]] | str:
    """Return when samples were taken on the recorder's clock (sample,), facts about the clocks, and what is odd.

    Instead a reason where that cannot be known.
    """
    raw_s = np.concatenate(stream.stamps)
    if not (np.abs(raw_s) < lsl.LATEST_S).all():
        return f"its stamp {excerpt(float(raw_s[~(np.abs(raw_s) < lsl.LATEST_S)][0]))} is not a time in seconds"
    raw_ns = lsl.nanoseconds(raw_s)
    measured = _measured(stream)
    facts: dict[str, Attribute] = {}
    described: list[str] = []
    t_ns = raw_ns
    if len(measured):
        lines = clock_offsets.fit_offsets(measured[:, 0], measured[:, 1])
        starts = [0, *(_reset_row(stream, raw_ns, measured, line.start) for line in lines[1:])]
        t_ns = clock_offsets.host_times(lines, starts, raw_ns)
        longest = max(lines, key=lambda line: line.stop - line.start)
        facts = {"lsl_drift_ppm": round(longest.drift * 1e6, 3), "lsl_clock_resets": len(lines) - 1}
    else:
        described.append("has no clock offsets: its stamps are taken for the recorder's.")
    back_ns = np.maximum.accumulate(t_ns) - t_ns
    if back_ns.any():
        rows = int(np.count_nonzero(back_ns))
        if not len(measured) and back_ns.max() > clocks.STEP_NS and rows > len(t_ns) // 2:
            row = int(back_ns.argmax())
            return (
                f"its clock went back by {back_ns[row] / 1e9:.6g} s at sample {row + 1}, and no clock offset states by how "
                "much it was set"
            )
        described.append(
            f"has {rows:,} stamps before the one above, by up to {back_ns.max() / 1e9:.6g} s: t_ns has that one for them."
        )
    return t_ns + back_ns, facts, described


def _measured(stream: _Stream) -> Int64s:
    """Return the clock offsets (measurement, reading and offset in ns) that are numbers."""
    offsets_s = np.array(stream.offsets, dtype=np.float64).reshape(-1, 2)
    return np.column_stack([lsl.nanoseconds(column) for column in offsets_s[_sound(offsets_s)].T])


def _sound(offsets_s: Floats) -> AnyArray:
    return np.asarray((np.abs(offsets_s) < lsl.LATEST_S).all(axis=1))


def _reset_row(stream: _Stream, raw_ns: Times, measured: Int64s, first: int) -> int:
    """Return the first sample after the sender's clock was reset: the measurement ``first`` is the first one after it.

    It stands between that measurement and the one before, or, as samples are written late, the one behind.
    """
    sound = np.flatnonzero(_sound(np.array(stream.offsets, dtype=np.float64)))
    rows = [*(stream.rows_before[place] for place in sound.tolist()), len(raw_ns)]
    low, high = rows[first - 1], min(rows[first + 1], len(raw_ns))
    steps = np.diff(raw_ns[max(low - 1, 0) : high])
    if not len(steps):
        return min(rows[first], len(raw_ns))
    jump = int(np.abs(steps - np.median(steps)).argmax())
    expected = measured[first, 0] - measured[first - 1, 0]
    if abs(int(steps[jump])) < abs(int(expected)) / 2 and (steps >= 0).all():
        return min(rows[first], len(raw_ns))  # no sample shows it: none was sent meanwhile
    return max(low - 1, 0) + jump + 1


def _content_of(stream: _Stream, t_ns: Times) -> pa.Table | Batched:
    """Return the samples with their stamps: a table of few, else as they were put aside. The stamps are in memory."""
    schema = pa.schema([_time_field(STAMP), _time_field(RAW), *stream.fields])
    raw_ns = lsl.nanoseconds(np.concatenate(stream.stamps))

    def read() -> Iterator[pa.Table]:
        begin = 0
        for columns in stream.channels():
            end = begin + len(columns[0])
            yield pa.table([pa.array(t_ns[begin:end]), pa.array(raw_ns[begin:end]), *columns], schema)
            begin = end

    return Batched(schema, stream.rows, read) if stream.pieces else next(read())


def _time_field(name: str) -> pa.Field:
    about = {"unit": "ns", "quantity": "time", "clock": CLOCK if name == STAMP else "LSL's, of the sender"}
    return pa.field(name, pa.int64(), metadata=about)


def _offsets_table(stream: _Stream) -> pa.Table:
    """Return the clock offsets as they were measured: when on both clocks, and what was to be added."""
    offsets_s = np.array(stream.offsets, dtype=np.float64).reshape(-1, 2)
    offsets_s = offsets_s[_sound(offsets_s)]
    sent_ns, offset_ns = (lsl.nanoseconds(column) for column in offsets_s.T)
    field = pa.field("offset_s", pa.float64(), metadata={"unit": "s", "quantity": "time"})
    columns = [pa.array(np.maximum.accumulate(sent_ns + offset_ns)), pa.array(sent_ns), pa.array(offsets_s[:, 1])]
    return pa.Table.from_arrays(columns, schema=pa.schema([_time_field(STAMP), _time_field(RAW), field]))
