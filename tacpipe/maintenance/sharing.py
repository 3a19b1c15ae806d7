"""Share a store with the group of its folder: every member may read and write it, whatever their umasks."""

from __future__ import annotations

import grp
import os
import stat

from tacpipe.errors import UsageError
from tacpipe.io.files import SHARED, readable_errors, user_name, walk
from tacpipe.store import layout
from tacpipe.store.store import Store


def share(store: Store) -> str:
    """Share an existing store with its group, and return a sentence about it.

    The group gets the permissions that the owner has, for the store's folder and for everything in it that belongs to
    this user. Spools remain private. Raises `UsageError` if the store's folder belongs to another user and is not shared.
    """
    root = store.root
    with readable_errors(root):
        status = root.stat()
        mode = stat.S_IMODE(status.st_mode)
        if mode & SHARED != SHARED:
            if os.geteuid() not in (0, status.st_uid):
                raise UsageError(
                    f"{root} belongs to the user {user_name(status.st_uid)} and is not shared. This user has to run "
                    f"`tacpipe store init --shared {root}` first."
                )
            mode |= SHARED | stat.S_IRWXG
            root.chmod(mode)
        for folder, folders, files in walk(root, links=False):
            for name in (*folders, *files):
                _share_path(f"{folder}/{name}", status.st_gid, mode)
            folders[:] = [
                name
                for name in folders
                if name not in (layout.SPOOL, layout.KEPT) and os.access(f"{folder}/{name}", os.R_OK | os.X_OK)
            ]
    return f"{root} is shared with the group {_group_name(status.st_gid)} (mode {mode:o})."


def _share_path(path: str, group: int, folder_mode: int) -> None:
    """Give a group the permissions that this user has for a file or folder; those of other users stay as they are."""
    status = os.lstat(path)
    if os.geteuid() not in (0, status.st_uid) or stat.S_ISLNK(status.st_mode):
        return
    mode = stat.S_IMODE(status.st_mode)
    os.chown(path, -1, group)
    os.chmod(path, folder_mode if stat.S_ISDIR(status.st_mode) else mode | (mode & stat.S_IRWXU) >> 3)  # noqa: PTH101


def _group_name(group: int) -> str:
    """Return the name of a group, or the id of a group without a name."""
    try:
        return grp.getgrgid(group).gr_name
    except KeyError:
        return str(group)
