"""Read the spool of a recording that has ended, or whose process has."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import mmap
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import readable_errors, sync_folder
from tacpipe.recording import spool, spool_folders
from tacpipe.recording.ending import COMPLETED, INTERRUPTED, RECOVERED
from tacpipe.recording.spool import ENDED, TALLY, StreamNote
from tacpipe.sensors.framing import Chunks
from tacpipe.store import layout

KEPT = layout.KEPT  # folder of the store
PASSED_BYTES = 1 << 23  # release mapped memory in such steps, a multiple of the page size
HEADER_BYTES = 16 << 20  # limit of the header's size


@dataclass(frozen=True)
class Damage:
    """Bytes of a spool that are no block: torn off by a crash at its end, damaged by the disk elsewhere."""

    offset: int
    bytes: int


@dataclass(frozen=True)
class Tallied:
    """The total that a stream had received when the process ended, spooled or not."""

    chunks: int
    bytes: int
    last_ns: int


class Spooled:
    """The spool of a recording that has ended, or whose process has.

    ``owners`` are the user ids that its files may have; None: any. Raises `TacpipeError` for a spool without a header.
    """

    def __init__(self, folder: Path, owners: frozenset[int] | None = None) -> None:
        self.folder, self._owners = folder, owners
        try:
            with self._open("header.json") as file:
                content = file.read(HEADER_BYTES + 1)
            if len(content) > HEADER_BYTES:
                raise ValueError(f"it has more than {HEADER_BYTES:,} bytes")
            self.header: dict[str, Any] = json.loads(content)
            self.streams: list[str] = [str(name) for name in self.header["streams"]]
        except FileNotFoundError:
            raise TacpipeError(f"The spool {folder} has no header: its process ended before it recorded.") from None
        except (OSError, ValueError, LookupError, TypeError, RecursionError, OverflowError) as error:
            raise TacpipeError(
                f"The spool {folder} has no readable header ({error}): its recording ended before it began. "
                f"Remove the folder."
            ) from error
        self.damage: list[Damage] = []
        self._notes: list[StreamNote] = []  # notes on the whole recording

    @property
    def ended(self) -> str:
        """How the recording ended, by the blocks that were read. Without a note of its end it was recovered."""
        entry = next((note.detail for note in self._notes if note.what == ENDED), "")
        return entry if entry in (COMPLETED, INTERRUPTED) else RECOVERED

    def blocks(self, stream: str | None = None) -> Iterator[tuple[str, Chunks | StreamNote]]:
        """Yield the chunks and notes of one stream, or of all, in the order in which they were appended.

        Bytes that are no block are skipped and noted in ``damage``. Notes on the recording are collected for `ended`.
        """
        requested = None if stream is None else self.streams.index(stream)
        self.damage, self._notes = [], []
        with contextlib.ExitStack() as opened:
            file = opened.enter_context(self._open("bytes"))
            if not os.fstat(file.fileno()).st_size:
                return
            content = opened.enter_context(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
            place = passed = 0
            while place < len(content):
                if place - passed >= PASSED_BYTES:  # spools are larger than memory, so release what was read
                    content.madvise(mmap.MADV_DONTNEED, passed, PASSED_BYTES)
                    passed += PASSED_BYTES
                stop = spool.find_end(content, place)
                if stop is None:
                    next_place = spool.find_next(file.fileno(), content, place)
                    self._add_damage(place, next_place - place)
                    place = next_place
                    continue
                _, _, kind, number, _, count, size = spool.HEAD.unpack_from(content, place)
                if (requested is None or number == requested) and number < len(self.streams):
                    body = content[place + spool.HEAD.size : place + spool.HEAD.size + size]
                    entry = spool.unpack_block(kind, self.streams[number], count, body)
                    if entry is None:
                        self._add_damage(place, stop - place)
                    else:
                        yield self.streams[number], entry
                elif number == spool.WHOLE:
                    entry = spool.unpack_block(
                        kind, "", count, content[place + spool.HEAD.size : place + spool.HEAD.size + size]
                    )
                    self._notes += [entry] if isinstance(entry, StreamNote) else []
                place = stop

    def _add_damage(self, offset: int, size: int) -> None:
        last = self.damage[-1] if self.damage else None
        if last is not None and last.offset + last.bytes == offset:
            self.damage[-1] = Damage(last.offset, last.bytes + size)
        else:
            self.damage.append(Damage(offset, size))

    def tallied(self) -> dict[str, Tallied]:
        """Return the total that each stream had received."""
        try:
            with self._open("tally") as file:
                content = file.read(len(self.streams) * TALLY.size)
            return {name: Tallied(*TALLY.unpack_from(content, n * TALLY.size)) for n, name in enumerate(self.streams)}
        except (FileNotFoundError, struct.error):  # other errors are raised, so that losses are not forgotten
            return {}

    def utc_ns(self, t_ns: Any) -> Any:
        """Return UTC time in ns for stamps of the monotonic clock."""
        clock = self.header["clock"]
        return t_ns + (clock["utc_ns"] - clock["monotonic_ns"])

    def remove(self) -> None:
        """Remove the spool after its content is sealed."""
        spool_folders.remove(self.folder)

    def keep(self) -> Path:
        """Move the sealed spool to a folder where no command looks for spools, and return its new path."""
        target = self.folder.parent.parent / KEPT
        with readable_errors(target.parent):
            target.mkdir(mode=0o777, exist_ok=True)
            if target.is_symlink():
                raise TacpipeError(f"{target} is a symbolic link. Remove it.")
            self.folder.rename(target / self.folder.name)
            for folder in (target, self.folder.parent, target.parent):
                sync_folder(str(folder))
        return target / self.folder.name

    def _open(self, name: str) -> io.FileIO:
        """Open one of its files. Raises `TacpipeError` for a file of another user or one that is not regular."""
        path = self.folder / name
        try:
            file = io.FileIO(path, opener=lambda name, _: os.open(name, spool_folders.READ))
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise TacpipeError(f"{path} is a symbolic link, and no spool holds one. Remove it.") from None
            raise
        try:
            status = os.fstat(file.fileno())
            regular.require(path, status.st_mode)
            if self._owners is not None and status.st_uid not in self._owners:
                raise TacpipeError(
                    f"{path} belongs to another user ({spool_folders.user(status.st_uid)}), who alone can seal it."
                )
        except BaseException:
            file.close()
            raise
        return file
