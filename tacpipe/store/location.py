"""Locate the store and the project of a command."""

from __future__ import annotations

import errno
import functools
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.io.files import present, read_error
from tacpipe.store import addresses, layout
from tacpipe.store.layout import BESIDE_NAME
from tacpipe.store.store import Store

# files and folders that mark a project's folder
MARKS = (
    "pyproject.toml",
    "dvc.yaml",
    "params.yaml",
    ".git",
    f"{BESIDE_NAME}/{layout.PROJECT}",
)


def open_store(place: str, run: str = "") -> Store:
    """Return the store at a path or address as in `Store.place`; ``run`` is the argument of `Store`."""
    address = addresses.parse_address(place)
    if isinstance(address, Path):
        return Store(address, run)
    from tacpipe.store.cached import CachedStore  # needed only for buckets

    return CachedStore(address, run)


def locate(*datasets: Path) -> Store:
    """Return the store for a command that reads or writes ``datasets``, the output first.

    It is given by ``TACPIPE_STORE``, or else it is in `project`. For an address, this is a store with a local cache.
    Raises `UsageError` as `layout.check` does, for an address that is not a bucket, and for another user's store that
    ``TACPIPE_STORE`` does not name.
    """
    setting = os.environ.get("TACPIPE_STORE")
    if setting:
        place = addresses.parse_address(setting)
        store = open_store(str(place.absolute() if isinstance(place, Path) else place))
    else:
        store = Store(project(*datasets) / BESIDE_NAME)
        _refuse_other_owner(store.root)
    store.check()
    return store


def project(*datasets: Path) -> Path:
    """Return the folder whose ``.tacpipe`` is the store for ``datasets``, which need not exist.

    The folder is in the project of the first dataset that has one, or else in the project of the working directory. Within
    the project the nearest store upwards is used, or a new store in the project's folder. A store outside the project is
    used only if it already contains one of the datasets.
    """
    paths = [Path(os.path.abspath(path)) for path in datasets]  # noqa: PTH100  (a name holds no "..", and links stay)
    start = next((path for path in paths if project_folder(path) is not None), None)
    top = None if start is None else project_folder(start)
    if start is None or top is None:
        folder = _holder({folder: None for path in paths for folder in path.parents}, paths)
        if folder is not None:
            return folder
        start = Path.cwd()
        top = project_folder(start) or start
    for folder in (start, *start.parents):
        if _exists(folder / BESIDE_NAME):
            return folder
        if folder == top:
            break
    return _holder(top.parents, paths) or top


def project_folder(path: Path) -> Path | None:
    """Return the nearest parent with a project mark, else the working directory if it is a parent, else None."""
    for folder in (path, *path.parents):
        if any(_exists(folder / mark) for mark in MARKS):
            return folder
    working_directory = Path.cwd()
    return working_directory if working_directory in path.parents else None


def _holder(folders: Iterable[Path], datasets: Sequence[Path]) -> Path | None:
    """Return the first of ``folders`` outside the datasets' projects whose store contains one of the datasets, or None."""
    for folder in folders:
        root = folder / BESIDE_NAME
        if not _exists(root) or _other_owner(root) is not None:
            continue
        store = Store(root)
        dataset = next((path for path in datasets if store.roots.get(path) is not None), None)
        if dataset is not None:
            _report_holder(root, dataset)
            return folder
    return None


@functools.cache
def _report_holder(root: Path, dataset: Path) -> None:
    """Report that a store outside the project is used because it contains ``dataset``."""
    terminal.report_progress(
        f"the store {root} is used: it holds {dataset}, though no project is marked from there to here. If all below "
        f"{root.parent} is one project, run `tacpipe store init` there."
    )


def _other_owner(root: Path) -> int | None:
    """Return the user id of a store's owner if it is another user, else None."""
    try:
        owner = os.stat(root).st_uid  # noqa: PTH116  (of what a link leads to)
    except OSError:  # described by `layout.check`
        return None
    return None if owner == os.geteuid() else owner


def _refuse_other_owner(root: Path) -> None:
    """Raise `UsageError` for another user's store, because its owner could change results."""
    owner = _other_owner(root)
    if owner is not None:
        raise UsageError(
            f"The store {root} belongs to another user (id {owner}; yours is {os.geteuid()}). The owner of a store "
            f"can change its results. Set TACPIPE_STORE={root} to use it anyway."
        )


def _exists(path: Path) -> bool:
    """Return whether a mark exists; a link to an unmounted disk counts.

    Raises `StorageError` if that cannot be determined, because another store would be used without the mark.
    """
    try:
        return present(path)
    except ValueError:  # the path is invalid
        return False
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            return False
        raise read_error(path, error) from error
