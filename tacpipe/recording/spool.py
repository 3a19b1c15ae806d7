"""Write and read a spool: the bytes of a rig's links in an append-only file.

The folder of a spool contains

- ``header.json``: the output and the name of the recording, and the UTC time of one reading of the monotonic clock;
- ``bytes``: blocks, each with a mark, a checksum, and either the chunks of one stream with their arrival times, or a note on
  a stream or on the recording, such as how it ended;
- ``tally``: the totals that each stream has received, in a memory-mapped file. It shows how many bytes a killed process had
  read but not written.

Written bytes survive the end of the process; synced bytes survive a power failure. Reading resumes at the next mark after an
incomplete or damaged block.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import json
import mmap
import os
import struct
import time
import uuid
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import make_folder, readable_errors, sync_folder, user_name, write_whole
from tacpipe.recording import spool_folders
from tacpipe.sensors.framing import Chunks
from tacpipe.store import layout

MARK = b"tacB"
HEAD = struct.Struct("<4sIBBHII")  # mark, checksum of the remaining block, kind, stream, 0, chunks, bytes of the body
CHUNKS, NOTE = 0, 1  # kinds of blocks
WHOLE = 255  # stream number of a note on the whole recording; its stream name is ""


@dataclass(frozen=True)
class StreamNote:
    """An event of a stream, such as a link that opened or was lost. ``what`` is the kind of event."""

    t_ns: int
    stream: str
    what: str
    detail: str = ""


def pack_block(kind: int, stream: int, count: int, body: bytes) -> bytes:
    """Return a block with ``body``, which contains ``count`` chunks of the stream with number ``stream``."""
    covered = HEAD.pack(MARK, 0, kind, stream, 0, count, len(body))[8:]
    return MARK + struct.pack("<I", zlib.crc32(body, zlib.crc32(covered))) + covered + body


def find_end(content: mmap.mmap, start: int) -> int | None:
    """Return the end of the block at offset ``start``, or None if no complete and undamaged block starts there."""
    if start + HEAD.size > len(content) or content[start : start + 4] != MARK:
        return None
    _, check, _, _, _, _, size = HEAD.unpack_from(content, start)
    stop = start + HEAD.size + int(size)
    if stop > len(content):
        return None
    with memoryview(content) as view, view[start + 8 : stop] as covered:
        return stop if zlib.crc32(covered) == check else None


def find_next(handle: int, content: mmap.mmap, offset: int) -> int:
    """Return the next offset after ``offset`` at which a block may start. Holes of the file are skipped."""
    try:
        data = os.lseek(handle, offset, os.SEEK_DATA)
        if data > offset:
            return min(data, len(content))
        stop = min(os.lseek(handle, offset, os.SEEK_HOLE), len(content))
    except OSError as error:
        if error.errno == errno.ENXIO:  # ENXIO: only a hole follows
            return len(content)
        stop = len(content)  # the file system reports no holes
    mark = content.find(MARK, offset + 1, stop)
    return stop if mark < 0 else mark


def unpack_block(kind: int, stream: str, count: int, body: bytes) -> Chunks | StreamNote | None:
    """Return the content of a block of ``count`` chunks, or None if it is invalid although its checksum is right.

    The kind is `CHUNKS` or `NOTE`.
    """
    try:
        if kind == NOTE:
            entry = json.loads(body)
            return StreamNote(int(entry["t_ns"]), stream, str(entry["what"]), str(entry["detail"]))
        stamps = np.frombuffer(body, "<i8", count)
        sizes = np.frombuffer(body, "<u4", count, 8 * count).astype(np.int64)
    except (ValueError, LookupError, TypeError, RecursionError, OverflowError):
        return None
    if kind != CHUNKS or not count or int(sizes.sum()) != len(body) - 12 * count:
        return None
    return Chunks(stamps.astype(np.int64), sizes, body[12 * count :])


ENDED = "ended"  # kind of a note on the whole recording
TALLY = struct.Struct("<QQq")  # chunks, bytes, last arrival in ns
RECOVER = "free some space, and `tacpipe acquire --recover` seals it"  # advice if the disk is full


def read_clocks() -> spool_folders.ClockReading:
    """Return the time of the monotonic clock and of UTC at one instant, in ns; the quickest of five readings."""
    readings = []
    for _ in range(5):
        before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, (before_ns + after_ns) // 2, utc_ns))
    _, monotonic_ns, utc_ns = min(readings)
    return {"monotonic_ns": monotonic_ns, "utc_ns": utc_ns}


class Spool:
    """A spool that is being written. One thread appends; the threads that read links call `tally` for their streams."""

    def __init__(self, store: Path, header: spool_folders.RecordingHeader, streams: Sequence[str]) -> None:
        """Create the folder of a spool in ``store``, with its header, and lock it."""
        self.folder = store / spool_folders.FOLDER / uuid.uuid4().hex
        self.streams = {name: index for index, name in enumerate(streams)}
        self.clock = read_clocks()
        spool_folders.refuse_link(store)
        with readable_errors(store):
            make_folder(self.folder.parent)
            self.folder.mkdir(mode=0o700)
            spool_header: spool_folders.SpoolHeader = {**header, "streams": list(streams), "clock": self.clock}
            self._file = os.open(self.folder / "bytes", os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
            fcntl.flock(self._file, fcntl.LOCK_EX)  # no other process recovers a locked spool
            self._tally = _create_tally(self.folder, len(streams))
            content = json.dumps(spool_header, sort_keys=True).encode()
            write_whole(str(self.folder / "header.json"), content, str(self.folder / ".header.json"))
            for folder in (self.folder, self.folder.parent):
                sync_folder(str(folder))
        self._pending: list[bytes] = []
        self.failed: OSError | None = None  # error of a sync, which the operating system reports only once

    def tally(self, stream: int, chunks: int, size: int, last_ns: int) -> None:
        """Store the totals that a stream has received. Call it before the bytes are appended."""
        TALLY.pack_into(self._tally, stream * TALLY.size, chunks, size, last_ns)

    def append(self, stream: str, chunks: Chunks) -> None:
        """Queue bytes of a link for the next `write`."""
        if len(chunks.size):
            body = chunks.t_ns.astype("<i8").tobytes() + chunks.size.astype("<u4").tobytes() + chunks.data
            self._pending.append(pack_block(CHUNKS, self.streams[stream], len(chunks.size), body))

    def note(self, note: StreamNote) -> None:
        """Queue a note for the next `write`."""
        body = json.dumps({"t_ns": note.t_ns, "what": note.what, "detail": note.detail}).encode()
        self._pending.append(pack_block(NOTE, self.streams[note.stream] if note.stream else WHOLE, 0, body))

    def write(self) -> None:
        """Write all queued blocks to the file, so that they survive this process.

        Raises `TacpipeError` if a write or an earlier sync fails.
        """
        remaining = memoryview(b"".join(self._pending))
        self._pending = []
        try:
            if self.failed is not None:
                raise self.failed
            while remaining:
                remaining = remaining[os.write(self._file, remaining) :]
        except OSError as error:
            raise TacpipeError(
                f"The disk accepts no more data of the recording ({error.strerror}), so it ended. The data so far are in "
                f"{self.folder}; {RECOVER}."
            ) from error

    def sync(self) -> None:
        """Sync the written bytes to the disk. If that fails, the next `write` raises the error."""
        try:
            os.fdatasync(self._file)
        except OSError as error:
            self.failed = error

    def finish(self) -> None:
        """Write and sync the remaining blocks. The spool stays locked until `close`. Raises `TacpipeError` like `write`."""
        self.write()
        self.sync()
        self.write()
        self._tally.flush()

    def close(self) -> None:
        """Finish and unlock the spool."""
        if self._file < 0:
            return
        try:
            self.finish()
        finally:
            os.close(self._file)
            self._file = -1


def _create_tally(folder: Path, streams: int) -> mmap.mmap:
    """Return the mapped file of the totals of all streams, filled with zeros."""
    handle = os.open(folder / "tally", os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
    try:
        # Allocate the file first: a write into a hole of a mapped file kills the process if the disk is full.
        os.posix_fallocate(handle, 0, max(1, streams) * TALLY.size)
        return mmap.mmap(handle, max(1, streams) * TALLY.size)
    finally:
        os.close(handle)


KEPT = layout.KEPT  # folder of the store for retained spools
RELEASE_BYTES = 1 << 23  # mapped memory is released in steps of this size, a multiple of the page size
MAX_HEADER_BYTES = 16 << 20


@dataclass(frozen=True)
class Damage:
    """Bytes of a spool outside of any valid block: cut off by a crash at the end, or damaged by the disk elsewhere."""

    offset: int
    bytes: int


@dataclass(frozen=True)
class Tallied:
    """The totals that a stream had received when the process ended, including bytes that were not spooled."""

    chunks: int
    bytes: int
    last_ns: int


class Spooled:
    """The spool of a recording that has ended, or whose process has ended.

    ``owners`` are the user ids that its files may have; None accepts any. Raises `TacpipeError` if it has no valid header.
    """

    def __init__(self, folder: Path, owners: frozenset[int] | None = None) -> None:
        """Read the header of the spool in ``folder``. Raises `TacpipeError` if it is missing or cannot be read.

        With ``owners``, files of users with other ids are rejected.
        """
        self.folder, self._owners = folder, owners
        try:
            with self._open("header.json") as file:
                content = file.read(MAX_HEADER_BYTES + 1)
            if len(content) > MAX_HEADER_BYTES:
                raise ValueError(f"it has more than {MAX_HEADER_BYTES:,} bytes")
            self.header: spool_folders.SpoolHeader = json.loads(content)
            self.streams: list[str] = [str(name) for name in self.header["streams"]]
        except FileNotFoundError:
            raise TacpipeError(
                f"The spool {folder} has no header: its process ended before the recording started."
            ) from None
        except (OSError, ValueError, LookupError, TypeError, RecursionError, OverflowError) as error:
            raise TacpipeError(
                f"The spool {folder} has no readable header ({error}): its process ended before the recording started. "
                f"Remove the folder."
            ) from error
        self.damage: list[Damage] = []
        self._notes: list[StreamNote] = []  # notes on the whole recording

    @property
    def ended(self) -> str:
        """How the recording ended, from the notes that `blocks` has read. Without such a note it was recovered."""
        entry = next((note.detail for note in self._notes if note.what == ENDED), "")
        return entry if entry in (spool_folders.COMPLETED, spool_folders.INTERRUPTED) else spool_folders.RECOVERED

    def blocks(self, stream: str | None = None) -> Iterator[tuple[str, Chunks | StreamNote]]:
        """Yield the chunks and notes of one stream, or of all streams, in the order in which they were appended.

        Bytes outside of valid blocks are skipped and added to ``damage``. Notes on the recording are collected for `ended`.
        """
        requested = None if stream is None else self.streams.index(stream)
        self.damage, self._notes = [], []
        with contextlib.ExitStack() as opened:
            file = opened.enter_context(self._open("bytes"))
            if not os.fstat(file.fileno()).st_size:
                return
            content = opened.enter_context(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
            start = released = 0
            while start < len(content):
                if start - released >= RELEASE_BYTES:  # spools can be larger than memory
                    content.madvise(mmap.MADV_DONTNEED, released, RELEASE_BYTES)
                    released += RELEASE_BYTES
                stop = find_end(content, start)
                if stop is None:
                    next_start = find_next(file.fileno(), content, start)
                    self._add_damage(start, next_start - start)
                    start = next_start
                    continue
                _, _, kind, stream_index, _, count, size = HEAD.unpack_from(content, start)
                if (requested is None or stream_index == requested) and stream_index < len(self.streams):
                    body = content[start + HEAD.size : start + HEAD.size + size]
                    entry = unpack_block(kind, self.streams[stream_index], count, body)
                    if entry is None:
                        self._add_damage(start, stop - start)
                    else:
                        yield self.streams[stream_index], entry
                elif stream_index == WHOLE:
                    entry = unpack_block(kind, "", count, content[start + HEAD.size : start + HEAD.size + size])
                    self._notes += [entry] if isinstance(entry, StreamNote) else []
                start = stop

    def _add_damage(self, offset: int, size: int) -> None:
        """Add unreadable bytes to ``damage``, joined to the previous entry if they follow it."""
        last = self.damage[-1] if self.damage else None
        if last is not None and last.offset + last.bytes == offset:
            self.damage[-1] = Damage(last.offset, last.bytes + size)
        else:
            self.damage.append(Damage(offset, size))

    def tallied(self) -> dict[str, Tallied]:
        """Return the totals that each stream had received; empty if the tally is missing or too short."""
        try:
            with self._open("tally") as file:
                content = file.read(len(self.streams) * TALLY.size)
            return {name: Tallied(*TALLY.unpack_from(content, n * TALLY.size)) for n, name in enumerate(self.streams)}
        except (FileNotFoundError, struct.error):  # other errors are raised, so that no loss is hidden
            return {}

    def utc_ns(self, t_ns: Any) -> Any:
        """Convert times of the monotonic clock to UTC, in ns."""
        clock = self.header["clock"]
        return t_ns + (clock["utc_ns"] - clock["monotonic_ns"])

    def remove(self) -> None:
        """Remove the spool. Call it after its content is sealed."""
        spool_folders.remove_spool(self.folder)

    def keep(self) -> Path:
        """Move the sealed spool to the store's folder of retained spools, and return its new path.

        Raises `TacpipeError` if that folder is a symbolic link.
        """
        target = self.folder.parent.parent / KEPT
        with readable_errors(target.parent):
            make_folder(target)
            if target.is_symlink():
                raise TacpipeError(f"{target} is a symbolic link. Remove it.")
            self.folder.rename(target / self.folder.name)
            for folder in (target, self.folder.parent, target.parent):
                sync_folder(str(folder))
        return target / self.folder.name

    def _open(self, name: str) -> io.FileIO:
        """Open a file of the spool. Raises `TacpipeError` if it belongs to another user or is not a regular file."""
        path = self.folder / name
        try:
            file = io.FileIO(path, opener=lambda name, _: os.open(name, spool_folders.READ))
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise TacpipeError(f"{path} is a symbolic link, which a spool never contains. Remove it.") from None
            raise
        try:
            status = os.fstat(file.fileno())
            regular.require(path, status.st_mode)
            if self._owners is not None and status.st_uid not in self._owners:
                raise TacpipeError(
                    f"{path} belongs to another user ({user_name(status.st_uid)}). Only this user can seal it."
                )
        except BaseException:
            file.close()
            raise
        return file
