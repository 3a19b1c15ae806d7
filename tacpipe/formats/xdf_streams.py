"""Read an XDF file as a container: LSL streams with timestamps on the recorder's clock, and their clock offsets.

``lsl_ns`` is the time of a sample on the clock of the recording computer: the sender's timestamp, corrected by our fit
of the offsets measured during the recording. ``t_device_ns`` is the sender's timestamp. Like LSL's clock, both count
from the start of a computer.
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
from tacpipe.formats import container, xdf_chunks
from tacpipe.formats.container import Batched, EpisodeContents, SourceStream, Time
from tacpipe.formats.xdf_chunks import Chunk, DamagedChunk
from tacpipe.io import regular
from tacpipe.io.spill import Piece, Spill, unpack
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, plain
from tacpipe.signals import clocks

STAMP = "lsl_ns"
RAW = "t_device_ns"
OFFSETS = " clock offsets"  # suffix of the name of a stream's offsets
UNDESCRIBED = "the file does not describe it"
CLOCK = "LSL's, of the computer that recorded"
SPILL_ROWS = 1 << 16  # samples per stream in memory before they are written to the spill file
PASSED_BYTES = 1 << 26  # number of bytes read before their pages are released
COMPRESSED_BYTES = 1 << 20  # number of bytes decompressed at once


@dataclass
class _StreamReading:
    """The samples, stamps and offsets of a stream read so far."""

    about: lsl.LslDescription
    spill: Spill
    stamps: list[Floats] = field(default_factory=list)
    values: list[AnyArray] = field(default_factory=list)  # (sample, channel), samples not yet written to the spill file
    pieces: list[Piece] = field(default_factory=list)
    waiting: int = 0  # number of samples in ``values``
    offsets: list[tuple[float, float]] = field(default_factory=list)  # clock reading, offset to add
    rows_before: list[int] = field(default_factory=list)  # (offset,), number of samples before it in the file
    rows: int = 0
    missing: int = 0  # number of samples in incomplete chunks
    declared: int | None = None  # number of samples according to the footer

    def add_samples(self, content: bytes) -> None:
        """Add the samples of a chunk; timestamps that are not written continue at the stream's rate."""
        channels = len(self.about.channels)
        samples = (
            xdf_chunks.parse_texts(content, channels)
            if self.about.is_text
            else xdf_chunks.parse_numbers(content, np.dtype(self.about.dtype), channels)
        )
        if samples is None:
            self.missing += 1
            return
        last = float(self.stamps[-1][-1]) if self.rows else 0.0
        period_s = 1 / self.about.rate_hz if self.about.rate_hz else 0.0
        self.missing += samples.missing
        if len(samples.stamps):
            self.stamps.append(xdf_chunks.fill_stamps(samples.stamps, last, period_s))
            self.values.append(samples.values)
            self.rows += len(samples.stamps)
            self.waiting += len(samples.stamps)
            if self.waiting >= SPILL_ROWS:
                self.pieces.append(self.spill.add(pa.table(self._columns(), pa.schema(self.fields))))
                self.values, self.waiting = [], 0

    @property
    def fields(self) -> list[pa.Field]:
        """The fields of the channels."""
        reserved = [STAMP, RAW, "t_ns"]
        kind = pa.string() if self.about.is_text else pa.from_numpy_dtype(self.about.dtype)
        return [
            pa.field(
                channel.name if channel.name not in reserved else f"{channel.name}_channel",
                kind,
                metadata=channel.metadata,
            )
            for channel in self.about.channels
        ]

    def channels(self) -> Iterator[list[pa.ChunkedArray]]:
        """Yield the values of the channels in batches of samples."""
        for piece in self.pieces:
            yield self.spill.read(piece).columns
        if self.waiting:
            yield self._columns()

    def _columns(self) -> list[pa.ChunkedArray]:
        values = np.concatenate(self.values)
        return [pa.chunked_array([pa.array(values[:, at], field.type)]) for at, field in enumerate(self.fields)]


@dataclass
class _FileReading:
    """The streams, header and damage of a file."""

    spill: Spill = field(default_factory=Spill)
    streams: dict[int, _StreamReading] = field(default_factory=dict)
    headers: dict[int, bytes] = field(default_factory=dict)  # XML descriptions of the streams
    unknown: dict[int, str] = field(default_factory=dict)  # reason by stream whose description cannot be read
    header: bytes = b""
    damage: list[DamagedChunk] = field(default_factory=list)
    cut_at: int | None = None  # offset of the incomplete chunk at the end of a truncated file

    def notes(self, path: Path) -> list[str]:
        """Return sentences about missing data."""
        sentences = []
        if self.damage:
            size, first = sum(damage.bytes for damage in self.damage), self.damage[0].at
            places = (
                f"in {len(self.damage)} places, the first at byte {first:,},"
                if len(self.damage) > 1
                else f"from byte {first:,} on"
            )
            sentences.append(f"{path}: {size:,} bytes {places} are not XDF and were left out.")
        if self.cut_at is not None:
            sentences.append(f"{path} was cut off at byte {self.cut_at:,}, within a chunk; what stands before is read.")
        undescribed = sum(reason == UNDESCRIBED for reason in self.unknown.values())
        if undescribed:
            sentences.append(
                f"{path} has samples of {undescribed} streams that it does not describe; they were left out."
            )
        return sentences


@dataclass(frozen=True)
class XdfFile:
    """An XDF file as a container."""

    path: Path

    def episodes(self) -> Sequence[str]:
        """Return an empty sequence, because a file is one recording."""
        return ()

    def look(self, episode: str | None) -> EpisodeContents:
        """Return the full contents; without an index, a preview must read the whole file."""
        return self.read(None, episode)

    def read(self, sources: Collection[str] | None, episode: str | None) -> EpisodeContents:
        """Return the streams, and the clock offsets of each stream that was compared with the recorder's clock.

        Raises `TacpipeError` if the file is not XDF.
        """
        reading = self._read()
        sources_by_number = _stream_sources(reading.streams)
        names = container.identifiers(
            [name for source in sources_by_number.values() for name in (source, source + OFFSETS)]
        )
        streams: list[SourceStream] = []
        attributes = _file_attributes(reading.header)
        notes = reading.notes(self.path)
        skipped = {f"stream {number}": reason for number, reason in reading.unknown.items() if reason != UNDESCRIBED}
        for number, source in sources_by_number.items():
            stream = reading.streams[number]
            if not stream.rows:
                skipped[source] = "it has no samples"
                continue
            times_or_reason = _recorder_times(stream)
            if isinstance(times_or_reason, str):
                skipped[source] = times_or_reason
                continue
            t_ns, facts, remarks = times_or_reason
            notes += [f"{self.path}: {plain(source)} {remark}" for remark in [*remarks, *_describe_losses(stream)]]
            attributes |= {f"{names[source]}_{name}": value for name, value in facts.items()}
            streams.append(
                SourceStream(source, names[source], Time(STAMP, "ns"), _stream_content(stream, t_ns), stream.rows)
            )
            if stream.offsets:
                offsets = _offsets_table(stream)
                name = names[source + OFFSETS]
                streams.append(SourceStream(source + OFFSETS, name, Time(STAMP, "ns"), offsets, offsets.num_rows))
        selected = [stream for stream in streams if sources is None or stream.source in sources]
        return EpisodeContents(selected, attributes, skipped, notes)

    def _read(self) -> _FileReading:
        """Read all chunks of the file. Raises `TacpipeError` if it is not XDF."""
        reading = _FileReading()
        try:
            content = _open_content(self.path)
            passed = 0  # bytes since pages were last released
            for chunk in xdf_chunks.read_chunks(content):
                _add_chunk(reading, chunk, self.path)
                if isinstance(content, mmap.mmap) and chunk.at >= passed + PASSED_BYTES:
                    # without this, the whole file stays mapped in memory
                    content.madvise(mmap.MADV_DONTNEED, passed, PASSED_BYTES)
                    passed += PASSED_BYTES
        except (OSError, zlib.error) as error:
            raise TacpipeError(f"{self.path} cannot be read: {error}.") from error
        except UsageError:
            raise
        except TacpipeError as error:
            raise TacpipeError(f"{self.path} is not an XDF file: {error}.") from error
        return reading


def _open_content(path: Path) -> xdf_chunks.Content:
    """Return the decompressed bytes of a file, up to the cut if a compressed file is truncated."""
    with regular.failing(path), regular.opened(path) as file, tempfile.TemporaryFile() as unpacked:
        head = file.read(2)
        if head == b"\x1f\x8b":
            file.seek(0)
            unpack(_gzip_blocks(file), unpacked, path)
            unpacked.flush()
            head = b"" if not unpacked.tell() else head
        if not head:
            return b""
        return mmap.mmap((unpacked if head == b"\x1f\x8b" else file).fileno(), 0, access=mmap.ACCESS_READ)


def _gzip_blocks(file: BinaryIO) -> Iterator[bytes]:
    """Yield the content of a file of one or more gzip members, up to the cut if it is truncated."""
    stream = zlib.decompressobj(wbits=31)
    while data := file.read(COMPRESSED_BYTES):
        while data:
            if stream.eof:
                stream = zlib.decompressobj(wbits=31)
            yield stream.decompress(data, COMPRESSED_BYTES)
            data = stream.unused_data if stream.eof else stream.unconsumed_tail
    while not stream.eof and (block := stream.decompress(stream.unconsumed_tail, COMPRESSED_BYTES)):
        yield block


def _add_chunk(read: _FileReading, chunk: Chunk | DamagedChunk, path: Path) -> None:
    """Add a chunk to the contents read so far."""
    if isinstance(chunk, DamagedChunk):
        read.damage.append(chunk)
        return
    if not chunk.is_complete:
        read.cut_at = chunk.at
    if chunk.tag == xdf_chunks.FILE_HEADER:
        read.header = chunk.content
    elif chunk.stream is None:
        return
    elif chunk.tag == xdf_chunks.STREAM_HEADER:
        _store_description(read, chunk.stream, chunk, path)
    elif chunk.stream not in read.streams:
        read.unknown.setdefault(chunk.stream, UNDESCRIBED)
    elif chunk.tag == xdf_chunks.SAMPLES:
        read.streams[chunk.stream].add_samples(chunk.content)
    elif chunk.tag == xdf_chunks.CLOCK_OFFSET and len(chunk.content) >= 16:
        stream = read.streams[chunk.stream]
        stream.offsets.append(struct.unpack_from("<dd", chunk.content))
        stream.rows_before.append(stream.rows)
    elif chunk.tag == xdf_chunks.STREAM_FOOTER:
        read.streams[chunk.stream].declared = _sample_count(chunk.content)


def _store_description(read: _FileReading, stream: int, chunk: Chunk, path: Path) -> None:
    """Store the description of a stream. Raises `UsageError` for a second, different description."""
    before = read.headers.get(stream)
    if before is None:
        read.headers[stream] = chunk.content
        try:
            read.streams[stream] = _StreamReading(lsl.parse(chunk.content), read.spill)
        except TacpipeError as error:
            read.unknown[stream] = str(error)
    elif before != chunk.content:
        raise UsageError(
            f"{path} describes the stream {stream} twice, again at byte {chunk.at:,} and otherwise, so its samples cannot "
            f"be assigned. If files were joined to it, take them apart."
        )


def _sample_count(footer: bytes) -> int | None:
    """Return the number of samples in a footer, or None if it has none."""
    try:
        text = ET.fromstring(footer.decode(errors="replace")).findtext("sample_count", "")
    except ET.ParseError:
        return None
    return int(text) if text.isdecimal() else None


def _stream_sources(streams: Mapping[int, _StreamReading]) -> dict[int, str]:
    """Return the source name of each stream: its name, with its number if the name is not unique."""
    names = {number: stream.about.name or stream.about.kind or f"stream {number}" for number, stream in streams.items()}
    name_list = list(names.values())
    return {number: name if name_list.count(name) == 1 else f"{name} {number}" for number, name in names.items()}


def _file_attributes(header: bytes) -> dict[str, Attribute]:
    """Return the attribute with the start of the recording, if the file header has one."""
    try:
        stamp = ET.fromstring(header.decode(errors="replace")).findtext("datetime", "").strip()
    except ET.ParseError:
        return {}
    return {"recorded_at": stamp} if stamp else {}


def _describe_losses(stream: _StreamReading) -> list[str]:
    """Return sentences about the missing samples of a stream."""
    losses = [f"lacks {stream.missing} samples of a chunk that is not whole."] if stream.missing else []
    if stream.declared is not None and stream.declared != stream.rows:
        losses.append(f"has {stream.rows:,} samples, and its footer counts {stream.declared:,}.")
    return losses


def _recorder_times(stream: _StreamReading) -> tuple[Times, dict[str, Attribute], list[str]] | str:
    """Return sample times on the recorder's clock (sample,), attributes of the clock fit, and remarks.

    Returns a reason instead if the times cannot be determined.
    """
    raw_s = np.concatenate(stream.stamps)
    if not (np.abs(raw_s) < lsl.MAX_TIME_S).all():
        return f"its stamp {excerpt(float(raw_s[~(np.abs(raw_s) < lsl.MAX_TIME_S)][0]))} is not a time in seconds"
    raw_ns = lsl.nanoseconds(raw_s)
    measured = _valid_offsets(stream)
    attributes: dict[str, Attribute] = {}
    remarks: list[str] = []
    t_ns = raw_ns
    if len(measured):
        lines = clocks.fit_offsets(measured[:, 0], measured[:, 1])
        starts = [0, *(_reset_row(stream, raw_ns, measured, line.start) for line in lines[1:])]
        t_ns = clocks.times_by_offsets(lines, starts, raw_ns)
        longest = max(lines, key=lambda line: line.stop - line.start)
        attributes = {"lsl_drift_ppm": round(longest.drift * 1e6, 3), "lsl_clock_resets": len(lines) - 1}
    else:
        remarks.append("has no clock offsets: its stamps are taken for the recorder's.")
    back_ns = np.maximum.accumulate(t_ns) - t_ns
    if back_ns.any():
        rows = int(np.count_nonzero(back_ns))
        if not len(measured) and back_ns.max() > clocks.STEP_NS and rows > len(t_ns) // 2:
            row = int(back_ns.argmax())
            return (
                f"its clock went back by {back_ns[row] / 1e9:.6g} s at sample {row + 1}, and no clock offset states by how "
                "much it was set"
            )
        remarks.append(
            f"has {rows:,} stamps before the one above, by up to {back_ns.max() / 1e9:.6g} s: t_ns has that one for them."
        )
    return t_ns + back_ns, attributes, remarks


def _valid_offsets(stream: _StreamReading) -> Int64s:
    """Return the finite clock offsets in ns, shape (measurement, reading and offset)."""
    offsets_s = np.array(stream.offsets, dtype=np.float64).reshape(-1, 2)
    return np.column_stack([lsl.nanoseconds(column) for column in offsets_s[_is_valid(offsets_s)].T])


def _is_valid(offsets_s: Floats) -> AnyArray:
    return np.asarray((np.abs(offsets_s) < lsl.MAX_TIME_S).all(axis=1))


def _reset_row(stream: _StreamReading, raw_ns: Times, measured: Int64s, first: int) -> int:
    """Return the first sample after the sender's clock was reset. ``first`` is the first measurement after the reset.

    The sample is between that measurement and the previous one or, because samples are written late, just after it.
    """
    valid_rows = np.flatnonzero(_is_valid(np.array(stream.offsets, dtype=np.float64)))
    rows = [*(stream.rows_before[place] for place in valid_rows.tolist()), len(raw_ns)]
    low, high = rows[first - 1], min(rows[first + 1], len(raw_ns))
    steps = np.diff(raw_ns[max(low - 1, 0) : high])
    if not len(steps):
        return min(rows[first], len(raw_ns))
    jump = int(np.abs(steps - np.median(steps)).argmax())
    expected = measured[first, 0] - measured[first - 1, 0]
    if abs(int(steps[jump])) < abs(int(expected)) / 2 and (steps >= 0).all():
        return min(rows[first], len(raw_ns))  # no sample shows the reset, because none was sent in between
    return max(low - 1, 0) + jump + 1


def _stream_content(stream: _StreamReading, t_ns: Times) -> pa.Table | Batched:
    """Return the samples with their timestamps: a table if there are few, else batches from the spill file."""
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


def _offsets_table(stream: _StreamReading) -> pa.Table:
    """Return the measured clock offsets: the times on both clocks and the offset to add."""
    offsets_s = np.array(stream.offsets, dtype=np.float64).reshape(-1, 2)
    offsets_s = offsets_s[_is_valid(offsets_s)]
    sent_ns, offset_ns = (lsl.nanoseconds(column) for column in offsets_s.T)
    field = pa.field("offset_s", pa.float64(), metadata={"unit": "s", "quantity": "time"})
    columns = [pa.array(np.maximum.accumulate(sent_ns + offset_ns)), pa.array(sent_ns), pa.array(offsets_s[:, 1])]
    return pa.Table.from_arrays(columns, schema=pa.schema([_time_field(STAMP), _time_field(RAW), field]))
