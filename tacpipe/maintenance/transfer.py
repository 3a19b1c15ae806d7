"""Copies of datasets to and from another store, a folder or a bucket, so that CI evaluates what a rig recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from tacpipe.datasets import directory as directory_of
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import paths, replacing
from tacpipe.errors import DamagedError, StorageError, TacpipeError, UsageError
from tacpipe.io import files, regular
from tacpipe.io.files import may_not_write
from tacpipe.io.hashing import digest
from tacpipe.maintenance import copying, pushed
from tacpipe.maintenance.copying import Transferred
from tacpipe.maintenance.pushed import AnyStore
from tacpipe.printable import plain
from tacpipe.store import addresses, layout, projects
from tacpipe.store.bucket import Bucket
from tacpipe.store.location import locate
from tacpipe.store.projects import Project
from tacpipe.store.remote import RemoteStore
from tacpipe.store.roots import Root, project_id
from tacpipe.store.store import Store

_LOOKS = 100  # pushes of one name that may come first


def named_store(remote: Path | str) -> AnyStore:
    """Return the store at a path or an address, whether or not there is one. Raises `UsageError` for another address."""
    found = addresses.parsed(str(remote))
    if isinstance(found, Path):
        return Store(files.local(found).absolute())
    return RemoteStore(Bucket(found))


def remote_store(remote: Path | str) -> AnyStore:
    """Return the store at a path or an address, which is only read. Raises `UsageError` where none is."""
    store = named_store(remote)
    if isinstance(store, RemoteStore):
        if not store.check():
            raise UsageError(
                f"{remote} is not a store: it has no `format`. Give an address that `store push` wrote to."
            )
        return store
    try:
        store.files.read(layout.MARK, regular.BLOCK_BYTES)
    except (FileNotFoundError, StorageError) as error:
        if isinstance(error, StorageError) and not isinstance(error.__cause__, NotADirectoryError):
            raise
        raise UsageError(
            f"{remote} is not a store: it has no file `format`. Give a directory that `store push` wrote."
        ) from None
    except regular.IrregularError as error:
        raise UsageError(f"{remote} is not a store: {error}") from None
    store.prepare()  # refuses one of another format
    return store


def push(
    remote: Path | str,
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
    there, done = named_store(remote), Transferred()
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
            with there.exclusively(lock, f"the pushed dataset {name}"):
                before = _before(there, here, found, owner, name, replace=replace)
                copying.copy(
                    here,
                    there,
                    found,
                    done,
                    beside=(str(found.directory.absolute()),),
                    ancestors=ancestors,
                    verify=verify,
                    before="" if before is None else before["manifest"],
                )
                _name(there, here, found, owner, name, before, replace=replace)
            if writable:
                here.roots.note_pushed(found.directory.absolute(), found.digest)
        every = pushed.roots(there)
        done.datasets += [pushed.label(root, every) for root in every if _is(root, owner, name)]
    return done


def pull(remote: Path | str, paths: Sequence[Path], *, ancestors: bool = False, replace: bool = False) -> Transferred:
    """Copy datasets from the store at ``remote``: those whose manifest lies at the path, else what was pushed from there.

    ``PROJECT:PATH`` is what another project pushed, and is written to that path of this one.
    """
    there, done = remote_store(remote), Transferred()
    for path in paths:
        found, name = _wanted(path, there)
        local_store = locate(found.directory)
        manifest = found.manifest  # one edited by hand is refused before anything moves
        directory_of.check_output(local_store, found.directory)
        occupant = replacing.occupant(local_store, found.directory)
        if occupant is not None and occupant.content != manifest.content and not replace:
            raise UsageError(
                f"{found.directory} holds another dataset than {name}. --replace writes {name} there, and what is there now "
                f"stays in the store; `tacpipe store checkout {name} --remote {remote} -o DIRECTORY` writes it elsewhere."
            )
        with local_store.at_work([found.digest]):
            bring(there, local_store, found, done, ancestors=ancestors)
            directory_of.publish(local_store, manifest, found.directory, replace=replace)
        done.datasets.append(name)
    return done


def bring(
    there: AnyStore, here: Store, found: manifest_of.Found, done: Transferred, *, ancestors: bool = False
) -> None:
    """Copy what a dataset of another store needs into this one, which is at work on it. Raises as `push` does."""
    copying.copy(there, here, found, done, beside=(), ancestors=ancestors, verify=False)


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


def _name(
    there: AnyStore,
    here: Store,
    found: manifest_of.Found,
    owner: Project,
    name: str,
    before: Root | None,
    *,
    replace: bool,
) -> None:
    """Have ``name`` mean what was copied. Raises as `push` does where another push came first."""
    project = {"id": owner.id, "name": owner.name}
    for _ in range(_LOOKS):
        lasting = before is not None and pushed.lasting(there, before["manifest"])
        if there.roots.push(name, project, found.digest, before, lasting=lasting):
            break
        before = _before(there, here, found, owner, name, replace=replace)
    else:
        raise TacpipeError(f"{name} is pushed to {there.place} by others all the time. Run the same command again.")
    _expect_kept(there, name, owner, found.digest)
    if before is not None and not project_id(before):
        there.roots.remove(before)  # its manifests are in the history of the new one


def _before(
    there: AnyStore, here: Store, found: manifest_of.Found, owner: Project, name: str, *, replace: bool
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


def _expect_kept(there: AnyStore, name: str, owner: Project, manifest: str) -> None:
    """Raise `TacpipeError` where a push of the same name wrote its root over this one's at the same time.

    The lease excludes that, but for file systems without locks; in a bucket it takes three pushes during one of them.
    """
    root = there.roots.pushed(name, owner.id) or {}
    if manifest not in (root.get("manifest"), *(one["manifest"] for one in root.get("history", ()))):
        raise TacpipeError(
            f"Another push of {name} to {there.place} ended at the same time and wrote over this one: there are no locks. "
            f"Run the same command again, and one push at a time."
        )


def _is(root: Root, owner: Project, name: str) -> bool:
    return project_id(root) == owner.id and root["path"] == name


def _wanted(path: Path, there: AnyStore) -> tuple[manifest_of.Found, str]:
    """Return the manifest at a path, else that which was pushed from there or by the project that is named, and its name."""
    directory = path.parent if path.name == manifest_of.NAME else path
    if (directory / manifest_of.NAME).exists():
        return manifest_of.Found(directory, manifest_of.find(directory).content, there), str(directory)
    folder, name = projects.place(directory)
    local_store = locate(directory)
    root = pushed.find(there, str(path), name, projects.identity_of(local_store, folder))
    if root["path"] != name:  # PROJECT:PATH
        if not paths.safe_path(root["path"]):
            raise UsageError(
                f"{plain(root['path'])} is not a path within a project. `tacpipe store checkout {root['manifest'][:12]} "
                f"--remote {there.place} -o DIRECTORY` writes it elsewhere."
            )
        directory = folder / root["path"]
    content = there.read(root["manifest"], regular.JSON_BYTES)
    return manifest_of.Found(directory, content, there), pushed.label(root, pushed.roots(there))
