"""Which store a command uses, and the project that it works in."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from tacpipe.io.files import present, unread
from tacpipe.store import addresses
from tacpipe.store.roots import BESIDE_NAME
from tacpipe.store.store import Store


def opened(place: str, run: str = "") -> Store:
    """Return the store at a path or an address, as `Store.place` names it; ``run`` is as `Store` has it."""
    found = addresses.parsed(place)
    if isinstance(found, Path):
        return Store(found, run)
    from tacpipe.store.cached import CachedStore  # of a bucket alone: others need not load it

    return CachedStore(found, run)


def locate(start: Path | None = None) -> Store:
    """Return the store to use: ``TACPIPE_STORE``, else ``.tacpipe`` next to the project that ``start`` lies in.

    That may be an address: the folder in front of the bucket is then used as a store is. Raises `UsageError` where something
    else lies there, as `layout.check` does, and for an address that is not one of a bucket.
    """
    named = os.environ.get("TACPIPE_STORE")
    if named:
        found = addresses.parsed(named)
        store = opened(str(found.absolute() if isinstance(found, Path) else found))
    else:
        store = Store(project(start) / BESIDE_NAME)
    store.check()
    return store


def project(start: Path | None = None) -> Path:
    """Return the folder of the project: the nearest one upwards with a store, a ``dvc.yaml`` or a git repository."""
    here = (start or Path.cwd()).absolute()
    return marked(here) or here


def marked(here: Path) -> Path | None:
    """Return the nearest folder upwards that has the mark of a project, None where none has."""
    for mark in (BESIDE_NAME, "dvc.yaml", ".git"):
        for folder in (here, *here.parents):
            if _marks(folder / mark):
                return folder
    return None


def _marks(path: Path) -> bool:
    """Return whether a mark is there; a link to a disk that is not mounted counts.

    Raises `StorageError` where the system fails to look: without the mark another store would be used.
    """
    try:
        return present(path)
    except ValueError:  # of a path that nothing can have
        return False
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            return False
        raise unread(path, error) from error
