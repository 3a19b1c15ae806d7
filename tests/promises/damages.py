"""Damage files as disks, people and other programs do."""

import os
from collections.abc import Callable
from pathlib import Path

Damage = Callable[[Path], None]


def overwrite(path: Path, content: bytes) -> None:
    """Write through whatever links the file has, whoever may not."""
    path.chmod(0o644)
    path.write_bytes(content)


def flip(path: Path, share: float = 0.5, mask: int = 0x10) -> None:
    """Flip a bit somewhere in a file."""
    content = bytearray(path.read_bytes())
    content[min(int(len(content) * share), len(content) - 1)] ^= mask
    overwrite(path, bytes(content))


def unseen(path: Path) -> None:
    """Change a byte and leave size, mode and times as they were."""
    before = path.stat()
    flip(path)
    path.chmod(before.st_mode)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def truncate(path: Path) -> None:
    """Lose the second half."""
    content = path.read_bytes()
    overwrite(path, content[: len(content) // 2])


def empty(path: Path) -> None:
    """Lose all bytes, as after a loss of power."""
    overwrite(path, b"")


def zeros(path: Path) -> None:
    """Keep the size and nothing else, as some file systems do after a loss of power."""
    overwrite(path, bytes(path.stat().st_size))


def longer(path: Path) -> None:
    """Add a byte, which is no white space."""
    overwrite(path, path.read_bytes() + b"\x00")


def replace(path: Path) -> None:
    """Put another file in its place, so that hard links part."""
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(content[:-1] + b"?")


def delete(path: Path) -> None:
    """Delete it."""
    path.unlink()


ALL: dict[str, Damage] = {
    "a bit is flipped": flip,
    "its first bit is flipped": lambda path: flip(path, 0.0, 0x80),
    "its last bit is flipped": lambda path: flip(path, 1.0, 0x01),
    "a byte is changed and no time": unseen,
    "its second half is lost": truncate,
    "it is empty": empty,
    "it is all zeros": zeros,
    "it has a byte more": longer,
    "another file is in its place": replace,
    "it is gone": delete,
}
