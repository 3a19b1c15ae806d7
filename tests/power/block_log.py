"""The log of dm-log-writes: every write that reached a disk, in order, with flushes, forced writes and marks.

The layout is that of Linux' `drivers/md/dm-log-writes.c`: a superblock, then for each entry a header of one sector, its
data behind it.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

MAGIC = 0x6A736677736872  # Magic number of the superblock.
SECTOR = 512
FLUSH, FUA, DISCARD, MARK, METADATA = 1, 2, 4, 8, 16
_SUPER, _ENTRY = struct.Struct("<QQQI"), struct.Struct("<QQQQ")


@dataclass(frozen=True)
class Entry:
    """One request: its first sector on the disk, its flags, how many sectors, and the data (or the text of a mark)."""

    sector: int
    sectors: int
    flags: int
    data: bytes


def read(path: Path) -> list[Entry]:
    """Return the entries of a log."""
    with path.open("rb") as log:
        magic, _, count, sector_bytes = _SUPER.unpack(log.read(_SUPER.size))
        assert magic == MAGIC, f"{path} is not a log of dm-log-writes"
        entries, place = [], sector_bytes
        for _ in range(count):
            log.seek(place)
            sector, sectors, flags, size = _ENTRY.unpack(log.read(_ENTRY.size))
            text = log.read(size) if flags & MARK else b""
            place += sector_bytes
            data = b""
            if not flags & (DISCARD | MARK) and sectors:
                log.seek(place)
                data = log.read(sectors * sector_bytes)
                place += sectors * sector_bytes
            entries.append(Entry(sector * sector_bytes, sectors * sector_bytes, flags, text or data))
    return entries


@dataclass(frozen=True)
class State:
    """Writes that a disk may hold after a loss of power, and the marks that were passed by then."""

    writes: list[Entry]
    passed: tuple[str, ...]


def states(entries: list[Entry], seed: int) -> Iterator[State]:
    """Yield a state for each flush, forced write and mark, and one that also has a random part of what came after it.

    What came before a flush is on the disk. Of what came after the last one a disk may keep any part in any order.
    """
    chance = Random(seed)
    synced: list[Entry] = []  # These writes are on the disk for certain.
    loose: list[Entry] = []  # written since the last flush
    passed: tuple[str, ...] = ()
    for entry in entries:
        if entry.flags & MARK:
            passed += (entry.data.rstrip(b"\0").decode(),)
            yield State(list(synced), passed)
            continue
        if entry.flags & FLUSH:
            if loose:
                yield State([*synced, *chance.sample(loose, chance.randint(0, len(loose)))], passed)
            synced += loose
            loose = []
        if entry.data:
            (synced if entry.flags & FUA else loose).append(entry)
        if entry.flags & (FLUSH | FUA):
            yield State(list(synced), passed)


def write(state: State, image: Path) -> None:
    """Apply a state's writes to a copy of the disk as it was."""
    with image.open("r+b") as disk:
        for entry in state.writes:
            disk.seek(entry.sector)
            disk.write(entry.data)
