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
from typing import BinaryIO, NamedTuple
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

RECORDER_TIME, SENDER_TIME = "lsl_ns", "t_device_ns"  # names of columns
OFFSETS_SUFFIX = " clock offsets"  # appended to a stream's name, it names the stream of its clock offsets
UNDESCRIBED = "the file does not describe it"
RECORDER_CLOCK, SENDER_CLOCK = "LSL's, of the computer that recorded", "LSL's, of the sender"
SPILL_ROWS = 1 << 16  # samples per stream in memory before they are written to the spill file
RELEASE_BYTES = 1 << 26  # number of bytes read before their pages are released
INFLATE_BYTES = 1 << 20  # maximum number of bytes decompressed at once


@dataclass
class _StreamReading:
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

    def add_samples(self, content: bytes) -> None:
        """Add the samples of a chunk. Omitted timestamps continue at the stream's rate."""
        channels = len(self.about.channels)
        samples = (
            xdf_chunks.parse_texts(content, channels)
            if self.about.is_text
            else xdf_chunks.parse_numbers(content, np.dtype(self.about.dtype), channels)
        )
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
    streams: dict[int, _StreamReading] = field(default_factory=dict)
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
            [name for source in sources_by_number.values() for name in (source, source + OFFSETS_SUFFIX)]
        )
        streams: list[SourceStream] = []
        attributes = _file_attributes(reading.header)
        notes = reading.notes(self.path)
        skipped = {f"stream {number}": reason for number, reason in reading.unreadable.items() if reason != UNDESCRIBED}
        for number, source in sources_by_number.items():
            stream = reading.streams[number]
            if not stream.rows:
                skipped[source] = "it has no samples"
                continue
            times = _recorder_times(stream)
            if isinstance(times, str):
                skipped[source] = times
                continue
            notes += [
                f"{self.path}: {plain(source)} {remark}" for remark in [*times.remarks, *_describe_losses(stream)]
            ]
            attributes |= {f"{names[source]}_{name}": value for name, value in times.attributes.items()}
            content = _stream_content(stream, times.t_ns)
            streams.append(SourceStream(source, names[source], Time(RECORDER_TIME, "ns"), content, stream.rows))
            if stream.offsets:
                offsets, offsets_source = _offsets_table(stream), source + OFFSETS_SUFFIX
                name = names[offsets_source]
                streams.append(SourceStream(offsets_source, name, Time(RECORDER_TIME, "ns"), offsets, offsets.num_rows))
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
        reading.streams[chunk.stream].declared_rows = _sample_count(chunk.content)


def _store_description(reading: _FileReading, stream: int, chunk: Chunk, path: Path) -> None:
    """Store the description of a stream. Raises `UsageError` for a second, different description."""
    first_header = reading.headers.get(stream)
    if first_header is None:
        reading.headers[stream] = chunk.content
        try:
            reading.streams[stream] = _StreamReading(lsl.parse(chunk.content), reading.spill)
        except TacpipeError as error:
            reading.unreadable[stream] = str(error)
    elif first_header != chunk.content:
        raise UsageError(
            f"{path} describes the stream {stream} twice, again at byte {chunk.at:,} and otherwise, so its samples cannot "
            f"be assigned. If files were joined to it, take them apart."
        )


def _sample_count(footer: bytes) -> int | None:
    """Return the number of samples according to a footer, or None if the footer does not contain it."""
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
    if stream.declared_rows is not None and stream.declared_rows != stream.rows:
        losses.append(f"has {stream.rows:,} samples, and its footer counts {stream.declared_rows:,}.")
    return losses


class _RecorderTimes(NamedTuple):
    """The times of a stream's samples on the recorder's clock."""

    t_ns: Times  # (sample,)
    attributes: dict[str, Attribute]  # properties of the fit of the clock offsets
    remarks: list[str]


def _recorder_times(stream: _StreamReading) -> _RecorderTimes | str:
    """Return the times of a stream's samples, or the reason why they cannot be determined."""
    raw_s = np.concatenate(stream.stamps)
    is_time = np.abs(raw_s) < lsl.MAX_TIME_S
    if not is_time.all():
        return f"its stamp {excerpt(float(raw_s[~is_time][0]))} is not a time in seconds"
    raw_ns = lsl.nanoseconds(raw_s)
    measured = _valid_offsets(stream)
    attributes: dict[str, Attribute] = {}
    remarks: list[str] = []
    t_ns = raw_ns
    if len(measured):
        lines = clocks.fit_offsets(measured[:, 0], measured[:, 1])
        starts = [0, *(_reset_row(stream, raw_ns, measured, line.start) for line in lines[1:])]
        t_ns = clocks.convert_by_segment(lines, starts, raw_ns)
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
    return _RecorderTimes(t_ns + back_ns, attributes, remarks)


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
    rows = [*(stream.rows_before[row] for row in valid_rows.tolist()), len(raw_ns)]
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
    schema = pa.schema([_time_field(RECORDER_TIME), _time_field(SENDER_TIME), *stream.fields])
    raw_ns = lsl.nanoseconds(np.concatenate(stream.stamps))

    def read() -> Iterator[pa.Table]:
        start = 0
        for columns in stream.channels():
            stop = start + len(columns[0])
            yield pa.table([pa.array(t_ns[start:stop]), pa.array(raw_ns[start:stop]), *columns], schema)
            start = stop

    return Batched(schema, stream.rows, read) if stream.pieces else next(read())


def _time_field(name: str) -> pa.Field:
    clock = RECORDER_CLOCK if name == RECORDER_TIME else SENDER_CLOCK
    return pa.field(name, pa.int64(), metadata={"unit": "ns", "quantity": "time", "clock": clock})


def _offsets_table(stream: _StreamReading) -> pa.Table:
    """Return the measured clock offsets: the times on both clocks and the offset to add."""
    offsets_s = np.array(stream.offsets, dtype=np.float64).reshape(-1, 2)
    offsets_s = offsets_s[_is_valid(offsets_s)]
    sent_ns, offset_ns = (lsl.nanoseconds(column) for column in offsets_s.T)
    field = pa.field("offset_s", pa.float64(), metadata={"unit": "s", "quantity": "time"})
    columns = [pa.array(np.maximum.accumulate(sent_ns + offset_ns)), pa.array(sent_ns), pa.array(offsets_s[:, 1])]
    schema = pa.schema([_time_field(RECORDER_TIME), _time_field(SENDER_TIME), field])
    return pa.Table.from_arrays(columns, schema=schema)
