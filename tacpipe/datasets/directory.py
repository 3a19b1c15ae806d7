"""The directory of a dataset: its manifest and links to its shards, for programs that read files."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import stat
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from tacpipe.datasets import pages, replacing
from tacpipe.datasets.delivery import deliver
from tacpipe.datasets.manifest import NAME, Manifest, find
from tacpipe.datasets.paths import shard_path, verified_copy
from tacpipe.errors import StorageError, TacpipeError, UsageError
from tacpipe.io import regular
from tacpipe.io.files import listed, sync_folder, sync_folders, walk, write_whole
from tacpipe.io.hashing import digest, file_digest
from tacpipe.store import layout
from tacpipe.store.records import Content
from tacpipe.store.store import MissingError, Store

_DRAFT = ".draft"
_OURS = re.compile(rf"\.(?P<name>.+)\.[0-9a-f]{{12}}{_DRAFT}|\.{re.escape(NAME)}{_DRAFT}", re.DOTALL)


@dataclass(frozen=True)
class DirectoryChange:
    """Planned content of a directory.

    Damaged shards at the paths ``may_lack`` are not touched, because a lost recording must not block the next one.
    If a dataset was only ``relabelled``, nothing is removed and no shard is checked, so a label costs only its change.
    If it was found ``whole``, existing files are not checked again. Edited files of an export raise an error unless
    ``replace`` is set, which stores their content. ``key`` is that of the run that produced the manifest.
    """

    manifest: Manifest
    may_lack: Collection[str] = ()
    relabelled: bool = False
    is_complete: bool = False
    replace: bool = False
    key: str = ""


def publish(store: Store, manifest: Manifest, directory: Path, *, replace: bool = False) -> None:
    """Make ``directory`` show ``manifest``, as `change` does; if it already does, only set its root again."""
    absolute = directory.absolute()
    if shows(store, manifest, absolute):
        deliver(store, absolute, manifest)
        store.roots.set(absolute, manifest.content_digest)
        return
    change(store, absolute, lambda: DirectoryChange(manifest, replace=replace))


def shows(store: Store, manifest: Manifest, directory: Path) -> bool:
    """Return whether ``directory`` already shows ``manifest`` with all of its files."""
    return bool(showing(store, manifest, directory))


def showing(store: Store, manifest: Manifest, directory: Path) -> Literal["", "files", "links"]:
    """Return how ``directory`` shows ``manifest`` and all of its files, or "" if it does not.

    ``links``: all files are directly in the directory, as links to objects of the store. ``files``: some are copies or
    in folders.
    """
    if not _is_current(directory, manifest):
        return ""
    all_linked = True
    for path, name in manifest.objects():
        match = _matches(f"{directory}/{path}", store, name)
        if not match:
            return ""
        all_linked = all_linked and match == "links" and "/" not in path
    return "links" if all_linked else "files"


def change(store: Store, directory: Path, decide: Callable[[], DirectoryChange]) -> Manifest:
    """Make ``directory`` show what ``decide`` returns, and return its manifest; all changes of a directory use this.

    ``decide`` is called while no other process can change the directory, so it may read the current content. A root in
    the store is written first, which marks files of a killed run as ours, then the shards are linked (recordings are
    copied), and the manifest is written last. Irreplaceable content of the previous dataset stays in the store with its
    manifest; its other files are removed. Raises `UsageError` if the directory contains something that tacpipe did not
    write.
    """
    directory = directory.absolute()
    with changing(store, directory):
        planned = decide()
        if planned.manifest.recorded:
            planned.manifest.keep(store, durable=True)
        _show(store, planned, directory)
    return planned.manifest


@contextlib.contextmanager
def changing(store: Store, directory: Path) -> Iterator[None]:
    """Hold the lock for changing ``directory``, including reading its manifest in order to change it."""
    directory = directory.absolute()
    with store.leases.hold(digest(["output", *store.roots.kind_and_name(directory)]), f"the output {directory}"):
        yield


def _show(store: Store, planned: DirectoryChange, directory: Path) -> None:
    """Make ``directory`` show what is planned, with its lock held. Raises the errors of `change`."""
    manifest, relabelled = planned.manifest, planned.relabelled
    check_output(store, directory)
    current = _is_current(directory, manifest)
    stale: dict[str, str] = {}
    removed: set[str] = set()
    # files of an export are large copies, so correct ones are not written again
    if current or (manifest.exported and not relabelled):
        stale = dict(_stale(store, manifest, directory))
    if not current and relabelled:
        stale, removed = _compare_pages(_current_manifest(directory), manifest, directory)
    elif not current:  # existing files are not written again, so the cost depends only on new recordings
        before = _current_manifest(directory)
        unlike, removed = _compare_files(before, manifest, directory, is_complete=planned.is_complete)
        if before is None:  # the names of its pages differ from those of the previous manifest
            removed |= _compare_pages(replacing.former(store, directory), manifest, directory)[1]
        stale = stale if manifest.exported else unlike
    refuse_links(directory, {*stale, *removed})
    edited = []
    if manifest.exported or planned.replace:  # only these two replace an export
        edited = _edited_files(store, manifest, directory, {*stale, *removed})
    if edited and not planned.replace:
        raise replacing.edited_files_error(directory, edited)
    with writing(directory):
        _require_writable(directory)
        before = None if current else replacing.keep_replaced(store, directory)
        lasting = before is not None and not relabelled and bool(replacing.losses(before, manifest))
        if edited:
            _store_edited_export(store, manifest, directory, edited)
            before, lasting = None, True
        if before is not None and lasting:
            _adopt(store, directory, before)
        deliver(store, directory, manifest, lasting=lasting)
        key = stored_key(store, directory) if relabelled else planned.key
        store.roots.set(directory, manifest.content_digest, durable=True, lasting=lasting, key=key)
        store.fetch(stale.values())
        sweep(directory, shards=any("/" in path for path in stale), deep=manifest.exported)
        for path in stale:
            with contextlib.suppress(*([MissingError] if path in planned.may_lack else [])):
                place(store, stale[path], directory / path, copy=manifest.copied)
        _remove(directory, removed)
        if not current:
            write_whole(str(directory / NAME), manifest.content, str(directory / f".{NAME}{_DRAFT}"))
        if manifest.recorded:
            _settle(store, directory, stale)


def stored_key(store: Store, directory: Path) -> str:
    """Return the key in the root of a directory, empty without one."""
    root = store.roots.get(directory)
    return "" if root is None else root.get("key", "")


def _adopt(store: Store, directory: Path, manifest: Manifest) -> None:
    """Store the objects of ``manifest`` that exist only in its directory, for example after a copy without its store."""
    for path, name, size in manifest.contents():
        content = None if store.has(name) else verified_copy(name, path, (str(directory),), size)
        if content is not None:
            store.put(content, durable=True)


def edited_files(store: Store, manifest: Manifest, directory: Path) -> list[str]:
    """Return the edited files in ``directory`` that the export ``manifest`` would replace."""
    directory = directory.absolute()
    stale = dict(_stale(store, manifest, directory))
    _, removed = _compare_files(_current_manifest(directory), manifest, directory, is_complete=False)
    return _edited_files(store, manifest, directory, {*stale, *removed})


def _edited_files(store: Store, manifest: Manifest, directory: Path, paths: Iterable[str]) -> list[str]:
    """Return the files of an export that match neither the last written content nor an object of the store."""
    current = _current_manifest(directory)
    if not (current or manifest).exported:  # shards are links, so a difference is damage
        return []
    digests_written = {} if current is None else {path: file["digest"] for path, file in current.files.items()}
    present = [path for path in sorted(paths) if (directory / path).is_file()]
    digests = {path: file_digest(directory / path) for path in present}
    return [path for path, name in digests.items() if name != digests_written.get(path) and not store.has(name)]


def _store_edited_export(store: Store, manifest: Manifest, directory: Path, paths: Iterable[str]) -> None:
    """Store the edited export as the dataset that was last written in ``directory``."""
    files = {}
    for path in paths:
        with regular.opened(directory / path) as file:
            stored = store.put_written(lambda draft, file=file: shutil.copyfileobj(file, draft), durable=True)  # type: ignore[misc]
        files[path] = stored.to_json()
    before = _current_manifest(directory) or manifest
    edited = replace(before, files=dict(sorted({**before.files, **files}.items())))
    edited.keep(store, durable=True)
    store.roots.set(directory, edited.content_digest)


def sweep(directory: Path, *, shards: bool = True, deep: bool = False) -> None:
    """Remove drafts that killed processes left in a directory, recognized by their names, and nothing else.

    Without ``shards``, only drafts of the manifest; with ``deep``, in folders at any depth, as in exports.
    """
    if deep:
        folders = [Path(place) for place, _, _ in walk(directory, links=False)]
    else:
        folders = [directory, *(_folders(directory) if shards else ())]
    for folder in folders:
        for path in listed(folder, f".*{_DRAFT}"):
            if _OURS.fullmatch(path.name):
                _remove_draft(path)


def _folders(folder: Path) -> list[Path]:
    """Return the folders in a folder, without links. Files are not opened, because there may be a hundred thousand."""
    try:
        with os.scandir(folder) as entries:
            return sorted(folder / entry.name for entry in entries if entry.is_dir(follow_symlinks=False))
    except (FileNotFoundError, NotADirectoryError):
        return []


def sweep_beside(path: Path) -> None:
    """Remove drafts of the file ``path`` that killed processes left; other files in its folder are not touched."""
    for draft in listed(path.parent, f".*{_DRAFT}"):
        ours = _OURS.fullmatch(draft.name)
        if ours and ours["name"] == path.name[:100]:
            _remove_draft(draft)


def _remove_draft(path: Path) -> None:
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)


def _settle(store: Store, directory: Path, paths: Iterable[str]) -> None:
    """Make the files written in ``directory`` survive a power loss, because recordings and labels cannot be recomputed."""
    for folder in {(directory / path).parent for path in paths} - {directory}:
        sync_folder(str(folder))
    project = store.root.parent
    sync_folders(str(directory), str(project if directory.is_relative_to(project) else directory.parent))


def _require_writable(directory: Path) -> None:
    """Create a directory if it does not exist. Raises `OSError` if it cannot contain files, so that it gets no root."""
    directory.mkdir(parents=True, exist_ok=True)
    if not os.access(directory, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(directory))


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise file system errors of the block as a `TacpipeError` about the output at ``path``."""
    try:
        yield
    except OSError as error:
        raise TacpipeError(
            f"{path} cannot be written: {error.strerror or error}. The result is kept in the store: run the same command "
            f"again when that is fixed."
        ) from error


def _stale(store: Store, manifest: Manifest, directory: Path) -> Iterator[tuple[str, str]]:
    """Yield path and digest of the objects that ``directory`` lacks or that differ there."""
    return (item for item in manifest.objects() if not _matches(f"{directory}/{item[0]}", store, item[1]))


def _compare_files(
    current: Manifest | None, manifest: Manifest, directory: Path, *, is_complete: bool
) -> tuple[dict[str, str], set[str]]:
    """Return path and digest of the files to write to ``directory``, and the paths to remove.

    Files are written if they are missing, have the wrong size, or differ from ``current``, the directory's current
    manifest. If all files of ``current`` exist (``is_complete``), pages in both manifests are skipped.
    """
    stale, removed = _compare_pages(current, manifest, directory)
    files = {} if current is None else current.files
    manifests = {} if current is None else current.recordings, manifest.recordings
    for name, old_entry, new_entry in pages.compared(*(pages.differing(*manifests) if is_complete else manifests)):
        old, new = ({} if entry is None else entry["shards"] for entry in (old_entry, new_entry))
        removed.update(shard_path(name, stream) for stream in old if stream not in new)
        for stream, shard in new.items():
            path = shard_path(name, stream)
            if not (_has_same_digest(old.get(stream), shard) and _is_in_place(directory, path, shard["bytes"])):
                stale[path] = shard["digest"]
    removed.update(path for path in files if path not in manifest.files)
    for path, file in manifest.files.items():
        if not (_has_same_digest(files.get(path), file) and _is_in_place(directory, path, file["bytes"])):
            stale[path] = file["digest"]
    return stale, {path for path in removed if manifest.at(path) is None}


def _compare_pages(current: Manifest | None, manifest: Manifest, directory: Path) -> tuple[dict[str, str], set[str]]:
    """Return path and digest of the pages to write, and the paths of the pages to remove; see `_compare_files`."""
    old, new = (
        {} if side is None or side.pages is None else {page.path: page for page in side.pages.pages}
        for side in (current, manifest)
    )
    present = {path for path, page in new.items() if path in old and _is_in_place(directory, path, page.bytes)}
    return {path: page.digest for path, page in new.items() if path not in present}, old.keys() - new.keys()


def _has_same_digest(before: Content | None, now: Content) -> bool:
    return before is not None and before["digest"] == now["digest"]


def refuse_links(directory: Path, paths: Iterable[str]) -> None:
    """Raise `UsageError` for folders in a dataset that are links: files behind them may not belong to the dataset."""
    for folder in {folder for path in paths for folder in list(Path(path).parents)[:-1]}:
        if (directory / folder).is_symlink():
            raise UsageError(
                f"{directory / folder} is a symbolic link out of its dataset. Remove it, or give -o another directory."
            )


def _remove(directory: Path, paths: set[str]) -> None:
    """Remove files of a dataset that exist, and the folders that are then empty."""
    for path in paths:
        with contextlib.suppress(FileNotFoundError, IsADirectoryError, NotADirectoryError):
            (directory / path).unlink()
    folders = {directory / folder for path in paths for folder in list(Path(path).parents)[:-1]}
    for folder in sorted(folders, key=lambda path_: len(path_.parts), reverse=True):  # deepest folders first
        with contextlib.suppress(OSError):  # not empty, or already removed
            folder.rmdir()


def check_output(store: Store, directory: Path) -> None:
    """Raise `UsageError` if the directory contains something that tacpipe did not write, or belongs to another dataset."""
    directory = directory.absolute()
    layout.refuse_within(directory)
    if directory.is_file():
        raise UsageError(f"{directory} is a file; give -o a directory.")
    if (directory / NAME).exists() or store.roots.get(directory) is not None:
        return
    around = next((folder for folder in directory.parents if (folder / NAME).is_file()), None)
    if around is not None:
        raise UsageError(f"{directory} lies within the dataset {around}. Give -o a directory outside of it.")
    if not directory.is_dir():
        return
    below = (Path(place, name) for place, _, names in walk(directory, links=False) for name in names)
    for path in below:  # the project was moved: its shards are known, but its path is not
        if path.name == NAME and path.is_file():
            raise UsageError(f"{directory} holds the dataset {path.parent}. Give -o a directory of its own.")
        if path.is_file() and path.name != ".gitignore" and not store.has(file_digest(path)):
            raise UsageError(
                f"{directory} has no {NAME} and holds {path.relative_to(directory)}, which tacpipe did not write. "
                f"Give -o a new directory."
            )


def place(store: Store, name: str, path: Path, *, copy: bool) -> None:
    """Put the object ``name`` at ``path`` as a reflink, hard link or copy, in this order; only as a copy if ``copy``.

    The object is verified first. Raises `MissingError` if it is missing or damaged in the store.
    """
    if not copy:
        for _ in store.blocks(name):  # reading all blocks verifies the object
            pass
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name[:100]}.{uuid.uuid4().hex[:12]}{_DRAFT}")
    source = store.object_path(name)
    try:
        if copy or not _link(source, draft):
            write_whole(str(path), store.blocks(name), str(draft))  # the content is verified before the file is renamed
        else:
            draft.replace(path)
    except FileNotFoundError:
        raise MissingError(f"Object {name[:12]} vanished from the store; run the same command again.") from None
    finally:
        with contextlib.suppress(OSError):  # a remaining draft is removed by the next process that writes here
            draft.unlink()


def _link(source: str, target: Path) -> bool:
    """Create ``target`` as a reflink or hard link of ``source``; return whether the file system supports that."""
    import fcntl

    with regular.opened(source, follow=False) as reading, open(target, "wb") as writing, contextlib.suppress(OSError):
        fcntl.ioctl(writing.fileno(), 0x40049409, reading.fileno())  # FICLONE
        return True
    target.unlink()
    with contextlib.suppress(OSError):
        os.link(source, target)
        return True
    return False


def _matches(path: str, store: Store, name: str) -> Literal["", "files", "links"]:
    """Return how ``path`` matches the object ``name``: a link by its inode, a file by its content; "" if it does not."""
    try:
        status = os.lstat(path)
        symbolic = stat.S_ISLNK(status.st_mode)
        if symbolic:  # the target of a link may change without a change of the directory
            status = os.stat(path)  # noqa: PTH116  (once a shard)
        stored = os.lstat(store.object_path(name))
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return ""
    if (status.st_dev, status.st_ino) == (stored.st_dev, stored.st_ino):
        return "files" if symbolic else "links"
    return "files" if status.st_size == stored.st_size and file_digest(path) == name else ""


def _is_current(directory: Path, manifest: Manifest) -> bool:
    """Return whether the manifest in a directory has the content of ``manifest``. Raises `IrregularError` for no file."""
    try:
        file = directory / NAME
        status = file.stat()
        regular.require(file, status.st_mode)
        if len(manifest.content) != status.st_size <= regular.JSON_BYTES:  # larger files are rejected below
            return False
        return regular.content(file, regular.JSON_BYTES) == manifest.content
    except (FileNotFoundError, NotADirectoryError):
        return False


def _is_in_place(directory: Path, path: str, size: int) -> bool:
    """Return whether a path of a dataset is a regular file of this size."""
    try:
        status = os.lstat(f"{directory}/{path}")
    except (FileNotFoundError, NotADirectoryError):
        return False
    return stat.S_ISREG(status.st_mode) and status.st_size == size


def _current_manifest(directory: Path) -> Manifest | None:
    """Return the manifest in ``directory``, or None if there is no readable one."""
    try:
        return find(directory).manifest
    except StorageError:
        raise
    except TacpipeError:
        return None
