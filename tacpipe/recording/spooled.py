"""A spool that is read: of a recording that has ended, or whose process has."""

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
from tacpipe.recording import spool_blocks, spool_folders
from tacpipe.recording.ending import COMPLETED, INTERRUPTED, RECOVERED
from tacpipe.recording.spool import ENDED, TALLY
from tacpipe.recording.spool_blocks import Note
from tacpipe.sensors.framing import Chunks
from tacpipe.store import layout

KEPT = layout.KEPT  # within the store
PASSED_BYTES = 1 << 23  # whole pages
HEADER_BYTES = 16 << 20  # at most


@dataclass(frozen=True)
class Damage:
    """Bytes of a spool that are not a block: at its end what a crash tore off, elsewhere what a disk did."""

    offset: int
    bytes: int


@dataclass(frozen=True)
class Tallied:
    """What a stream had received when the process ended, spooled or not."""

    chunks: int
    bytes: int
    last_ns: int


class Spooled:
    """A spool that is read: of a recording that has ended, or whose process has.

    ``owners`` are the user ids that its files may have; None: any. Raises `TacpipeError` for a spool without a header.
    """

    def __init__(self, folder: Path, owners: frozenset[int] | None = None) -> None:
        self.folder, self._owners = folder, owners
        try:
            with self._opened("header.json") as file:
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
        self._notes: list[Note] = []  # on the recording

    @property
    def ended(self) -> str:
        """How the recording ended, as far as its blocks were read: one whose process did not end it was recovered."""
        entry = next((note.detail for note in self._notes if note.what == ENDED), "")
        return entry if entry in (COMPLETED, INTERRUPTED) else RECOVERED

    def blocks(self, stream: str | None = None) -> Iterator[tuple[str, Chunks | Note]]:
        """Yield the chunks and notes of one stream, or of all, in the order in which they were appended.

        What is not a block is passed over, and noted in ``damage``. Notes on the recording are read along, see `ended`.
        """
        wanted = None if stream is None else self.streams.index(stream)
        self.damage, self._notes = [], []
        with contextlib.ExitStack() as opened:
            file = opened.enter_context(self._opened("bytes"))
            if not os.fstat(file.fileno()).st_size:
                return
            content = opened.enter_context(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
            place = passed = 0
            while place < len(content):
                if place - passed >= PASSED_BYTES:  # what was read need not stay mapped: spools are larger than memory
                    content.madvise(mmap.MADV_DONTNEED, passed, PASSED_BYTES)
                    passed += PASSED_BYTES
                stop = spool_blocks.end(content, place)
                if stop is None:
                    found = spool_blocks.following(file.fileno(), content, place)
                    self._damaged(place, found - place)
                    place = found
                    continue
                _, _, kind, number, _, count, size = spool_blocks.HEAD.unpack_from(content, place)
                if (wanted is None or number == wanted) and number < len(self.streams):
                    body = content[place + spool_blocks.HEAD.size : place + spool_blocks.HEAD.size + size]
                    entry = spool_blocks.content(kind, self.streams[number], count, body)
                    if entry is None:
                        self._damaged(place, stop - place)
                    else:
                        yield self.streams[number], entry
                elif number == spool_blocks.WHOLE:
                    entry = spool_blocks.content(
                        kind, "", count, content[place + spool_blocks.HEAD.size : place + spool_blocks.HEAD.size + size]
                    )
                    self._notes += [entry] if isinstance(entry, Note) else []
                place = stop

    def _damaged(self, offset: int, size: int) -> None:
        last = self.damage[-1] if self.damage else None
        if last is not None and last.offset + last.bytes == offset:
            self.damage[-1] = Damage(last.offset, last.bytes + size)
        else:
            self.damage.append(Damage(offset, size))

    def tallied(self) -> dict[str, Tallied]:
        """Return what each stream had received in the end."""
        try:
            with self._opened("tally") as file:
                content = file.read(len(self.streams) * TALLY.size)
            return {name: Tallied(*TALLY.unpack_from(content, n * TALLY.size)) for n, name in enumerate(self.streams)}
        except (FileNotFoundError, struct.error):  # one that cannot be read now is not a reason to forget what was lost
            return {}

    def utc_ns(self, t_ns: Any) -> Any:
        """Return UTC time in ns for stamps of the monotonic clock."""
        clock = self.header["clock"]
        return t_ns + (clock["utc_ns"] - clock["monotonic_ns"])

    def remove(self) -> None:
        """Remove the spool, whose content is sealed."""
        spool_folders.remove(self.folder)

    def keep(self) -> Path:
        """Move the spool, whose content is sealed, to where no command looks for one; return where it lies."""
        kept = self.folder.parent.parent / KEPT
        with readable_errors(kept.parent):
            kept.mkdir(mode=0o777, exist_ok=True)
            if kept.is_symlink():
                raise TacpipeError(f"{kept} is a symbolic link. Remove it.")
            self.folder.rename(kept / self.folder.name)
            for folder in (kept, self.folder.parent, kept.parent):
                sync_folder(str(folder))
        return kept / self.folder.name

    def _opened(self, name: str) -> io.FileIO:
        """Return one of its files, opened. Raises `TacpipeError` for one that is not a regular file, or another user's."""
        path = self.folder / name
        try:
            file = io.FileIO(path, opener=lambda name, _: os.open(name, spool_folders.READ))
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise TacpipeError(f"{path} is a symbolic link, and no spool holds one. Remove it.") from None
            raise
        try:
            found = os.fstat(file.fileno())
            regular.require(path, found.st_mode)
            if self._owners is not None and found.st_uid not in self._owners:
                raise TacpipeError(
                    f"{path} belongs to another user ({spool_folders.user(found.st_uid)}), who alone can seal it."
                )
        except BaseException:
            file.close()
            raise
        return file
