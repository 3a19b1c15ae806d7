"""The directory of a dataset: shards linked beside the manifest, for programs that read files."""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path

from tacpipe.errors import DamagedError, TacpipeError, UsageError
from tacpipe.files import write_whole
from tacpipe.hashing import bytes_digest, digest, file_digest
from tacpipe.manifest import NAME, Manifest, parse
from tacpipe.store import Store

_DRAFT = ".draft"


def publish(store: Store, manifest: Manifest, directory: Path) -> None:
    """Make ``directory`` show ``manifest``: a root in the store, then shards linked (recordings copied), the manifest last.

    The root comes first so that what a killed run left behind is known to be ours.
    What an earlier manifest named and this one does not is removed. Raises `UsageError` if the directory holds
    something that tacpipe did not write.
    """
    directory = directory.absolute()
    check_output(store, directory)
    wanted = dict(manifest.objects())
    current = _current(directory, manifest.content)
    stale = [path for path, name in wanted.items() if not (current and _matches(directory / path, store, name))]
    if current and not stale:
        store.set_root(directory, bytes_digest(manifest.content))
        return
    with store.leases.hold(digest(["output", str(directory)])):
        store.set_root(directory, bytes_digest(manifest.content))
        for draft in [*directory.glob(f".*{_DRAFT}"), *directory.glob(f"*/.*{_DRAFT}")]:
            draft.unlink()  # of a process that was killed
        for path in stale:
            place(store, wanted[path], directory / path, copy=manifest.recorded)
        _remove(directory, _named(directory) - set(wanted))
        if not current:
            write_whole(str(directory / NAME), manifest.content, str(directory / f".{NAME}{_DRAFT}"))


def _remove(directory: Path, paths: set[str]) -> None:
    for path in paths:
        with contextlib.suppress(FileNotFoundError, IsADirectoryError, NotADirectoryError):
            (directory / path).unlink()
    for folder in {(directory / path).parent for path in paths} - {directory}:
        with contextlib.suppress(OSError):  # not empty, or gone already
            folder.rmdir()


def check_output(store: Store, directory: Path) -> None:
    """Refuse to write a dataset over something that tacpipe did not write."""
    directory = directory.absolute()
    if directory.is_file():
        raise UsageError(f"{directory} is a file; give -o a directory.")
    if not directory.is_dir() or (directory / NAME).exists() or store.get_root(directory) is not None:
        return
    for path in directory.rglob("*"):  # a project that was moved: its shards are known, its path is not
        if path.is_file() and path.name != ".gitignore" and not store.has(file_digest(path)):
            raise UsageError(
                f"{directory} has no {NAME} and holds {path.relative_to(directory)}, which tacpipe did not write. "
                f"Give -o a new directory."
            )


def place(store: Store, name: str, path: Path, *, copy: bool) -> None:
    """Put the object ``name`` at ``path``: by reflink, hard link or copy, in this order; only by copy if ``copy``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}{_DRAFT}")
    source = store.object_path(name)
    with contextlib.suppress(FileNotFoundError):
        draft.unlink()
    try:
        if copy or not _link(source, draft):
            shutil.copyfile(source, draft)
        draft.replace(path)
    except FileNotFoundError:
        raise DamagedError(
            f"Object {name[:12]} vanished from the store while it was linked; run the same command again."
        ) from None
    finally:
        with contextlib.suppress(FileNotFoundError):
            draft.unlink()


def _link(source: str, target: Path) -> bool:
    import fcntl

    with open(source, "rb") as reading, open(target, "wb") as writing, contextlib.suppress(OSError):
        fcntl.ioctl(writing.fileno(), 0x40049409, reading.fileno())  # FICLONE
        return True
    target.unlink()
    with contextlib.suppress(OSError):
        os.link(source, target)
        return True
    return False


def _matches(path: Path, store: Store, name: str) -> bool:
    """Return whether ``path`` holds the object ``name``: known by its inode where it is linked, else by its content."""
    try:
        there = os.stat(path)  # noqa: PTH116  (once a shard on every hit)
        stored = os.stat(store.object_path(name))  # noqa: PTH116
    except FileNotFoundError:
        return False
    return there.st_ino == stored.st_ino or (there.st_size == stored.st_size and file_digest(path) == name)


def _current(directory: Path, content: bytes) -> bool:
    try:
        return (directory / NAME).read_bytes() == content
    except FileNotFoundError:
        return False


def _named(directory: Path) -> set[str]:
    """Return the paths that the manifest in ``directory`` names; none if there is no readable one."""
    try:
        return {path for path, _ in parse((directory / NAME).read_bytes(), str(directory)).objects()}
    except (FileNotFoundError, TacpipeError):
        return set()
