"""Copy datasets to and from another store, in a folder or a bucket, so that CI can evaluate recordings of a rig."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
from tacpipe.printable import plain
from tacpipe.store import addresses, projects
from tacpipe.store.bucket import Bucket
from tacpipe.store.location import locate
from tacpipe.store.projects import Project
from tacpipe.store.remote import AnyStore, RemoteStore
from tacpipe.store.roots import Root, RootProject
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
    if not store.check():
        raise UsageError(
            f"{remote} is not a store: it has no `format`. Give a directory or address that `store push` wrote."
        )
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
            name_push = _NamePush(target, local_store, dataset, owner, name, replace=replace)
            lock = digest(["pushed", owner.id, name])
            with target.exclusively(lock, f"the pushed dataset {name}"):
                before = name_push.predecessor()
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
                root = name_push.publish(before)
            if writable:
                local_store.roots.note_pushed(dataset.directory.absolute(), dataset.digest)
        transferred.datasets.append(pushed.label(root, pushed.roots(target)))
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


@dataclass(frozen=True)
class _NamePush:
    """The push of a copied dataset under a name of the project ``owner``."""

    target: AnyStore
    local_store: Store
    dataset: manifest_of.Found
    owner: Project
    name: str
    replace: bool

    def predecessor(self) -> Root | None:
        """Return the root that the push replaces, or None if there is none. Raises `UsageError` as `push` does."""
        before = self.target.roots.pushed(self.name, self.owner.id)
        if before is None or self.replace:
            return before
        local = self.local_store.roots.get(self.dataset.directory.absolute())
        seen_manifests: set[str | None] = {self.dataset.digest}
        if local is not None:
            seen_manifests |= {*pushed.manifests(local), local.get("previous"), *local.get("pushed", ())}
        pushed.refuse_newer(self.target, before, seen_manifests, pushed.label(before, pushed.roots(self.target)))
        return before

    def publish(self, before: Root | None) -> Root:
        """Make the name refer to the dataset, and return its root. Raises the errors of `push` if another push came first.

        Raises `TacpipeError` if a concurrent push of the same name overwrote this one's root. The lease prevents that,
        except on file systems without locks; in a bucket it would take three pushes during one.
        """
        target, name, manifest = self.target, self.name, self.dataset.digest
        project: RootProject = {"id": self.owner.id, "name": self.owner.name}
        for _ in range(_LOOKS):
            lasting = before is not None and pushed.lasting(target, before["manifest"])
            if target.roots.push(name, project, manifest, before, lasting=lasting):
                break
            before = self.predecessor()
        else:
            raise TacpipeError(
                f"{name} is pushed to {target.place} by other commands again and again. Run the same command again later."
            )
        root = target.roots.pushed(name, self.owner.id)
        if root is None or manifest not in pushed.manifests(root):
            raise TacpipeError(
                f"Another push of {name} to {target.place} ended at the same time and replaced this one, because there "
                f"are no locks. Run the same command again, one push at a time."
            )
        return root


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
