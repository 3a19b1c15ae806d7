"""Looking after a store: what is in it, whether it is sound, and mending it."""

from __future__ import annotations

import os
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tacpipe import directory as directory_of
from tacpipe import execution
from tacpipe import manifest as manifest_of
from tacpipe.errors import TacpipeError
from tacpipe.files import write_whole
from tacpipe.hashing import bytes_digest, file_digest
from tacpipe.roots import PUSHED
from tacpipe.store import MissingError, Store, locate


@dataclass
class Soundness:
    """What was looked at, what was wrong, and what could be done about it."""

    objects: int = 0
    records: int = 0
    damaged: list[str] = field(default_factory=list)  # digests and keys, now in quarantine
    missing: list[str] = field(default_factory=list)  # objects that a root's manifest names
    repaired: list[str] = field(default_factory=list)
    lost: dict[str, str] = field(default_factory=dict)  # digest to why it cannot be made again

    @property
    def clean(self) -> bool:
        """Whether nothing was damaged and nothing is missing."""
        return not (self.damaged or self.missing or self.lost)

    def to_text(self) -> str:
        """Return the findings in words."""
        lines = [f"{self.objects} objects and {self.records} records read"]
        lines += [f"damaged, now in quarantine: {name}" for name in self.damaged]
        lines += [f"missing: {name}" for name in self.missing]
        lines += [f"made again: {name}" for name in self.repaired]
        lines += [f"cannot be made again: {name}: {why}" for name, why in self.lost.items()]
        if self.clean:
            lines.append("all sound")
        elif not self.repaired and not self.lost:
            lines.append("`tacpipe store repair` makes again what it can")
        return "\n".join(lines)


def verify(store: Store) -> Soundness:
    """Return the soundness of every object and record; damaged ones are moved to quarantine."""
    found = Soundness()
    for path in store.listed("objects", "*", "*"):
        found.objects += 1
        try:
            store.read(path.name)
        except MissingError:
            found.damaged.append(path.name)
    for path in store.listed("records", "*", "*.json"):
        found.records += 1
        if store.record(path.stem) is None:
            found.damaged.append(path.stem)
    for path in store.listed("roots", "*.json"):
        if store.roots.at(path) is None:
            found.damaged.append(f"root {path.stem}")
    found.missing = sorted(set(_wanted(store)) - set(found.damaged))
    return found


def repair(store: Store) -> Soundness:
    """Return the soundness after making again, or adopting from dataset directories, what roots name and is not there."""
    with store.at_work():
        found = verify(store)
        found.repaired += _roots_again(store)
        roots = store.roots.all()
        found.repaired += [name for root in roots for name in _manifest_again(store, root)]
        manifests = [one for one in (_find(root) for root in roots) if one is not None]
        for one in manifests:
            if not store.has(one.digest):
                store.put(one.content)
                found.repaired.append(one.digest)
        wanted = _wanted(store)
        read = execution.reader(store, tuple(root["path"] for root in roots))
        for name, path in sorted(wanted.items()):
            try:
                read(name, path)
                found.repaired.append(name)
            except TacpipeError as error:
                found.lost[name] = str(error)
        found.missing = []
    return found


def _roots_again(store: Store) -> list[str]:
    """Write damaged roots anew whose datasets lie beside the store; return their names."""
    names, found = store.roots.damaged(), []
    for place, folders, files in os.walk(store.root.parent) if names else ():
        folders[:] = [folder for folder in folders if not folder.startswith(".")]
        if manifest_of.NAME not in files:
            continue
        one = _sound(Path(place))
        if one is None:
            continue
        for name in names:
            if store.roots.is_of(name, Path(place)):
                store.roots.set(Path(place), one.digest)
                found.append(f"root {name}")
    return found


def _manifest_again(store: Store, root: dict[str, Any]) -> list[str]:
    """Write the manifest at a root's path anew where it is damaged; return its digest. What lay there goes to quarantine."""
    path = Path(root["path"]) / manifest_of.NAME
    if root["kind"] == PUSHED or not path.is_file() or _find(root) is not None:
        return []
    try:
        content = store.read(root["manifest"])
    except MissingError:
        return []
    store.write_file(store.root / "quarantine" / f"{path.name}.{time.time_ns()}", path.read_bytes())
    with directory_of.changing(store, path.parent), directory_of.writing(path.parent):
        write_whole(str(path), content, str(path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.draft")))
    return [root["manifest"]]


def link(path: Path) -> int:
    """Link the shards of the dataset at ``path`` anew where they do not match its manifest; return how many."""
    found = manifest_of.find(path)
    manifest, directory = found.manifest, found.directory
    store = locate(directory)
    with store.at_work([found.digest]), directory_of.changing(store, directory):
        sizes = dict(manifest.sizes())
        read = execution.reader(store, (str(directory.absolute()),), sizes)
        stale = []
        for name, digest in manifest.objects():
            there = directory / name
            matches = there.is_file() and there.stat().st_size == sizes[digest] and file_digest(there) == digest
            if not (matches and store.has(digest)):
                read(digest, name)  # heals the store first
            if not matches:
                stale.append((name, digest))
        directory_of.refuse_links(directory, [name for name, _ in stale])
        with directory_of.writing(directory):
            directory_of.sweep(directory)
            for name, digest in stale:
                directory_of.place(store, digest, directory / name, copy=manifest.recorded)
        store.put(found.content)
        store.roots.set(directory.absolute(), found.digest)
    return len(stale)


def status(store: Store) -> dict[str, Any]:
    """Return where the store is, counts and bytes of what lies in it, its roots and who is at work."""
    folders = {}
    for name in ("objects", "records", "quarantine", "tmp", "checkpoints"):
        files = [path for path in (store.root / name).rglob("*") if path.is_file()]
        folders[name] = {"files": len(files), "bytes": sum(path.stat().st_size for path in files)}
    roots = [{**root, "reachable": root["kind"] == PUSHED or Path(root["path"]).exists()} for root in store.roots.all()]
    return {"store": str(store.root), **folders, "roots": roots, "running": [run.note for run in store.leases.runs()]}


def status_text(value: dict[str, Any]) -> str:
    """Return the status in words."""
    lines = [value["store"]]
    lines += [
        f"  {name:<12} {value[name]['files']:>8} files {value[name]['bytes'] / 1e6:>10.1f} MB"
        for name in ("objects", "records", "quarantine", "tmp", "checkpoints")
    ]
    lines += [
        f"  root  {root['manifest'][:12]}  {root['path']}" + ("" if root["reachable"] else "  (cannot be reached)")
        for root in value["roots"]
    ]
    lines += [f"  at work: process {note.get('pid')} on {note.get('host')}" for note in value["running"]]
    return "\n".join(lines)


def _find(root: dict[str, Any]) -> manifest_of.Found | None:
    """Return the manifest at a root's path, None if there is no sound one."""
    return None if root["kind"] == PUSHED else _sound(Path(root["path"]))


def _sound(directory: Path) -> manifest_of.Found | None:
    try:
        found = manifest_of.find(directory)
        found.manifest  # noqa: B018  (is it sound?)
    except TacpipeError:
        return None
    return found


def _wanted(store: Store) -> dict[str, str]:
    """Return what roots need and is not in the store, with paths: manifests, and all that those at the paths name."""
    wanted = {}
    for root in store.roots.all():
        found = _find(root)
        try:
            content = store.read(root["manifest"]) if found is None else found.content
            name = bytes_digest(content)
            manifest = manifest_of.parse(content, name, verified=True)
        except TacpipeError:
            continue
        if not store.has(name):
            wanted[name] = manifest_of.NAME
        wanted.update({name: path for path, name in manifest.objects() if not store.has(name)})
    return wanted
