"""The spool: what came over the links of a rig, byte for byte, in a file that is only ever appended to.

A recording's folder in the store holds

- ``header.json``: what is recorded and for whom, and the UTC time of one reading of the monotonic clock;
- ``bytes``: blocks, each with a mark, a check sum, and the chunks of one stream with their arrival, or a note on a stream or
  on the recording, as how it ended;
- ``tally``: how much every stream has received so far, in memory shared with the disk cache: what a killed process had
  read and not yet written is known from it.

What is written outlasts the process; what is synced outlasts a loss of power. A block that is torn or damaged ends what
can be read of it, and the next mark begins anew.

A store may be shared, so a spool is its user's alone: others cannot open its folder, and only spools of the user who runs a
command are sealed or removed by it. No symbolic link is followed.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import json
import mmap
import os
import pwd
import re
import stat
import struct
import tempfile
import time
import uuid
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import listed, readable_errors, sync_folder, write_whole
from tacpipe.recording.ending import COMPLETED, INTERRUPTED, RECOVERED
from tacpipe.sensors.framing import Chunks
from tacpipe.store import layout

FOLDER = layout.SPOOL  # within the store
MARK = b"tacB"
HEAD = struct.Struct("<4sIBBHII")  # mark, check sum of all that follows, kind, stream, 0, chunks, bytes of the body
CHUNKS, NOTE = 0, 1  # kinds of blocks
WHOLE = 255  # in the place of a stream's number: a note on the recording, which has the stream ""
ENDED = "ended"  # such a note
KEPT = layout.KEPT  # within the store
TALLY = struct.Struct("<QQq")  # chunks, bytes, last arrival
YOUNG_S = 60.0  # for which a spool without a header may be one that is being begun
RECOVER = "free some space, and `tacpipe acquire --recover` seals it"  # after a full disk
PASSED_BYTES = 1 << 25  # whole pages
NAME = re.compile(r"[0-9a-f]{32}")  # of a spool's folder
FILES = (
    "header.json",
    ".header.json",
    "tally",
    "bytes",
)  # as they are removed: without a header it is not sealed again
READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # a pipe without writers would block for ever
HEADER_BYTES = 16 << 20  # at most


@dataclass(frozen=True)
class Note:
    """Something that happened to a stream besides its bytes: a link that opened, was lost, was paused."""

    t_ns: int
    stream: str
    what: str
    detail: str = ""


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
        refuse_link(store)
        with readable_errors(store):
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            self.folder.mkdir(mode=0o700)
            entry = {**header, "streams": list(streams), "clock": now()}
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
            self._waiting.append(_block(CHUNKS, self.streams[stream], len(chunks.size), body))

    def note(self, note: Note) -> None:
        """Add a note."""
        body = json.dumps({"t_ns": note.t_ns, "what": note.what, "detail": note.detail}).encode()
        self._waiting.append(_block(NOTE, self.streams[note.stream] if note.stream else WHOLE, 0, body))

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
                stop = _end(content, place)
                if stop is None:
                    found = _next(file.fileno(), content, place)
                    self._damaged(place, found - place)
                    place = found
                    continue
                _, _, kind, number, _, count, size = HEAD.unpack_from(content, place)
                if (wanted is None or number == wanted) and number < len(self.streams):
                    body = content[place + HEAD.size : place + HEAD.size + size]
                    entry = _body(kind, self.streams[number], count, body)
                    if entry is None:
                        self._damaged(place, stop - place)
                    else:
                        yield self.streams[number], entry
                elif number == WHOLE:
                    entry = _body(kind, "", count, content[place + HEAD.size : place + HEAD.size + size])
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
        _remove(self.folder)

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
            file = io.FileIO(path, opener=lambda name, _: os.open(name, READ))
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise TacpipeError(f"{path} is a symbolic link, and no spool holds one. Remove it.") from None
            raise
        try:
            found = os.fstat(file.fileno())
            regular.require(path, found.st_mode)
            if self._owners is not None and found.st_uid not in self._owners:
                raise TacpipeError(f"{path} belongs to another user ({user(found.st_uid)}), who alone can seal it.")
        except BaseException:
            file.close()
            raise
        return file


def users(place: Path, seen: Iterable[int]) -> frozenset[int]:
    """Return the user ids that files of this process have in a folder, ``seen`` being those that there are.

    That is its own; where another was seen, also what the file system, as one of a network, makes of it.
    """
    found = {os.geteuid()}
    if not found.issuperset(seen):
        with contextlib.suppress(OSError), tempfile.TemporaryFile(dir=place) as file:
            found.add(os.fstat(file.fileno()).st_uid)
    return frozenset(found)


def user(number: int) -> str:
    """Return the name of a user, or the number where there is no name."""
    try:
        return pwd.getpwuid(number).pw_name
    except (KeyError, OverflowError):
        return str(number)


def refuse_link(store: Path) -> None:
    """Raise `TacpipeError` where a store's folder of spools is a symbolic link: what it leads to may be anybody's."""
    if (store / FOLDER).is_symlink():
        raise TacpipeError(
            f"{store / FOLDER} is a symbolic link. Remove it; to record to another disk, name a store there in "
            f"TACPIPE_STORE."
        )


def owners(store: Path) -> dict[Path, int]:
    """Return the folders of all spools, and the user id of each. Raises `TacpipeError` as `refuse_link`."""
    refuse_link(store)
    found = {}
    for folder in listed(store / FOLDER):
        with contextlib.suppress(FileNotFoundError):
            there = folder.lstat()
            if stat.S_ISDIR(there.st_mode) and NAME.fullmatch(folder.name):
                found[folder] = there.st_uid
    return found


def abandoned(store: Path) -> list[Path]:
    """Return the folders of this user's spools that no process writes or seals any more, oldest first."""
    found = []
    everybodys = owners(store)
    ids = users(store / FOLDER, everybodys.values())
    for folder in [folder for folder, owner in everybodys.items() if owner in ids]:
        try:
            with locked(folder) as ours:
                age_s = time.time() - (folder / "bytes" if ours else folder).stat().st_mtime
                if ours and (folder / "header.json").exists():
                    found.append((-age_s, folder))
                elif ours and age_s > YOUNG_S:  # its process ended before it recorded, or after it was sealed
                    _remove(folder)
            if not ours and age_s > YOUNG_S:
                folder.rmdir()  # fails for one that holds anything
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            if error.errno != errno.ENOTEMPTY:
                found.append((0.0, folder))  # who tries to seal it states what is wrong with it
    return [folder for _, folder in sorted(found)]


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Hold a spool while in the block; yield False if it is gone, or if a process writes or seals it."""
    try:
        handle = os.open(folder / "bytes", READ)
    except FileNotFoundError:
        yield False
        return
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            ours = os.fstat(handle).st_nlink > 0
        except BlockingIOError:
            ours = False
        yield ours
    finally:
        os.close(handle)


def _remove(folder: Path) -> None:
    with contextlib.suppress(FileNotFoundError):
        there = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            for name in FILES:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(name, dir_fd=there)
        finally:
            os.close(there)
    with contextlib.suppress(OSError):
        folder.rmdir()


def _tally(folder: Path, streams: int) -> mmap.mmap:
    handle = os.open(folder / "tally", os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
    try:
        os.posix_fallocate(
            handle, 0, max(1, streams) * TALLY.size
        )  # a hole that a full disk cannot fill kills its writer
        return mmap.mmap(handle, max(1, streams) * TALLY.size)
    finally:
        os.close(handle)


def _block(kind: int, stream: int, count: int, body: bytes) -> bytes:
    rest = HEAD.pack(MARK, 0, kind, stream, 0, count, len(body))[8:]
    return MARK + struct.pack("<I", zlib.crc32(body, zlib.crc32(rest))) + rest + body


def _end(content: mmap.mmap, place: int) -> int | None:
    """Return where the block at ``place`` ends, or None if there is no whole and undamaged one."""
    if place + HEAD.size > len(content) or content[place : place + 4] != MARK:
        return None
    _, check, _, _, _, _, size = HEAD.unpack_from(content, place)
    stop = place + HEAD.size + int(size)
    if stop > len(content):
        return None
    with memoryview(content) as view, view[place + 8 : stop] as covered:
        return stop if zlib.crc32(covered) == check else None


def _next(handle: int, content: mmap.mmap, place: int) -> int:
    """Return where after ``place``, where there is no block, one may begin; holes of the file are passed over unread."""
    try:
        data = os.lseek(handle, place, os.SEEK_DATA)
        if data > place:
            return min(data, len(content))
        stop = min(os.lseek(handle, place, os.SEEK_HOLE), len(content))
    except OSError as error:
        if error.errno == errno.ENXIO:  # nothing follows but a hole
            return len(content)
        stop = len(content)  # a file system that does not state
    found = content.find(MARK, place + 1, stop)
    return stop if found < 0 else found


def _body(kind: int, stream: str, count: int, body: bytes) -> Chunks | Note | None:
    """Return what a block holds, None where its sum is right and it is still none: another program wrote it."""
    try:
        if kind == NOTE:
            entry = json.loads(body)
            return Note(int(entry["t_ns"]), stream, str(entry["what"]), str(entry["detail"]))
        stamps = np.frombuffer(body, "<i8", count)
        sizes = np.frombuffer(body, "<u4", count, 8 * count).astype(np.int64)
    except (ValueError, LookupError, TypeError, RecursionError, OverflowError):
        return None
    if kind != CHUNKS or not count or int(sizes.sum()) != len(body) - 12 * count:
        return None
    return Chunks(stamps.astype(np.int64), sizes, body[12 * count :])
