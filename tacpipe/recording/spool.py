"""Write a spool: the bytes of a rig's links in a file that is only ever appended to.

The folder of a recording in the store has

- ``header.json``: the output and the name of the recording, and the UTC time of one reading of the monotonic clock;
- ``bytes``: blocks, each with a mark, a check sum, and the chunks of one stream with their arrivals, or a note on a stream
  or on the recording, such as how it ended;
- ``tally``: how much every stream has received, in memory shared with the disk cache. It states the bytes that a killed
  process had read and not yet written.

Written bytes survive the end of the process; synced bytes survive a loss of power. Reading resumes at the next mark after a
torn or damaged block.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import struct
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tacpipe.errors import TacpipeError
from tacpipe.io.files import readable_errors, sync_folder, write_whole
from tacpipe.recording import spool_blocks
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.spool_folders import FOLDER, refuse_link
from tacpipe.sensors.framing import Chunks

ENDED = "ended"  # a note on the whole recording
TALLY = struct.Struct("<QQq")  # chunks, bytes, last arrival
RECOVER = "free some space, and `tacpipe acquire --recover` seals it"  # advice after a full disk


def read_clocks() -> dict[str, int]:
    """Return one reading of the monotonic clock and the UTC time then, both in ns: the tightest of five tries."""
    tries = []
    for _ in range(5):
        before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        tries.append((after_ns - before_ns, (before_ns + after_ns) // 2, utc_ns))
    _, monotonic_ns, utc_ns = min(tries)
    return {"monotonic_ns": monotonic_ns, "utc_ns": utc_ns}


class Spool:
    """A spool that is being written. One thread appends; the threads that read links `tally` their streams."""

    def __init__(self, store: Path, header: Mapping[str, Any], streams: Sequence[str]) -> None:
        self.folder = store / FOLDER / uuid.uuid4().hex
        self.streams = {name: number for number, name in enumerate(streams)}
        self.clock = read_clocks()
        refuse_link(store)
        with readable_errors(store):
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            self.folder.mkdir(mode=0o700)
            entry = {**header, "streams": list(streams), "clock": self.clock}
            self._file = os.open(self.folder / "bytes", os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
            fcntl.flock(self._file, fcntl.LOCK_EX)  # until the process ends, so that no process recovers it meanwhile
            self._tally = _tally(self.folder, len(streams))
            content = json.dumps(entry, sort_keys=True).encode()
            write_whole(str(self.folder / "header.json"), content, str(self.folder / ".header.json"))
            for folder in (self.folder, self.folder.parent):
                sync_folder(str(folder))
        self._waiting: list[bytes] = []
        self.failed: OSError | None = None  # error of a sync, which the disk reports only once

    def tally(self, stream: int, chunks: int, size: int, last_ns: int) -> None:
        """Note how much a stream has received in total, before it is appended."""
        TALLY.pack_into(self._tally, stream * TALLY.size, chunks, size, last_ns)

    def append(self, stream: str, chunks: Chunks) -> None:
        """Add bytes of a link. The next `write` hands them to the operating system."""
        if len(chunks.size):
            body = chunks.t_ns.astype("<i8").tobytes() + chunks.size.astype("<u4").tobytes() + chunks.data
            self._waiting.append(
                spool_blocks.pack_block(spool_blocks.CHUNKS, self.streams[stream], len(chunks.size), body)
            )

    def note(self, note: Note) -> None:
        """Add a note."""
        body = json.dumps({"t_ns": note.t_ns, "what": note.what, "detail": note.detail}).encode()
        self._waiting.append(
            spool_blocks.pack_block(
                spool_blocks.NOTE, self.streams[note.stream] if note.stream else spool_blocks.WHOLE, 0, body
            )
        )

    def write(self) -> None:
        """Hand all added blocks to the operating system, so that they survive this process.

        Raises `TacpipeError` when the disk accepts no more bytes.
        """
        remaining = memoryview(b"".join(self._waiting))
        self._waiting = []
        try:
            if self.failed is not None:
                raise self.failed
            while remaining:
                remaining = remaining[os.write(self._file, remaining) :]
        except OSError as error:
            raise TacpipeError(
                f"The disk takes nothing more of the recording ({error.strerror}), so it ended. What came until then is in "
                f"{self.folder}; {RECOVER}."
            ) from error

    def sync(self) -> None:
        """Sync the written bytes to the disk. The next `write` reports a failed disk."""
        try:
            os.fdatasync(self._file)
        except OSError as error:
            self.failed = error

    def finish(self) -> None:
        """Write and sync the remaining blocks. No process recovers the spool until `close`. Raises as `write`."""
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


def _tally(folder: Path, streams: int) -> mmap.mmap:
    handle = os.open(folder / "tally", os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
    try:
        # A process that writes into a hole of a mapped file is killed where the disk is full.
        os.posix_fallocate(handle, 0, max(1, streams) * TALLY.size)
        return mmap.mmap(handle, max(1, streams) * TALLY.size)
    finally:
        os.close(handle)
