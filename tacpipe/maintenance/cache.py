"""Remove files of the local cache of a store in a bucket."""

from __future__ import annotations

import contextlib

from tacpipe.errors import UsageError
from tacpipe.io.files import readable_errors
from tacpipe.maintenance.garbage import Collected
from tacpipe.store import layout
from tacpipe.store.cached import CachedStore
from tacpipe.store.remote import AnyStore


def clear(store: AnyStore, *, dry_run: bool) -> Collected:
    """Remove from the local cache what the bucket also has, except for objects that a running process uses.

    A command that reads a removed object fetches it again. Raises `UsageError` for a store without a cache.
    """
    if not isinstance(store, CachedStore):
        raise UsageError(f"--cache is for a store in a bucket, and {store.place} has no folder in front of it.")
    collected = Collected()
    if not store.check():
        return collected
    used = {name for run in store.leases.runs() for name in run.objects}
    objects = {path.name: path for path in layout.entries(store.root, "objects") if path.name not in used}
    bucket_sizes = store.bucket.sizes(objects)
    with readable_errors(store.root):
        for name, path in objects.items():
            with contextlib.suppress(FileNotFoundError):
                size = path.lstat().st_size
                if bucket_sizes.get(name) == size:
                    collected.objects, collected.bytes = collected.objects + 1, collected.bytes + size
                    if not dry_run:
                        path.unlink()
        records = {path.stem: path for path in layout.entries(store.root, "records")}
        for key in store.bucket.present(records):
            collected.records += 1
            if not dry_run:
                records[key].unlink(missing_ok=True)
    return collected
