"""The folders of spools in a store: whose they are, which of them nobody writes any more, and their removal.

A store may be shared, so a spool is its user's alone: others cannot open its folder, and only spools of the user who runs a
command are sealed or removed by it. No symbolic link is followed.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import pwd
import re
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.io.files import listed
from tacpipe.store import layout

FOLDER = layout.SPOOL  # within the store
YOUNG_S = 60.0  # for which a spool without a header may be one that is being begun
NAME = re.compile(r"[0-9a-f]{32}")  # of a spool's folder
FILES = (
    "header.json",
    ".header.json",
    "tally",
    "bytes",
)  # as they are removed: without a header it is not sealed again
READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # a pipe without writers would block for ever


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
                    remove(folder)
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


def remove(folder: Path) -> None:
    """Remove a spool: the files that one has, and its folder where it holds no other."""
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
