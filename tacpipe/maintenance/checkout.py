"""List the datasets that the store still has, whatever their directories contain now, and restore one."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path

from tacpipe import printable
from tacpipe.datasets import directory as directory_of
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import replacing
from tacpipe.datasets.manifest import Manifest
from tacpipe.datasets.pages import StoredPages
from tacpipe.engine import execution
from tacpipe.errors import StorageError, UsageError
from tacpipe.io import regular
from tacpipe.io.hashing import DIGEST, bytes_digest
from tacpipe.maintenance import copying, pushed, transfer
from tacpipe.printable import plain
from tacpipe.store import projects
from tacpipe.store.cached import bucket_or_folder
from tacpipe.store.location import locate
from tacpipe.store.remote import AnyStore
from tacpipe.store.roots import PUSHED, Root, WrittenManifest
from tacpipe.store.store import MissingError

SHOWN, REPLACED, GONE, UNREAD = "at its path", "replaced", "directory gone", "cannot be read"
IN_STORE, EARLIER = "pushed here", "pushed earlier"
MIN_DIGITS = 6  # minimum number of hex digits that identify a manifest
_HEX = re.compile(rf"[0-9a-f]{{{MIN_DIGITS},64}}")


@dataclass(frozen=True)
class Known:
    """A manifest in the store, and the path at which it was last written."""

    manifest: str  # digest of the manifest
    dataset: str  # digest of the dataset
    stage: str
    written_s: int  # Unix time in seconds
    recordings: int
    labelled: int  # number of recordings with hand-set labels
    path: str
    state: str
    project: str = ""  # name of the project that pushed it, or digits of its id, as used in PROJECT:PATH


def list_manifests(store: AnyStore) -> list[Known]:
    """Return the current and earlier manifests of the store's roots, newest first, without those that `gc` has removed."""
    by_label: dict[tuple[str, str], Known] = {}
    roots = store.roots.all()
    for root in roots:
        root_label = pushed.label(root, roots)
        versions: list[WrittenManifest] = [root, *root.get("history", [])]
        for entry in versions:
            name, path = entry["manifest"], str(root["path"])
            manifest = manifest_of.stored_or_none(store, name)
            if manifest is None:  # collected or damaged
                continue
            earlier = EARLIER if root["kind"] == PUSHED else REPLACED
            state = _state(root, name) if entry is root else earlier
            by_label[name, root_label] = Known(
                name,
                manifest.digest,
                manifest.stage,
                int(entry.get("written_s", 0)),
                len(manifest.recordings),
                len(manifest.labels),
                path,
                state,
                root_label.removesuffix(f":{path}") if root["kind"] == PUSHED else "",
            )
    # the sort is stable, so ties keep the order of a path's history
    return sorted(by_label.values(), key=lambda listing: (-listing.written_s, listing.path))


def _state(root: Root, name: str) -> str:
    """Return what happened to the manifest ``name``, the last one written at the path of ``root``, as a constant.

    A path that is a file, such as a report, counts as showing its manifest: files are not compared.
    """
    if root["kind"] == PUSHED:
        return IN_STORE
    path = Path(root["path"])
    if path.is_file():
        return SHOWN
    try:
        current_digest = bytes_digest(regular.content(path / manifest_of.NAME, regular.JSON_BYTES))
    except (FileNotFoundError, NotADirectoryError, regular.IrregularError):
        return GONE
    except (OSError, StorageError):
        return UNREAD
    return SHOWN if current_digest == name else REPLACED


def to_text(listed: list[Known]) -> str:
    """Return one line per manifest, with times in this computer's time zone."""
    lines = [f"{'manifest':<12}  {'written':<16}  {'stage':<20}  {'recordings':>10}  {'labelled':>8}  path"]
    for entry in listed:
        date = time.strftime("%Y-%m-%d %H:%M", time.localtime(entry.written_s))
        state = "" if entry.state == SHOWN else f"  ({entry.state})"
        lines.append(
            f"{entry.manifest[:12]}  {date}  {plain(entry.stage):<20}  {entry.recordings:>10}  {entry.labelled:>8}  "
            f"{plain(_qualified_path(entry), 200)}{state}"
        )
    return printable.lines(lines)


def _qualified_path(entry: Known) -> str:
    """Return the path of a manifest, preceded by its project if it was pushed."""
    return f"{entry.project}:{entry.path}" if entry.state in (IN_STORE, EARLIER) else entry.path


def checkout(name: str, output: Path, *, replace: bool = False, source: AnyStore | None = None) -> Manifest:
    """Write the dataset ``name`` to ``output`` with its labels, from the store ``source`` if given.

    ``name`` is the digest of its manifest or of the dataset, a prefix of either, the path at which it was last written,
    or the name under which it was pushed. Content of another store is copied into this one.

    Raises `UsageError` if none or several datasets match, and if ``output`` contains a dataset that would be replaced
    without ``replace``; `DamagedError` if part of it is damaged and cannot be recomputed.
    """
    store = locate()
    other_store = source
    if source is None and store.distant:
        other_store = bucket_or_folder(store)
    read_store = other_store or store
    manifest_digest = _manifest_digest(read_store, name)
    with store.at_work([manifest_digest]):
        content = read_store.read(manifest_digest, regular.JSON_BYTES)
        manifest = manifest_of.parse(content, manifest_digest, StoredPages(read_store), verified=other_store is None)
        directory_of.check_output(store, output)
        if not replace:
            replacing.refuse_losses(replacing.occupant(store, output), output, manifest)
        read = execution.reader(store, (str(output.absolute()),), dict(manifest.sizes()))
        if other_store is not None:
            transfer.bring(other_store, store, manifest_of.Found(output, content, other_store), copying.Transferred())
        for first in (True, False):
            try:
                directory_of.publish(store, manifest, output, replace=replace)
                return manifest
            except MissingError:
                if not first:
                    raise
                for path, digest in manifest.objects():
                    read(digest, path)  # recomputes collected or damaged objects if possible
    raise AssertionError


def _is_manifest(store: AnyStore, name: str) -> bool:
    """Return whether ``name`` is the full digest of a manifest in the store."""
    return bool(DIGEST.fullmatch(name)) and store.has(name) and manifest_of.stored_or_none(store, name) is not None


def _manifest_digest(store: AnyStore, name: str) -> str:
    """Return the digest of the manifest with this digest or prefix, last written at this path, or pushed under this name.

    Raises `UsageError` if there is none, or several begin with ``name``.
    """
    root = store.roots.get(Path(name).absolute())
    if root is not None:
        return str(root["manifest"])
    if not _HEX.fullmatch(name):
        folder, _ = projects.place(Path.cwd())
        try:
            return str(pushed.find(store, name, name, projects.identity_of(locate(), folder))["manifest"])
        except UsageError as error:
            raise UsageError(
                f"{name} is neither the digest of a manifest ({MIN_DIGITS} or more hex digits) nor a path at which "
                f"{store.place} has seen a dataset; `tacpipe store list` names both. {error}"
            ) from None
    matching = {
        entry.manifest
        for entry in list_manifests(store)
        if entry.manifest.startswith(name) or entry.dataset.startswith(name)
    }
    if len(matching) > 1:
        raise UsageError(f"{len(matching)} manifests of {store.place} begin with {name}; give more of its hex digits.")
    if not matching and _is_manifest(store, name):  # a manifest without a root
        return name
    if not matching:
        raise UsageError(f"{store.place} knows no manifest {name}; `tacpipe store list` names those that it knows.")
    return matching.pop()
