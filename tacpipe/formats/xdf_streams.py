"""Read an XDF file as a container: LSL streams with timestamps on the recorder's clock, and their clock offsets.

``lsl_ns`` is the time of a sample on the clock of the recording computer: the sender's timestamp, corrected by our fit
of the offsets measured during the recording. ``t_device_ns`` is the sender's timestamp. Like LSL's clock, both count
from the start of a computer.
"""

from __future__ import annotations

import mmap
import os
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

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.channels import lsl
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats import container, xdf_chunks, xdf_restarts
from tacpipe.formats.container import Batched, Container, EpisodeContents, SourceStream, Time
from tacpipe.formats.xdf_chunks import Chunk, DamagedChunk
from tacpipe.formats.xdf_times import is_valid, recorder_times
from tacpipe.io import regular
from tacpipe.io.spill import Piece, Spill, unpack
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import plain

RECORDER_TIME, SENDER_TIME = "lsl_ns", "t_device_ns"  # names of columns
OFFSETS_SUFFIX = " clock offsets"  # appended to a stream's name, it names the stream of its clock offsets
UNDESCRIBED = "the file does not describe it"
RECORDER_CLOCK, SENDER_CLOCK = "LSL's, of the computer that recorded", "LSL's, of the sender"
SPILL_ROWS = 1 << 16  # samples per stream in memory before they are written to the spill file
RELEASE_BYTES = 1 << 26  # number of bytes read before their pages are released
INFLATE_BYTES = 1 << 20  # maximum number of bytes decompressed at once


@dataclass
class StreamReading:
    """The samples, timestamps and clock offsets of a stream that have been read so far."""

    about: lsl.LslDescription
    spill: Spill
    stamps: list[Floats] = field(default_factory=list)
    values: list[AnyArray] = field(default_factory=list)  # (sample, channel), samples not yet written to the spill file
    pieces: list[Piece] = field(default_factory=list)
    unspilled_rows: int = 0  # number of samples in ``values``
    # reading of the sender's clock, offset to add, in s
    offsets: list[tuple[float, float]] = field(default_factory=list)
    rows_before: list[int] = field(default_factory=list)  # (offset,), number of samples before it in the file
    rows: int = 0
    missing: int = 0  # number of samples in incomplete chunks
    declared_rows: int | None = None  # number of samples according to the footer
    t_ns: Times = field(default_factory=lambda: np.zeros(0, np.int64))  # (sample,), times on the recorder's clock
    fit: Mapping[str, Attribute] = field(default_factory=dict)  # properties of the fit of the clock offsets

    def add_samples(self, content: bytes) -> None:
        """Add the samples of a chunk. Omitted timestamps continue at the stream's rate."""
        channels = len(self.about.channels)
        kind = None if self.about.is_text else np.dtype(self.about.dtype)
        samples = xdf_chunks.parse_samples(content, kind, channels)
        if samples is None:
            self.missing += 1
            return
        last_s = float(self.stamps[-1][-1]) if self.rows else 0.0
        period_s = 1 / self.about.rate_hz if self.about.rate_hz else 0.0
        self.missing += samples.missing
        if len(samples.stamps):
            self.stamps.append(xdf_chunks.fill_stamps(samples.stamps, last_s, period_s))
            self.values.append(samples.values)
            self.rows += len(samples.stamps)
            self.unspilled_rows += len(samples.stamps)
            if self.unspilled_rows >= SPILL_ROWS:
                self.pieces.append(self.spill.add(pa.table(self._columns(), pa.schema(self.fields))))
                self.values, self.unspilled_rows = [], 0

    @property
    def fields(self) -> list[pa.Field]:
        """The fields of the channels."""
        reserved = [RECORDER_TIME, SENDER_TIME, "t_ns"]
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
        if self.unspilled_rows:
            yield self._columns()

    def _columns(self) -> list[pa.ChunkedArray]:
        values = np.concatenate(self.values)
        return [pa.chunked_array([pa.array(values[:, index], field.type)]) for index, field in enumerate(self.fields)]


@dataclass
class _FileReading:
    """The streams, header and damage of a file."""

    spill: Spill = field(default_factory=Spill)
    streams: dict[int, StreamReading] = field(default_factory=dict)
    headers: dict[int, bytes] = field(default_factory=dict)  # XML descriptions of the streams
    unreadable: dict[int, str] = field(default_factory=dict)  # stream -> reason why its description cannot be read
    header: bytes = b""
    damage: list[DamagedChunk] = field(default_factory=list)
    cut_at: int | None = None  # offset of the incomplete chunk at the end of a truncated file

    def notes(self, path: Path) -> list[str]:
        """Return sentences about missing data."""
        sentences = []
        if self.damage:
            size, first = sum(chunk.bytes for chunk in self.damage), self.damage[0].at
            places = (
                f"in {len(self.damage)} places, the first at byte {first:,},"
                if len(self.damage) > 1
                else f"from byte {first:,} on"
            )
            sentences.append(f"{path}: {size:,} bytes {places} are not XDF and were left out.")
        if self.cut_at is not None:
            sentences.append(f"{path} was cut off at byte {self.cut_at:,}, within a chunk; what stands before is read.")
        undescribed = sum(reason == UNDESCRIBED for reason in self.unreadable.values())
        if undescribed:
            sentences.append(
                f"{path} has samples of {undescribed} streams that it does not describe; they were left out."
            )
        return sentences


@dataclass(frozen=True)
class XdfFile(Container):
    """An XDF file, which is one recording. Without an index, a preview must read the whole file."""

    path: Path

    def read(self, sources: Collection[str] | None, episode: str | None) -> EpisodeContents:
        """Return the streams, and the clock offsets of each stream that was compared with the recorder's clock.

        Raises `TacpipeError` if the file is not XDF.
        """
        reading = self._read()
        sources_by_number = _stream_sources(reading.streams)
        notes = reading.notes(self.path)
        skipped = {f"stream {number}": reason for number, reason in reading.unreadable.items() if reason != UNDESCRIBED}
        timed: dict[int, StreamReading] = {}
        for number, stream in reading.streams.items():
            times = recorder_times(stream) if stream.rows else "it has no samples"
            if isinstance(times, str):
                skipped[sources_by_number[number]] = times
                continue
            stream.t_ns, stream.fit, remarks = times
            timed[number] = stream
            remarks += _describe_losses(stream)
            notes += [f"{self.path}: {plain(sources_by_number[number])} {remark}" for remark in remarks]
        groups = xdf_restarts.join_restarts(timed)
        notes += [f"{self.path}: {note}" for note in xdf_restarts.describe_groups(timed, groups, sources_by_number)]
        for group in groups:
            name = timed[group[0]].about.name
            if len(group) == sum(stream.about.name == name for stream in reading.streams.values()) > 1:
                sources_by_number |= dict.fromkeys(group, name)
        suffixes = ("", OFFSETS_SUFFIX)
        names = container.identifiers(
            [source + suffix for source in dict.fromkeys(sources_by_number.values()) for suffix in suffixes]
        )
        streams: list[SourceStream] = []
        start = _xml_text(reading.header, "datetime")
        attributes: dict[str, Attribute] = {"recorded_at": start} if start else {}
        for group in groups:
            source, parts = sources_by_number[group[0]], [timed[number] for number in group]
            longest = max(parts, key=lambda part: part.rows)
            attributes |= {f"{names[source]}_{name}": value for name, value in longest.fit.items()}
            contents = {source: _stream_content(parts)}
            if offsets := [_offsets_table(part) for part in parts if part.offsets]:
                contents[source + OFFSETS_SUFFIX] = pa.concat_tables(offsets).sort_by(RECORDER_TIME)
            for name, content in contents.items():
                rows = content.rows if isinstance(content, Batched) else content.num_rows
                streams.append(SourceStream(name, names[name], Time(RECORDER_TIME, "ns"), content, rows))
        selected = [stream for stream in streams if sources is None or stream.source in sources]
        return EpisodeContents(selected, attributes, skipped, notes)

    def _read(self) -> _FileReading:
        """Read all chunks of the file. Raises `TacpipeError` if it is not XDF."""
        reading = _FileReading()
        try:
            content = _open_content(self.path)
            released = 0  # number of bytes at the start of the file whose pages have been released
            for chunk in xdf_chunks.read_chunks(content):
                _add_chunk(reading, chunk, self.path)
                if isinstance(content, mmap.mmap) and chunk.at >= released + RELEASE_BYTES:
                    # otherwise, all pages that were read would stay in memory
                    content.madvise(mmap.MADV_DONTNEED, released, RELEASE_BYTES)
                    released += RELEASE_BYTES
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
        content: BinaryIO = file
        if file.read(2) == b"\x1f\x8b":  # gzip
            file.seek(0)
            unpack(_gzip_blocks(file), unpacked, path)
            unpacked.flush()
            content = unpacked
        if not content.seek(0, os.SEEK_END):  # an empty file cannot be mapped
            return b""
        return mmap.mmap(content.fileno(), 0, access=mmap.ACCESS_READ)


def _gzip_blocks(file: BinaryIO) -> Iterator[bytes]:
    """Yield the content of a file of one or more gzip members, up to the cut if it is truncated."""
    stream = zlib.decompressobj(wbits=31)
    while data := file.read(INFLATE_BYTES):
        while data:
            if stream.eof:
                stream = zlib.decompressobj(wbits=31)
            yield stream.decompress(data, INFLATE_BYTES)
            data = stream.unused_data if stream.eof else stream.unconsumed_tail
    while not stream.eof and (block := stream.decompress(stream.unconsumed_tail, INFLATE_BYTES)):
        yield block


def _add_chunk(reading: _FileReading, chunk: Chunk | DamagedChunk, path: Path) -> None:
    """Add a chunk to the contents read so far."""
    if isinstance(chunk, DamagedChunk):
        reading.damage.append(chunk)
        return
    if not chunk.is_complete:
        reading.cut_at = chunk.at
    if chunk.tag == xdf_chunks.FILE_HEADER:
        reading.header = chunk.content
    elif chunk.stream is None:
        return
    elif chunk.tag == xdf_chunks.STREAM_HEADER:
        _store_description(reading, chunk.stream, chunk, path)
    elif chunk.stream not in reading.streams:
        reading.unreadable.setdefault(chunk.stream, UNDESCRIBED)
    elif chunk.tag == xdf_chunks.SAMPLES:
        reading.streams[chunk.stream].add_samples(chunk.content)
    elif chunk.tag == xdf_chunks.CLOCK_OFFSET and len(chunk.content) >= 16:
        stream = reading.streams[chunk.stream]
        stream.offsets.append(struct.unpack_from("<dd", chunk.content))
        stream.rows_before.append(stream.rows)
    elif chunk.tag == xdf_chunks.STREAM_FOOTER:
        count = _xml_text(chunk.content, "sample_count")
        reading.streams[chunk.stream].declared_rows = int(count) if count.isdecimal() else None


def _store_description(reading: _FileReading, stream: int, chunk: Chunk, path: Path) -> None:
    """Store the description of a stream. Raises `UsageError` for a second, different description."""
    first_header = reading.headers.get(stream)
    if first_header is None:
        reading.headers[stream] = chunk.content
        try:
            reading.streams[stream] = StreamReading(lsl.parse(chunk.content), reading.spill)
        except TacpipeError as error:
            reading.unreadable[stream] = str(error)
    elif first_header != chunk.content:
        raise UsageError(
            f"{path} describes the stream {stream} twice, again at byte {chunk.at:,} and otherwise, so its samples cannot "
            f"be assigned. If files were joined to it, take them apart."
        )


def _xml_text(content: bytes, name: str) -> str:
    """Return the text of an entry of a header or footer, or "" if it has none or is damaged."""
    try:
        return ET.fromstring(content.decode(errors="replace")).findtext(name, "").strip()
    except ET.ParseError:
        return ""


def _stream_sources(streams: Mapping[int, StreamReading]) -> dict[int, str]:
    """Return the source name of each stream: its name, with its number if the name is not unique."""
    names = {number: stream.about.name or stream.about.kind or f"stream {number}" for number, stream in streams.items()}
    name_list = list(names.values())
    return {number: name if name_list.count(name) == 1 else f"{name} {number}" for number, name in names.items()}


def _describe_losses(stream: StreamReading) -> list[str]:
    """Return sentences about the missing samples of a stream."""
    losses = [f"lacks {stream.missing} samples of a chunk that is not whole."] if stream.missing else []
    if stream.declared_rows is not None and stream.declared_rows != stream.rows:
        losses.append(f"has {stream.rows:,} samples, and its footer counts {stream.declared_rows:,}.")
    return losses


def _stream_content(parts: Sequence[StreamReading]) -> pa.Table | Batched:
    """Return the samples of the parts of a stream with their timestamps, in their order.

    They are a table if there are few, else batches from the spill file.
    """
    schema = pa.schema([_time_field(RECORDER_TIME), _time_field(SENDER_TIME), *parts[0].fields])

    def read() -> Iterator[pa.Table]:
        for part in parts:
            raw_ns, start = lsl.nanoseconds(np.concatenate(part.stamps)), 0
            for columns in part.channels():
                stop = start + len(columns[0])
                yield pa.table([pa.array(part.t_ns[start:stop]), pa.array(raw_ns[start:stop]), *columns], schema)
                start = stop

    is_spilled = any(part.pieces for part in parts)
    return Batched(schema, sum(part.rows for part in parts), read) if is_spilled else pa.concat_tables(read())


def _time_field(name: str) -> pa.Field:
    clock = RECORDER_CLOCK if name == RECORDER_TIME else SENDER_CLOCK
    return pa.field(name, pa.int64(), metadata={"unit": "ns", "quantity": "time", "clock": clock})


def _offsets_table(stream: StreamReading) -> pa.Table:
    """Return the measured clock offsets: the times on both clocks and the offset to add."""
    offsets_s = np.array(stream.offsets, dtype=np.float64).reshape(-1, 2)
    offsets_s = offsets_s[is_valid(offsets_s)]
    sent_ns, offset_ns = (lsl.nanoseconds(column) for column in offsets_s.T)
    field = pa.field("offset_s", pa.float64(), metadata={"unit": "s", "quantity": "time"})
    columns = [pa.array(np.maximum.accumulate(sent_ns + offset_ns)), pa.array(sent_ns), pa.array(offsets_s[:, 1])]
    schema = pa.schema([_time_field(RECORDER_TIME), _time_field(SENDER_TIME), field])
    return pa.Table.from_arrays(columns, schema=schema)
