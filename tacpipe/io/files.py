"""Write files atomically by draft, fsync and rename, and convert file system errors to sentences."""

from __future__ import annotations

import contextlib
import errno
import fnmatch
import hashlib
import os
import pwd
import re
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from tacpipe.errors import DeniedError, StorageError, UsageError

_T = TypeVar("_T")
_READ_ONLY = (errno.EROFS, errno.EACCES, errno.EPERM)
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL
_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EXDEV)


def write_whole(
    path: str,
    content: bytes | Iterable[bytes],
    draft: str,
    *,
    mode: int = 0o666,
    exclusive: bool = False,
    in_store: bool = False,
) -> bool:
    """Write ``content``, as bytes or blocks, to ``path`` through the file ``draft`` next to it.

    A reader of ``path`` sees either the previous content or all of ``content``. With ``exclusive``, an existing file
    stays and the result is False. Missing folders are created. ``mode`` is reduced by the umask, or ``in_store`` as
    `create` states.
    """
    try:
        _write_synced(draft, content, mode, in_store)
        return move(draft, path, exclusive=exclusive, in_store=in_store)
    finally:
        with contextlib.suppress(OSError):  # a remaining draft is removed later
            os.unlink(draft)  # noqa: PTH108


def move(draft: str, path: str, *, exclusive: bool = False, in_store: bool = False) -> bool:
    """Rename a complete draft to ``path``, creating its folder if necessary, ``in_store`` as `make_folder` does.

    With ``exclusive``, an existing file stays and the result is False.
    """
    return _in_folder(path, lambda: _move(draft, path, exclusive), in_store=in_store)


def create(path: str | Path, flags: int, mode: int = 0o666) -> int:
    """Open a file of a store, creating it if ``flags`` permit that, and return its handle.

    In a shared folder, whose group may write and owns what is created in it, a file has the permissions that both
    ``mode`` and the folder grant, whatever the umask. In other folders ``mode`` is reduced by the umask.
    """
    handle = os.open(path, flags, mode)
    if shared_mode := _shared_mode(path):
        with contextlib.suppress(OSError):  # the file belongs to another user, who has set its permissions
            os.fchmod(handle, mode & shared_mode)
    return handle


def make_folder(path: str | Path) -> None:
    """Create a folder of a store, and its missing parents. In a shared folder, it is shared in the same way."""
    try:
        os.mkdir(path)  # noqa: PTH102
    except FileNotFoundError:
        parent = os.path.dirname(path)  # noqa: PTH120
        if not parent:
            raise
        make_folder(parent)
        make_folder(path)
    except FileExistsError:
        if not os.path.isdir(path):  # noqa: PTH112
            raise
    else:
        if shared_mode := _shared_mode(path):
            with contextlib.suppress(FileNotFoundError):  # another process removed the empty folder
                os.chmod(path, shared_mode)  # noqa: PTH101


def _shared_mode(path: str | Path) -> int:
    """Return the permissions of the folder that contains ``path`` if it is shared, else 0."""
    mode = os.stat(os.path.dirname(path) or ".").st_mode & 0o2777  # noqa: PTH116, PTH120
    return mode if mode & SHARED == SHARED else 0


SHARED = stat.S_ISGID | stat.S_IWGRP  # permissions by which a folder is shared


def patiently(call: Callable[[], _T]) -> _T:
    """Return the result of ``call``, which is repeated once if permission is denied.

    Another user may have created a file or folder, and share it a moment later.
    """
    try:
        return call()
    except PermissionError:
        time.sleep(_SHARING_S)
        return call()


_SHARING_S = 0.02


def _in_folder(path: str, call: Callable[[], _T], *, in_store: bool) -> _T:
    """Return the result of ``call``, which creates ``path``; its folder is created first if it does not exist."""
    try:
        return patiently(call) if in_store else call()
    except FileNotFoundError:
        folder = os.path.dirname(path)  # noqa: PTH120
        make_folder(folder) if in_store else os.makedirs(folder, exist_ok=True)  # noqa: PTH103
        return call()


def write_all(handle: int, content: bytes | memoryview) -> None:
    """Write all of ``content``, even if the system accepts only a part at a time."""
    view = memoryview(content)
    while view:
        view = view[os.write(handle, view) :]


def sync_folder(path: str) -> None:
    """Make the names in a folder survive a power loss."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_folders(path: str, top: str) -> None:
    """Call `sync_folder` for a folder and its parents up to ``top``, because each may be new."""
    folder = path
    while True:
        sync_folder(folder)
        if folder == top or len(folder) <= len(top):
            return
        folder = os.path.dirname(folder)  # noqa: PTH120


def listed(folder: Path, pattern: str = "*") -> list[Path]:
    """Return the sorted paths in a folder that match ``pattern``; an empty list if the folder does not exist.

    Raises an error if the folder cannot be listed, unlike `Path.glob`, with which its content would seem to be missing.
    """
    try:
        names = os.listdir(folder)  # noqa: PTH208
    except (FileNotFoundError, NotADirectoryError):
        return []
    is_match = re.compile(fnmatch.translate(pattern)).match
    return [folder / name for name in sorted(filter(is_match, names))]


def present(path: Path | str) -> bool:
    """Return whether a path exists, including broken links.

    Other errors of the system (EIO, EACCES, …) are raised as `OSError`, unlike `os.path.lexists`, which returns False.
    """
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def walk(source: Path | str, *, links: bool = True) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yield ``source`` and each folder below it, top down, with its sorted subfolders and files.

    Links are followed, except in circles; with ``links=False`` a link to a folder counts as a file. Folders removed
    from the list, or deleted in the meantime, are skipped. Raises `StorageError` if a folder cannot be listed, unlike
    `os.walk`, which skips it.
    """
    visited: set[str] = set()
    pending = [os.fspath(source)]
    while pending:
        folder = pending.pop()
        real_path = os.path.realpath(folder)
        if real_path in visited:
            continue
        visited.add(real_path)
        try:
            folders, files = _contents(folder, links)
        except FileNotFoundError:
            continue
        except OSError as error:
            raise StorageError(
                f"{error.filename or folder} cannot be listed: {error.strerror or error}. What it holds would be left out: "
                f"make it readable, or take it away, and run the same command again."
            ) from error
        yield folder, folders, files
        pending += [f"{folder.rstrip('/')}/{name}" for name in reversed(folders)]


def _contents(folder: str, links: bool) -> tuple[list[str], list[str]]:
    """Return the sorted names of the subfolders of a folder, and those of its other entries."""
    folders: list[str] = []
    files: list[str] = []
    with os.scandir(folder) as entries:
        for entry in entries:
            (folders if _is_folder(entry, links) else files).append(entry.name)
    return sorted(folders), sorted(files)


def _is_folder(entry: os.DirEntry[str], links: bool) -> bool:
    """Return whether an entry is a folder or a link to one; a circular link is not."""
    try:
        return entry.is_dir(follow_symlinks=links)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        return False


class readable_errors:  # noqa: N801  (a context manager; a generator would take five times as long)
    """Convert file system errors in the block to a sentence, except errors about missing files.

    With ``reading``, nothing is written in the block, and the sentence is that of `read_error`, else of `sentence`.
    """

    __slots__ = ("_reading", "_root")

    def __init__(self, root: Path | str, *, reading: bool = False) -> None:
        self._root, self._reading = root, reading

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        """Raise a `StorageError` in place of a file system error."""
        if isinstance(error, OSError) and not isinstance(error, FileNotFoundError | FileExistsError):
            root, reading = self._root, self._reading
            raise (read_error(error.filename or root, error) if reading else sentence(root, error)) from error


def may_not_write(error: StorageError) -> bool:
    """Return whether a store failed because writing is not permitted, and not because its disk is full or broken."""
    return isinstance(error.__cause__, OSError) and error.__cause__.errno in _READ_ONLY


def sentence(root: Path | str, error: OSError) -> StorageError:
    """Return an error with a sentence about a file system error below the store ``root``."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StorageError(
            f"The disk under {root} is full; nothing was half written. Free some space (`tacpipe store gc --dry-run` "
            f"shows what the store could give back) and run the same command again."
        )
    if error.errno in _READ_ONLY:
        refused = _refused(error.filename2, error.filename, root, writing=True)
        if refused is not None and refused[1] != os.geteuid():
            text = (
                f"The store {root} cannot be written: {_advice(*refused, root)} Or name another one in TACPIPE_STORE."
            )
            return DeniedError(text, refused[1])
        return StorageError(
            f"The store {root} cannot be written ({error.strerror}). Make it writable, or name another one in "
            f"TACPIPE_STORE."
        )
    return StorageError(
        f"The store {root} cannot be used: {error.filename or 'a file'}: {error.strerror or error}. "
        f"To continue, {_hint(error, 'check the disk')}, then run the same command again."
    )


def read_error(path: Path | str, error: OSError) -> StorageError:
    """Return an error about a file that the system fails to read, which implies nothing about its content.

    It is a `DeniedError` if permissions exclude this user.
    """
    refused = _refused(path) if error.errno in _READ_ONLY else None
    if refused is not None:
        return DeniedError(f"{path} cannot be read: {_advice(*refused, path)}", refused[1])
    hint = _hint(error, "check the disk and its permissions")
    return StorageError(
        f"{path} cannot be read: {error.strerror or error}. It may be sound: {hint}, then run the same command again."
    )


def _refused(*paths: Path | str | None, writing: bool = False) -> tuple[Path, int] | None:
    """Return the first file or folder that excludes this user, and its owner; None if all ``paths`` are accessible.

    For each path, the file and the folder that contains it are tried, and all parents as long as nothing is visible.
    """
    folder_access = os.R_OK | os.X_OK | (os.W_OK if writing else 0)
    for path in paths:
        for place in () if path is None else (Path(path), *Path(path).parents):
            try:
                status = place.lstat()
            except OSError:
                continue
            is_folder = stat.S_ISDIR(status.st_mode)
            if not os.access(place, folder_access if is_folder else os.R_OK):
                return place, status.st_uid
            if is_folder:
                break
    return None


def _advice(refusing: Path, owner: int, path: Path | str) -> str:
    """Return the owner of a file or folder that refuses access to ``path``, and what this owner can do."""
    return (
        f"{'it' if refusing == Path(path) else refusing} belongs to the user {user_name(owner)}, who can run "
        f"`chmod -R g+rwX` on it, or `tacpipe store init --shared` on the store."
    )


def user_name(user_id: int) -> str:
    """Return the name of a user, or the id of a user without a name."""
    try:
        return pwd.getpwuid(user_id).pw_name
    except (KeyError, OverflowError):
        return str(user_id)


def _hint(error: OSError, otherwise: str) -> str:
    """Return what to do about a system limit, or ``otherwise`` for other errors."""
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return "allow more open files (`ulimit -n`)"
    if error.errno == errno.EFBIG:
        return "allow larger files (`ulimit -f`), or take a file system that holds them"
    return otherwise


def describe(error: OSError) -> str:
    """Return a phrase for any other file system error."""
    return (
        f"{error.filename or 'A file'} cannot be used: {error.strerror or error}. Nothing was half written; fix that, then "
        f"run the same command again."
    )


def _write_synced(path: str, content: bytes | Iterable[bytes], mode: int, in_store: bool) -> None:
    """Write ``content`` to a new file and sync it; its folder is created if necessary."""
    opened = create if in_store else os.open
    handle = _in_folder(path, lambda: opened(path, _NEW, mode), in_store=in_store)
    try:
        for block in [content] if isinstance(content, bytes) else content:
            write_all(handle, block)
        os.fsync(handle)
    finally:
        os.close(handle)


def _move(draft: str, path: str, exclusive: bool) -> bool:
    """Rename a draft to ``path``. With ``exclusive``, an existing file stays and the result is False."""
    if not exclusive:
        os.replace(draft, path)  # noqa: PTH105
        return True
    try:
        os.link(draft, path)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        if os.path.exists(path):  # noqa: PTH110
            return False
        os.replace(draft, path)  # noqa: PTH105  (of two that come here at once the later one stays: both are complete)
    return True


class Hashed:
    """A file object that counts and hashes content without storing it."""

    closed = False

    def __init__(self) -> None:
        self.bytes, self._hash = 0, hashlib.sha256()

    @property
    def digest(self) -> str:
        """The digest of the content written so far."""
        return self._hash.hexdigest()

    def write(self, content: bytes | memoryview) -> int:
        """Hash all of ``content``."""
        self._hash.update(content)
        self.bytes += len(content)
        return len(content)

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self.bytes

    def flush(self) -> None:
        """Do nothing, because nothing is buffered."""


class Draft(Hashed):
    """A new file in a store; written bytes are hashed."""

    def __init__(self, path: str, root: Path | str, mode: int) -> None:
        super().__init__()
        self._root = root
        self._handle = create(path, _NEW, mode)

    def write(self, content: bytes | memoryview) -> int:
        """Write all of ``content``. Raises `StorageError` if the disk fails or is full."""
        try:
            write_all(self._handle, content)
        except OSError as error:
            raise sentence(self._root, error) from error
        return super().write(content)

    def sync(self) -> None:
        """Make the content survive a power loss. Raises `StorageError` as `write` does."""
        try:
            os.fsync(self._handle)
        except OSError as error:
            raise sentence(self._root, error) from error

    def release(self) -> None:
        """Close the file. Raises `StorageError` as `write` does."""
        try:
            os.close(self._handle)
        except OSError as error:
            raise sentence(self._root, error) from error


@contextlib.contextmanager
def new_draft(path: str, root: Path | str, *, mode: int = 0o666) -> Iterator[Draft]:
    """Yield a new file at ``path`` in the store ``root``. It is deleted after the block unless it was moved.

    ``mode`` is that of `create`. Raises `StorageError` if the file system does not allow it.
    """
    try:
        make_folder(os.path.dirname(path))  # noqa: PTH120
        draft = Draft(path, root, mode)
    except OSError as error:
        raise sentence(root, error) from error
    try:
        yield draft
    finally:
        try:
            draft.release()
        finally:
            with contextlib.suppress(OSError):  # a remaining draft is removed later
                os.unlink(path)  # noqa: PTH108


_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:/")  # matches one slash, because Path("s3://bucket/x") retains only one


def local(path: Path | str) -> Path:
    """Return ``path``. Raises `UsageError` for an address, which would otherwise be created as a folder.

    >>> local("data/recordings")
    PosixPath('data/recordings')
    """
    if _ADDRESS.match(str(path)):
        scheme, _, location = str(path).partition(":")
        raise UsageError(
            f"{scheme}://{location.lstrip('/')} is an address, and {scheme}:// is not supported. Give a path of the file "
            "system."
        )
    return Path(path)
