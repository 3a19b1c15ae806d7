"""Copies of datasets between stores: a directory now, so that CI evaluates what a rig recorded."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tacpipe.datasets import directory as directory_of
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import replacing
from tacpipe.engine import execution
from tacpipe.errors import DamagedError, StorageError, TacpipeError, UsageError
from tacpipe.io import places, regular
from tacpipe.io.files import may_not_write
from tacpipe.io.hashing import digest
from tacpipe.maintenance import garbage, pushed
from tacpipe.printable import plain
from tacpipe.store import projects, records
from tacpipe.store.projects import Project
from tacpipe.store.roots import Root, project_id
from tacpipe.store.store import MissingError, Store, locate


@dataclass
class Transferred:
    """How much went over, and how much was there already."""

    objects: int = 0
    bytes: int = 0
    there: int = 0
    replaced: int = 0  # of the objects that went over: those that were there and damaged
    datasets: list[str] = field(default_factory=list)  # as they are named in the other store


def remote_store(path: Path) -> Store:
    """Return the store at ``path``, which is only read. Raises `UsageError` where none is."""
    store = Store(places.local(path).absolute())
    try:
        regular.content(store.root / "format", regular.BLOCK_BYTES, follow=False)
    except (FileNotFoundError, NotADirectoryError):
        raise UsageError(
            f"{path} is not a store: it has no file `format`. Give a directory that `store push` wrote."
        ) from None
    except regular.IrregularError as error:
        raise UsageError(f"{path} is not a store: {error}") from None
    store.prepare()  # refuses one of another format
    return store


def push(
    remote: Path,
    paths: Sequence[Path],
    *,
    ancestors: bool = False,
    verify: bool = False,
    replace: bool = False,
    project: str = "",
) -> Transferred:
    """Copy datasets to the store at ``remote``: shards, files, records, and the manifests they descend from.

    With ``ancestors`` the shards of those go too. What lies in ``remote`` already is compared by size, with ``verify`` by
    its bytes, and replaced where it is damaged. A name there belongs to this project, which with ``project`` becomes the one
    that is called so there. What was pushed before stays as a snapshot.

    Raises `UsageError` where another dataset was pushed under the name meanwhile, unless ``replace``, and `DamagedError` for
    a shard that is damaged here and cannot be recomputed.
    """
    there, done = Store(places.local(remote).absolute()), Transferred()
    for path in paths:
        here = locate(path)
        found = manifest_of.find(path)
        found.manifest  # noqa: B018  (one edited by hand is refused before anything moves)
        folder, name = projects.place(found.directory)
        if project:
            projects.join(here, folder, pushed.project_in(there, project))
        with _announced(here, found.digest) as writable, there.at_work([found.digest]):
            owner = projects.identify(here, folder, writable=writable)
            if writable:
                replacing.outgoing(here, found.directory.absolute())
            lock = digest(["pushed", owner.id, name])
            with there.leases.hold(lock, f"the pushed dataset {name}"):
                before = _before(there, here, found, owner, name, replace=replace)
                _copy(
                    here,
                    there,
                    found,
                    done,
                    beside=(str(found.directory.absolute()),),
                    ancestors=ancestors,
                    verify=verify,
                )
                lasting = before is not None and pushed.lasting(there, before["manifest"])
                there.roots.push(name, {"id": owner.id, "name": owner.name}, found.digest, before, lasting=lasting)
                _expect_kept(there, name, owner, found.digest)
                if before is not None and not project_id(before):
                    there.roots.remove(before)  # its manifests are in the history of the new one
            if writable:
                here.roots.note_pushed(found.directory.absolute(), found.digest)
        every = pushed.roots(there)
        done.datasets += [pushed.label(root, every) for root in every if _is(root, owner, name)]
    return done


def pull(remote: Path, paths: Sequence[Path], *, ancestors: bool = False, replace: bool = False) -> Transferred:
    """Copy datasets from the store at ``remote``: those whose manifest lies at the path, else what was pushed from there.

    ``PROJECT:PATH`` is what another project pushed, and is written to that path of this one.
    """
    there, done = remote_store(remote), Transferred()
    for path in paths:
        found, name = _wanted(path, there)
        here = locate(found.directory if found.directory.exists() else None)
        manifest = found.manifest  # one edited by hand is refused before anything moves
        directory_of.check_output(here, found.directory)
        occupant = replacing.occupant(here, found.directory)
        if occupant is not None and occupant.content != manifest.content and not replace:
            raise UsageError(
                f"{found.directory} holds another dataset than {name}. --replace writes {name} there, and what is there now "
                f"stays in the store; `tacpipe store checkout {name} --store {remote} -o DIRECTORY` writes it elsewhere."
            )
        with here.at_work([found.digest]):
            bring(there, here, found, done, ancestors=ancestors)
            directory_of.publish(here, manifest, found.directory)
        done.datasets.append(name)
    return done


def bring(there: Store, here: Store, found: manifest_of.Found, done: Transferred, *, ancestors: bool = False) -> None:
    """Copy what a dataset of another store needs into this one, which is at work on it. Raises as `push` does."""
    _copy(there, here, found, done, beside=(), ancestors=ancestors, verify=False)


@contextlib.contextmanager
def _announced(store: Store, manifest: str) -> Iterator[bool]:
    """Hold off `gc` in a store that is read and yield True; False where it may not be written, which a push does not need.

    Then a collection at the same time is not held off: what it removes before it was copied ends the push.
    """
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(store.at_work([manifest]))
            writable = True
        except StorageError as error:
            if not may_not_write(error):
                raise
            writable = False
        try:
            yield writable
        except DamagedError as error:
            if writable:
                raise
            raise DamagedError(
                f"{error} The store may not be written, so the push could not be announced there: a `tacpipe store gc` "
                f"at the same time may have removed this."
            ) from error


def _before(
    there: Store, here: Store, found: manifest_of.Found, owner: Project, name: str, *, replace: bool
) -> Root | None:
    """Return the root that a push succeeds, None if there is none. Raises `UsageError` as `push` does.

    What was pushed before projects had an identity is succeeded where this one has had it, and left alone else.
    """
    local = here.roots.get(found.directory.absolute()) or {}
    seen = {found.digest, local.get("manifest"), local.get("previous"), *local.get("pushed", ())}
    seen |= {one["manifest"] for one in local.get("history", ())}
    before = there.roots.pushed(name, owner.id)
    if before is None:
        older = there.roots.pushed(name)
        return older if older is not None and older["manifest"] in seen else None
    if not replace:
        every = pushed.roots(there)
        pushed.refuse_newer(there, before, seen, pushed.label(before, every))
    return before


def _expect_kept(there: Store, name: str, owner: Project, manifest: str) -> None:
    """Raise `TacpipeError` where a push of the same name wrote its root over this one's at the same time.

    The lease excludes that, but for file systems without locks.
    """
    root = there.roots.pushed(name, owner.id) or {}
    if manifest not in (root.get("manifest"), *(one["manifest"] for one in root.get("history", ()))):
        raise TacpipeError(
            f"Another push of {name} to {there.root} ended at the same time and wrote over this one: the file system has "
            f"no locks. Run the same command again, and one push at a time."
        )


def _is(root: Root, owner: Project, name: str) -> bool:
    return project_id(root) == owner.id and root["path"] == name


def _wanted(path: Path, there: Store) -> tuple[manifest_of.Found, str]:
    """Return the manifest at a path, else that which was pushed from there or by the project that is named, and its name."""
    directory = path.parent if path.name == manifest_of.NAME else path
    if (directory / manifest_of.NAME).exists():
        return manifest_of.find(directory), str(directory)
    folder, name = projects.place(directory)
    here = locate(directory if directory.exists() else None)
    root = pushed.find(there, str(path), name, projects.known(here, folder))
    if root["path"] != name:  # PROJECT:PATH
        if not manifest_of.safe_path(root["path"]):
            raise UsageError(
                f"{plain(root['path'])} is not a path within a project. `tacpipe store checkout {root['manifest'][:12]} "
                f"--store {there.root} -o DIRECTORY` writes it elsewhere."
            )
        directory = folder / root["path"]
    content = there.read(root["manifest"], regular.JSON_BYTES)
    return manifest_of.Found(directory, content), pushed.label(root, pushed.roots(there))


def _copy(
    source: Store,
    target: Store,
    found: manifest_of.Found,
    done: Transferred,
    *,
    beside: tuple[str, ...],
    ancestors: bool,
    verify: bool,
) -> None:
    moved: set[str] = set()
    todo, seen = [found.digest], set()
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        try:
            content = found.content if name == found.digest else _manifest(source, target, name)
        except MissingError:
            continue
        moved.add(name)
        _put(target, content, name, done, verify=verify)
        manifest = manifest_of.parse(content, name, verified=True)
        todo += garbage.ancestors(manifest)
        if ancestors or name == found.digest:
            sizes = dict(manifest.sizes())
            target.announce(sizes)
            _expect_room(target, sizes)
            read = execution.reader(source, beside, sizes)
            for path, wanted in manifest.objects():
                moved.add(wanted)
                if _is_whole(target, wanted, sizes[wanted], done, verify=verify):
                    continue
                try:
                    target.take(wanted, _counted(source.blocks(wanted, sizes[wanted]), sizes[wanted], path))
                except MissingError:  # a copy next to the manifest or the stage that made it may bring it back
                    target.take(wanted, _counted([read(wanted, path)], sizes[wanted], path))
                done.objects += 1
                done.bytes += sizes[wanted]
    for _, record in source.records():
        if _named(record) & moved and _named(record) <= moved:
            target.commit(record["identity"], record["result"], record["provenance"], durable=True)


def _manifest(source: Store, target: Store, name: str) -> bytes:
    try:
        return source.read(name, regular.JSON_BYTES)
    except MissingError:
        return target.read(name, regular.JSON_BYTES)


def _put(target: Store, content: bytes, name: str, done: Transferred, *, verify: bool) -> None:
    target.announce([name])
    if _is_whole(target, name, len(content), done, verify=verify):
        return
    if target.put(content, durable=True).digest != name:
        raise TacpipeError(f"Object {name[:12]} changed on its way to {target.root}. Run the same command again.")
    done.objects += 1
    done.bytes += len(content)


def _is_whole(target: Store, name: str, size: int, done: Transferred, *, verify: bool) -> bool:
    """Return whether an object is there already: with its size, and to ``verify`` with its bytes."""
    whole = target.has(name, size)
    damaged = not whole and target.has(name)
    if whole and verify:
        try:
            for _ in target.blocks(name, size):
                pass
        except MissingError:
            whole, damaged = False, True
    done.there += whole
    done.replaced += damaged
    return whole


def _counted(blocks: Iterable[bytes], size: int, path: str) -> Iterator[bytes]:
    """Yield blocks. Raises `DamagedError` after the last where they are not as many bytes as their manifest declares."""
    count = 0
    for block in blocks:
        count += len(block)
        yield block
    if count != size:
        raise DamagedError(
            f"{path} has {count:,} bytes, and its manifest declares {size:,}: the manifest was edited or made up. Run the "
            f"stage that made it again."
        )


def _expect_room(target: Store, sizes: Mapping[str, int]) -> None:
    """Raise `StorageError` where the disk of a store has less room than what is to be copied there takes."""
    needed = sum(size for name, size in sizes.items() if not target.has(name, size))
    disk = shutil.disk_usage(target.root)
    if disk.total and needed > disk.free:
        raise StorageError(
            f"{needed / 1e9:,.1f} GB are to be copied to {target.root}, and its disk has {disk.free / 1e9:,.1f} GB left; "
            f"nothing was copied. If that is what you expect, free some space; if it came from an untrusted store, do not."
        )


def _named(record: Mapping[str, Any]) -> set[str]:
    """Return the digests of what a record names; none where it has not the form of a record: a store may hold anything."""
    identity, provenance = record["identity"], record["provenance"]
    try:
        formed = isinstance(provenance, dict) and isinstance(identity.get("stage", ""), str)
        named = set(records.named(record["result"])) if formed else set()
    except (TypeError, KeyError, AttributeError):
        return set()
    return named if all(isinstance(name, str) for name in named) else set()
