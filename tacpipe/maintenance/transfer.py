"""Copy datasets to and from another store, in a folder or a bucket, so that CI can evaluate recordings of a rig."""

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
from tacpipe.store.roots import Root, RootProject, project_id
from tacpipe.store.store import Store

_LOOKS = 100  # maximum number of attempts if other pushes of the same name come first


def named_store(remote: Path | str) -> AnyStore:
    """Return the store at a path or an address, whether or not it exists. Raises `UsageError` for an invalid address."""
    address = addresses.parse_address(str(remote))
    if isinstance(address, Path):
        return Store(files.local(address).absolute())
    return RemoteStore(Bucket(address))


def remote_store(remote: Path | str) -> AnyStore:
    """Return the existing store at a path or an address, for reading. Raises `UsageError` if there is none."""
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
    store.prepare()  # raises an error if the store has another format
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
    """Copy datasets to the store at ``remote``: shards, files, records, and the manifests of their ancestors.

    With ``ancestors``, the ancestors' shards are also copied. Existing objects in ``remote`` are compared by size, or with
    ``verify`` by content, and replaced if they are damaged. Each project has its own names there; with ``project``, this
    project takes over the identity of the project with that name. Earlier pushes are retained as snapshots.

    Raises `UsageError` if another dataset was pushed under the name in the meantime, unless ``replace`` is set, and
    `DamagedError` for a local shard that is damaged and cannot be recomputed.
    """
    target, transferred = named_store(remote), Transferred()
    for path in paths:
        local_store = locate(path)
        dataset = manifest_of.find(path)
        dataset.manifest  # noqa: B018  (one edited by hand is refused before anything moves)
        folder, name = projects.place(dataset.directory)
        if project:
            projects.join(local_store, folder, pushed.project_in(target, project))
        with _announce_read(local_store, dataset.digest) as writable, target.at_work([dataset.digest]):
            owner = projects.identify(local_store, folder, writable=writable)
            if writable:
                replacing.keep_replaced(local_store, dataset.directory.absolute())
            lock = digest(["pushed", owner.id, name])
            with target.exclusively(lock, f"the pushed dataset {name}"):
                before = _predecessor(target, local_store, dataset, owner, name, replace=replace)
                copying.copy(
                    local_store,
                    target,
                    dataset,
                    transferred,
                    dataset_dirs=(str(dataset.directory.absolute()),),
                    ancestors=ancestors,
                    verify=verify,
                    before="" if before is None else before["manifest"],
                )
                _publish_name(target, local_store, dataset, owner, name, before, replace=replace)
            if writable:
                local_store.roots.note_pushed(dataset.directory.absolute(), dataset.digest)
        pushed_roots = pushed.roots(target)
        transferred.datasets += [
            pushed.label(root, pushed_roots)
            for root in pushed_roots
            if project_id(root) == owner.id and root["path"] == name
        ]
    return transferred


def pull(remote: Path | str, paths: Sequence[Path], *, ancestors: bool = False, replace: bool = False) -> Transferred:
    """Copy datasets from the store at ``remote``: those with a manifest at the path, or else those pushed from there.

    ``PROJECT:PATH`` is a dataset that another project pushed; it is written to that path in this project. Raises
    `UsageError` if the directory has another dataset, unless ``replace`` is set.
    """
    source, transferred = remote_store(remote), Transferred()
    for path in paths:
        dataset, name = _find_dataset(path, source)
        local_store = locate(dataset.directory)
        manifest = dataset.manifest  # raises if the manifest was edited by hand, before anything is copied
        directory_of.check_output(local_store, dataset.directory)
        occupant = replacing.occupant(local_store, dataset.directory)
        if occupant is not None and occupant.content != manifest.content and not replace:
            raise UsageError(
                f"{dataset.directory} holds another dataset than {name}. --replace writes {name} there, and what is there "
                f"now stays in the store; `tacpipe store checkout {name} --remote {remote} -o DIRECTORY` writes it "
                f"elsewhere."
            )
        with local_store.at_work([dataset.digest]):
            bring(source, local_store, dataset, transferred, ancestors=ancestors)
            directory_of.publish(local_store, manifest, dataset.directory, replace=replace)
        transferred.datasets.append(name)
    return transferred


def bring(
    source: AnyStore, target: Store, dataset: manifest_of.Found, transferred: Transferred, *, ancestors: bool = False
) -> None:
    """Copy the required content of a dataset in another store into this one, within a run of this store.

    Raises the errors of `push`.
    """
    copying.copy(source, target, dataset, transferred, dataset_dirs=(), ancestors=ancestors, verify=False)


@contextlib.contextmanager
def _announce_read(store: Store, manifest: str) -> Iterator[bool]:
    """Block `gc` in a store that is being read. Yields False if the store is read-only; a push does not need it.

    A concurrent collection is then not blocked: if it removes something before it is copied, the push fails with a
    `DamagedError` that explains it.
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


def _publish_name(
    target: AnyStore,
    local_store: Store,
    dataset: manifest_of.Found,
    owner: Project,
    name: str,
    before: Root | None,
    *,
    replace: bool,
) -> None:
    """Make ``name`` refer to the copied dataset. Raises the errors of `push` if another push came first."""
    project: RootProject = {"id": owner.id, "name": owner.name}
    previous = before
    for _ in range(_LOOKS):
        lasting = previous is not None and pushed.lasting(target, previous["manifest"])
        if target.roots.push(name, project, dataset.digest, previous, lasting=lasting):
            break
        previous = _predecessor(target, local_store, dataset, owner, name, replace=replace)
    else:
        raise TacpipeError(
            f"{name} is pushed to {target.place} by other commands again and again. Run the same command again later."
        )
    _expect_kept(target, name, owner, dataset.digest)


def _predecessor(
    target: AnyStore, local_store: Store, dataset: manifest_of.Found, owner: Project, name: str, *, replace: bool
) -> Root | None:
    """Return the root that a push replaces, or None if there is none. Raises `UsageError` as `push` does."""
    before = target.roots.pushed(name, owner.id)
    if before is None or replace:
        return before
    local = local_store.roots.get(dataset.directory.absolute())
    seen_manifests: set[str | None] = {dataset.digest}
    if local is not None:
        seen_manifests |= {local["manifest"], local.get("previous"), *local.get("pushed", ())}
        seen_manifests |= {entry["manifest"] for entry in local.get("history", ())}
    pushed.refuse_newer(target, before, seen_manifests, pushed.label(before, pushed.roots(target)))
    return before


def _expect_kept(target: AnyStore, name: str, owner: Project, manifest: str) -> None:
    """Raise `TacpipeError` if a concurrent push of the same name overwrote this one's root.

    The lease prevents that, except on file systems without locks; in a bucket it would take three pushes during one.
    """
    root = target.roots.pushed(name, owner.id)
    if root is None or manifest not in pushed.manifests(root):
        raise TacpipeError(
            f"Another push of {name} to {target.place} ended at the same time and replaced this one, because there are no "
            f"locks. Run the same command again, one push at a time."
        )


def _find_dataset(path: Path, source: AnyStore) -> tuple[manifest_of.Found, str]:
    """Return the manifest at a path, or else the one pushed from there or by the named project, and its name.

    Raises `UsageError` if there is none, several match, or the pushed path is not safe.
    """
    directory = path.parent if path.name == manifest_of.NAME else path
    if (directory / manifest_of.NAME).exists():
        return manifest_of.Found(directory, manifest_of.find(directory).content, source), str(directory)
    folder, name = projects.place(directory)
    local_store = locate(directory)
    root = pushed.find(source, str(path), name, projects.identity_of(local_store, folder))
    if root["path"] != name:  # PROJECT:PATH
        if not paths.safe_path(root["path"]):
            raise UsageError(
                f"{plain(root['path'])} is not a path within a project. `tacpipe store checkout {root['manifest'][:12]} "
                f"--remote {source.place} -o DIRECTORY` writes it elsewhere."
            )
        directory = folder / root["path"]
    content = source.read(root["manifest"], regular.JSON_BYTES)
    return manifest_of.Found(directory, content, source), pushed.label(root, pushed.roots(source))
