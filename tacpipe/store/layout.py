"""The layout of a store: its folders, the form of every name in them, and whether a folder is a store.

Files with other names do not belong to the store: they are never moved or removed, and `tacpipe store verify` lists
them. Symbolic links inside a store are not followed. ``.tacpipe`` itself may be a link, for example to another disk.
"""

from __future__ import annotations

import operator
import os
import re
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from tacpipe.errors import DamagedError, DeniedError, TacpipeError, UsageError
from tacpipe.io import regular
from tacpipe.io.files import readable_errors
from tacpipe.io.hashing import DIGEST
from tacpipe.printable import listed, plain

FORMAT = "1"
BESIDE_NAME = ".tacpipe"  # name of a store in its project's folder
MARK = "format"  # file that marks a folder as a store
PROJECT = "project"  # file that marks the store's folder as a project, written by `tacpipe store init`
FOLDERS = ("objects", "records", "roots", "leases", "checkpoints", "quarantine", "tmp")
SPOOL = "spool"  # folder of spools, created by the first recording
KEPT = "kept-spools"  # folder of retained spools, created by the first recording whose raw bytes are saved
PROJECTS = "projects"  # folder of identities, created by the first push
PRESENCE = "presence"  # folder of notes, created by the first command that finds a large dataset complete
ASIDE = "gc-"  # prefix in ``tmp/`` of an object that a collection has set aside
SHELF = re.compile(r"[0-9a-f]{2}")  # folders in objects/ and records/, named after the first digits of their names
_DIGEST = r"[0-9a-f]{64}"
_RANDOM = r"[0-9a-f]{32}"
_FORMS = {  # pattern of the paths in each folder
    "objects": re.compile(r"(?P<shelf>[0-9a-f]{2})/(?P=shelf)[0-9a-f]{62}"),
    "records": re.compile(r"(?P<shelf>[0-9a-f]{2})/(?P=shelf)[0-9a-f]{62}\.json"),
    "roots": re.compile(rf"{_DIGEST}\.json"),
    "leases": re.compile(rf"(run-{_RANDOM}|{_DIGEST}|gc)\.lock"),
    "checkpoints": re.compile(_DIGEST),
    "quarantine": re.compile(rf"({_DIGEST}(\.json)?|root-{_DIGEST}\.json|manifest\.json)\.[0-9]+"),
    "tmp": re.compile(rf"((run-{_RANDOM})?\.)?{_RANDOM}|{ASIDE}{_DIGEST}"),
    SPOOL: re.compile(_RANDOM),
    KEPT: re.compile(_RANDOM),
    PROJECTS: re.compile(rf"{_DIGEST}\.json"),
    PRESENCE: re.compile(_DIGEST),
}
_SHELVED = ("objects", "records")
# a function that is called with the name of each file or folder that this user may not read
NoteDenied = Callable[[str, DeniedError], object]
_NAME_LENGTHS = {"objects": 64, "records": 69}  # length of names: a digest, followed by ".json" for a record
_HOLD_FOLDERS = ("checkpoints", SPOOL, KEPT)  # folders whose entries are folders; others contain files
_BEGUN = ("tmp", "leases", "checkpoints", SPOOL)  # may have content before the mark is written
_BESIDE = frozenset({".gitignore", ".gitkeep", "lost+found"})  # files that may exist in a folder that becomes a store


def object_name(name: str) -> str:
    """Return the path of the object ``name`` in a store.

    Raises `DamagedError` if the name is not a digest, because it could lead out of the store.
    """
    if not DIGEST.fullmatch(name):
        raise DamagedError(
            f"{name[:80]!r} is not a digest (64 hex digits): the file that names it is damaged or forged."
        )
    return f"objects/{name[:2]}/{name}"


def record_name(key: str) -> str:
    """Return the path of the record of ``key`` in a store."""
    return f"records/{key[:2]}/{key}.json"


def belongs(path: str) -> bool:
    """Return whether a path in a store has the form of its folder's names."""
    folder, _, name = path.partition("/")
    return folder in _FORMS and _FORMS[folder].fullmatch(name) is not None


def check(root: Path) -> bool:
    """Return True if ``root`` is a store, and False if it is empty or missing, so that a store can be created.

    Raises `UsageError` for a folder with other content, for a store of another format, and if its folders are symbolic
    links. Changes nothing.
    """
    with readable_errors(root):
        mark = _mark(root)
        if mark is None and not _is_empty(root):
            mark = _mark(root)  # another process may have created the store in between
            if mark is None:
                raise UsageError(_not_a_store(root))
        if mark not in (None, FORMAT):
            raise UsageError(
                f"The store {root} has format {plain(mark) or 'unknown'}; this tacpipe reads format {FORMAT}. Install "
                f"the tacpipe that wrote it, or name another store in TACPIPE_STORE."
            )
        for name in _FORMS:
            if _is_link(root / name):
                raise UsageError(
                    f"{root / name} is a symbolic link, and none is followed within a store. To keep a store on "
                    f"another disk, move {root} there and link to it, or set TACPIPE_STORE."
                )
    return mark is not None


def refuse_within(output: Path) -> None:
    """Raise `UsageError` for an output path inside a store, also through links."""
    path = Path(os.path.realpath(output))
    for folder in (path, *path.parents):
        if folder.name == BESIDE_NAME or ((folder / MARK).is_file() and (folder / "objects").is_dir()):
            raise UsageError(
                f"{output} lies within the store {folder}, which only tacpipe writes to. Give another place."
            )


def entries(root: Path, name: str) -> Iterator[Path]:
    """Yield the sorted entries of a folder of the store whose names have the store's form.

    Entries that disappear in the meantime are skipped. Raises `StorageError` if the folder cannot be listed.
    """
    return (Path(path) for path, is_ours in _contents(root, name) if is_ours)


def names(root: Path, folder: str, note_denied: NoteDenied) -> Iterator[str]:
    """Yield the sorted file names in ``objects`` or ``records``, which are digests.

    Calls ``note_denied`` for each subfolder that this user may not list. Raises the other errors of `entries`.
    """
    return (path[-_NAME_LENGTHS[folder] :][:64] for path, ours in _contents(root, folder, note_denied) if ours)


def foreign(root: Path) -> list[str]:
    """Return the sorted relative paths below ``root`` that do not belong to a store, including symbolic links."""
    paths = [path for name in _FORMS for path, is_ours in _contents(root, name, lambda *_: None) if not is_ours]
    expected = {MARK, PROJECT, *_FORMS, *_BESIDE}
    paths += [entry.path for entry in _scan(root, root) if entry.name not in expected]
    return sorted(str(Path(path).relative_to(root)) for path in paths)


def is_linked(root: str, path: str | Path) -> bool:
    """Return whether a file of the store is in a folder that is a symbolic link; the store's own folder may be one."""
    folder = os.path.dirname(path)  # noqa: PTH120
    with readable_errors(root):
        return folder != root and _is_link(folder)


def _is_link(path: str | Path) -> bool:
    """Return whether a path is a symbolic link. Raises `OSError` if that cannot be determined."""
    try:
        return stat.S_ISLNK(os.lstat(path).st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


def _raise(_: str, error: DeniedError) -> None:
    raise error


def _contents(root: Path, name: str, note_denied: NoteDenied = _raise) -> Iterator[tuple[str, bool]]:
    """Yield the paths in a folder of the store and in its subfolders, each with whether it belongs to the store.

    Calls ``note_denied`` for each subfolder that this user may not list.
    """
    folder = root / name
    if folder.is_symlink():
        yield str(folder), False
        return
    for entry in _scan(root, folder):
        if name not in _SHELVED:
            is_kind = entry.is_dir if name in _HOLD_FOLDERS else entry.is_file
            yield entry.path, is_kind(follow_symlinks=False) and _FORMS[name].fullmatch(entry.name) is not None
        elif SHELF.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
            try:
                inner_entries = _scan(root, entry.path)
            except DeniedError as error:
                note_denied(f"{name}/{entry.name}", error)
                continue
            for inner in inner_entries:
                form = _FORMS[name].fullmatch(f"{entry.name}/{inner.name}")
                yield inner.path, inner.is_file(follow_symlinks=False) and form is not None
        else:
            yield entry.path, False


def _scan(root: Path, folder: Path | str) -> list[os.DirEntry[str]]:
    """Return the entries of a folder sorted by name; an empty list if it does not exist."""
    with readable_errors(root, reading=True):
        try:
            with os.scandir(folder) as entries:
                return sorted(entries, key=operator.attrgetter("name"))
        except (FileNotFoundError, NotADirectoryError):
            return []


def _mark(root: Path) -> str | None:
    """Return the format in a store's mark, or None if there is no mark.

    Raises `UsageError` for a dangling link, for a file in place of the folder, and for a mark that cannot be read.
    """
    try:
        with regular.opened(root / MARK) as file:
            return file.read(64).strip().decode(errors="replace")
    except FileNotFoundError:
        if root.is_symlink() and not root.exists():
            target = os.readlink(root)  # noqa: PTH115
            raise UsageError(
                f"The store {root} is a symbolic link to {target}, which does not exist. Mount its disk, or remove the link."
            ) from None
        return None
    except NotADirectoryError:
        raise UsageError(f"{root} is not a folder, so it is not a store. Name another one in TACPIPE_STORE.") from None
    except TacpipeError as error:
        raise UsageError(f"{_not_a_store(root)} ({error})") from None


def _is_empty(root: Path) -> bool:
    """Return whether a folder without a mark is empty, apart from files of a process that is creating a store."""
    for entry in _scan(root, root):
        if entry.name in _BESIDE:
            continue
        if entry.name not in _FORMS or not entry.is_dir(follow_symlinks=False):
            return False
        if any(not (is_ours and entry.name in _BEGUN) for _, is_ours in _all_entries(root, entry.name)):
            return False
    return True


def _all_entries(root: Path, name: str) -> Iterator[tuple[str, bool]]:
    """Yield the paths that `_contents` yields, but with subfolders, which may be empty, instead of their contents."""
    if name in _SHELVED:
        return ((entry.path, False) for entry in _scan(root, root / name))
    return _contents(root, name)


def _not_a_store(root: Path) -> str:
    """Return the message for a folder that is not empty and not a store."""
    names = [entry.name for entry in _scan(root, root)]
    return (
        f"{root} is not a store of tacpipe: it has no file {MARK} and is not empty ({listed(names, 4)}). Nothing in it was "
        f"changed. Name a store, or a new folder, in TACPIPE_STORE; a store that lost this file is one again after "
        f"`echo {FORMAT} > {root / MARK}`."
    )
