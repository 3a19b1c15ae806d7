"""Copies of datasets between stores: a directory now, so that CI evaluates what a rig recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tacpipe import directory as directory_of
from tacpipe import execution, garbage, places
from tacpipe import manifest as manifest_of
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.store import MissingError, Store, locate, project


@dataclass
class Transferred:
    """How much went over, and how much was there already."""

    objects: int = 0
    bytes: int = 0
    there: int = 0


def push(remote: Path, paths: Sequence[Path], *, ancestors: bool = False) -> Transferred:
    """Copy datasets to the store at ``remote``: shards, files, records, and the manifests they descend from.

    With ``ancestors`` the shards of those go too. Raises `DamagedError` for a shard that is damaged here and cannot be made
    again.
    """
    there, done = Store(places.local(remote).absolute()), Transferred()
    for path in paths:
        here = locate(path)
        found = manifest_of.find(path)
        found.manifest  # noqa: B018  (one edited by hand is refused before anything moves)
        with here.at_work([found.digest]), there.at_work([found.digest]):
            here.put(found.content)
            _copy(here, there, found.digest, done, beside=(str(found.directory.absolute()),), ancestors=ancestors)
            there.roots.set(_name(found.directory), found.digest, pushed=True, durable=True)
    return done


def pull(remote: Path, paths: Sequence[Path], *, ancestors: bool = False) -> Transferred:
    """Copy datasets from the store at ``remote``: those whose manifest lies at the path, else what was pushed from there."""
    there, done = Store(places.local(remote).absolute()), Transferred()
    if not (there.root / "format").exists():
        raise UsageError(f"{remote} is no store: it has no file `format`. Give a directory that `store push` wrote.")
    for path in paths:
        directory = path.parent if path.name == manifest_of.NAME else path
        here = locate(directory if directory.exists() else None)
        found = _found(directory, there)
        found.manifest  # noqa: B018  (one edited by hand is refused before anything moves)
        with here.at_work([found.digest]):
            here.put(found.content)
            _copy(there, here, found.digest, done, beside=(), ancestors=ancestors)
            directory_of.publish(here, found.manifest, directory)
    return done


def _found(directory: Path, there: Store) -> manifest_of.Found:
    """Return the manifest at the directory, else that which was pushed from there."""
    if (directory / manifest_of.NAME).exists():
        return manifest_of.find(directory)
    root = there.roots.get(_name(directory), pushed=True)
    if root is None:
        known = ", ".join(sorted(other["path"] for other in there.roots.all())) or "nothing"
        raise UsageError(f"{there.root} has no dataset {_name(directory)}; it has {known}.")
    return manifest_of.Found(directory, there.read(root["manifest"]))


def _name(directory: Path) -> Path:
    """Return how a dataset is called in a remote store: its path within the project."""
    directory = directory.absolute()
    root = project(directory if directory.exists() else None)
    return directory.relative_to(root) if directory.is_relative_to(root) else Path(directory.name)


def _copy(
    source: Store, target: Store, manifest: str, done: Transferred, *, beside: tuple[str, ...], ancestors: bool
) -> None:
    read = execution.reader(source, beside)
    moved: set[str] = set()
    todo, seen = [manifest], set()
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        try:
            content = source.read(name) if source.has(name) else target.read(name)
        except MissingError:
            if name == manifest:
                raise
            continue
        moved.add(name)
        _put(target, content, name, done)
        found = manifest_of.parse(content, name, verified=True)
        todo += garbage.ancestors(found)
        if ancestors or name == manifest:
            for path, wanted in found.objects():
                moved.add(wanted)
                if target.has(wanted):
                    done.there += 1
                else:
                    _put(target, read(wanted, path), wanted, done)
    for _, record in source.records():
        names = set(execution.named(record["result"]))
        if names and names <= moved:
            target.commit(record["identity"], record["result"], record["provenance"], durable=True)


def _put(target: Store, content: bytes, name: str, done: Transferred) -> None:
    if target.has(name):
        done.there += 1
        return
    stored = target.put(content, durable=True)
    if stored.digest != name:
        raise TacpipeError(f"Object {name[:12]} changed on its way to {target.root}. Run the same command again.")
    done.objects += 1
    done.bytes += stored.bytes
