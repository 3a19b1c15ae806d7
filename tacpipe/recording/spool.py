"""The spool: what came over the links of a rig, byte for byte, in a file that is only ever appended to.

A recording's folder in the store holds

- ``header.json``: what is recorded and for whom, and the UTC time of one reading of the monotonic clock;
- ``bytes``: blocks, each with a mark, a check sum, and the chunks of one stream with their arrival, or a note on a stream or
  on the recording, as how it ended;
- ``tally``: how much every stream has received so far, in memory shared with the disk cache: what a killed process had
  read and not yet written is known from it.

What is written outlasts the process; what is synced outlasts a loss of power. A block that is torn or damaged ends what
can be read of it, and the next mark begins anew.
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

ENDED = "ended"  # a note on the recording
TALLY = struct.Struct("<QQq")  # chunks, bytes, last arrival
RECOVER = "free some space, and `tacpipe acquire --recover` seals it"  # after a full disk


def now() -> dict[str, int]:
    """Return one reading of the monotonic clock and the UTC time then, both in ns; of five tries the tightest."""
    tries = []
    for _ in range(5):
        before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        tries.append((after_ns - before_ns, (before_ns + after_ns) // 2, utc_ns))
    _, monotonic_ns, utc_ns = min(tries)
    return {"monotonic_ns": monotonic_ns, "utc_ns": utc_ns}


class Spool:
    """A spool that is being written. One thread appends; the threads that read links each `tally` their own stream."""

    def __init__(self, store: Path, header: Mapping[str, Any], streams: Sequence[str]) -> None:
        self.folder = store / FOLDER / uuid.uuid4().hex
        self.streams = {name: number for number, name in enumerate(streams)}
        self.clock = now()
        refuse_link(store)
        with readable_errors(store):
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            self.folder.mkdir(mode=0o700)
            entry = {**header, "streams": list(streams), "clock": self.clock}
            self._file = os.open(self.folder / "bytes", os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
            fcntl.flock(self._file, fcntl.LOCK_EX)  # until the process ends: nobody recovers what is being written
            self._tally = _tally(self.folder, len(streams))
            content = json.dumps(entry, sort_keys=True).encode()
            write_whole(str(self.folder / "header.json"), content, str(self.folder / ".header.json"))
            for folder in (self.folder, self.folder.parent):
                sync_folder(str(folder))
        self._waiting: list[bytes] = []
        self.failed: OSError | None = None  # what the disk stated to a sync: it states it once

    def tally(self, stream: int, chunks: int, size: int, last_ns: int) -> None:
        """Note how much a stream has received in all, before it is appended."""
        TALLY.pack_into(self._tally, stream * TALLY.size, chunks, size, last_ns)

    def append(self, stream: str, chunks: Chunks) -> None:
        """Add what came over a link; it is on its way to the disk with the next `write`."""
        if len(chunks.size):
            body = chunks.t_ns.astype("<i8").tobytes() + chunks.size.astype("<u4").tobytes() + chunks.data
            self._waiting.append(spool_blocks.of(spool_blocks.CHUNKS, self.streams[stream], len(chunks.size), body))

    def note(self, note: Note) -> None:
        """Add a note."""
        body = json.dumps({"t_ns": note.t_ns, "what": note.what, "detail": note.detail}).encode()
        self._waiting.append(
            spool_blocks.of(
                spool_blocks.NOTE, self.streams[note.stream] if note.stream else spool_blocks.WHOLE, 0, body
            )
        )

    def write(self) -> None:
        """Hand over what was added to the operating system: it outlasts this process.

        Raises `TacpipeError` when the disk takes nothing more.
        """
        left = memoryview(b"".join(self._waiting))
        self._waiting = []
        try:
            if self.failed is not None:
                raise self.failed
            while left:
                left = left[os.write(self._file, left) :]
        except OSError as error:
            raise TacpipeError(
                f"The disk takes nothing more of the recording ({error.strerror}), so it ended. What came until then is in "
                f"{self.folder}; {RECOVER}."
            ) from error

    def sync(self) -> None:
        """Have what was written outlast a loss of power; a disk that fails is reported by the next `write`."""
        try:
            os.fdatasync(self._file)
        except OSError as error:
            self.failed = error

    def finish(self) -> None:
        """Write and sync the rest. Nobody else recovers it until `close`. Raises as `write`."""
        self.write()
        self.sync()
        self.write()
        self._tally.flush()

    def close(self) -> None:
        """Finish, and let go of it."""
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
        os.posix_fallocate(
            handle, 0, max(1, streams) * TALLY.size
        )  # a hole that a full disk cannot fill kills its writer
        return mmap.mmap(handle, max(1, streams) * TALLY.size)
    finally:
        os.close(handle)
