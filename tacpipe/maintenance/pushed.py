"""Datasets that projects pushed to a store: how they are named, which one is meant, and what a push may replace.

A name belongs to a project: ``exp:data/rec`` is ``data/rec`` of the project ``exp``, and ``:data/rec`` one that was pushed
before projects had an identity. Each push is a snapshot. The newest one is what a pull takes, and those before it are the
history of the name.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Iterable

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import replacing
from tacpipe.errors import StorageError, TacpipeError, UsageError
from tacpipe.printable import listed
from tacpipe.store.projects import Project
from tacpipe.store.remote import RemoteStore
from tacpipe.store.roots import PUSHED, Root, project_id
from tacpipe.store.store import Store

AnyStore = Store | RemoteStore
SHORTEST = 6  # digits by which a project or a manifest may be named
_SHOWN_DIGITS = 8  # of a project whose name another one has too
_SHOWN = 20  # datasets listed before the rest is counted


def roots(store: AnyStore) -> list[Root]:
    """Return the roots of what was pushed to a store, by name."""
    found = [root for root in store.roots.all() if root["kind"] == PUSHED]
    return sorted(found, key=lambda root: (str(root["path"]), project_id(root)))


def labels(every: Iterable[Root]) -> dict[tuple[str, str], str]:
    """Return how each of the pushed roots of a store is named, by its project's id and its path.

    >>> one, two = ({"id": digit * 32, "name": "exp"} for digit in "ab")
    >>> list(labels([{"path": "rec", "project": one}, {"path": "rec"}]).values())
    ['exp:rec', ':rec']
    >>> list(labels([{"path": "rec", "project": one}, {"path": "rec", "project": two}]).values())
    ['aaaaaaaa:rec', 'bbbbbbbb:rec']
    """
    every = list(every)
    ids = {project_id(root): str(root.get("project", {}).get("name", "")) for root in every}
    shared = Counter(ids.values())
    names = {one: one[:_SHOWN_DIGITS] if shared[name] > 1 or ":" in name else name for one, name in ids.items()}
    return {(project_id(root), root["path"]): f"{names[project_id(root)]}:{root['path']}" for root in every}


def label(root: Root, every: Iterable[Root]) -> str:
    """Return how a root of a store is named among all ``every`` of them: by its path, behind its project if pushed."""
    if root["kind"] != PUSHED:
        return str(root["path"])
    return labels([*(one for one in every if one["kind"] == PUSHED), root])[project_id(root), root["path"]]


def _of_project(wanted: str, every: Iterable[Root]) -> list[Root]:
    """Return the pushed roots that ``PROJECT:PATH`` names.

    A project is given by its name, by `SHORTEST` or more digits of its id, or by nothing for what has none.
    """
    project, colon, path = wanted.partition(":")
    return [root for root in every if colon and root["path"] == path and _is_of(project, root)]


def _is_of(project: str, root: Root) -> bool:
    if not project:
        return not project_id(root)
    by_id = len(project) >= SHORTEST and project_id(root).startswith(project)
    return by_id or root.get("project", {}).get("name") == project


def project_in(store: AnyStore, wanted: str) -> Project:
    """Return the project of a store that has this name, or an id that begins so. Raises `UsageError` if there is not one."""
    known = {project_id(root): root["project"]["name"] for root in roots(store) if project_id(root)}
    found = [
        one for one, name in known.items() if wanted == name or (len(wanted) >= SHORTEST and one.startswith(wanted))
    ]
    if len(found) != 1:
        names = listed((f"{name} ({one[:_SHOWN_DIGITS]})" for one, name in known.items()), _SHOWN)
        several = "several projects are" if found else "no project is"
        raise UsageError(
            f"{several} called {wanted} in {store.place}; it has {names}. Give one's name, or digits of its id."
        )
    return Project(found[0], known[found[0]])


def find(store: AnyStore, wanted: str, name: str, own: Project | None) -> Root:
    """Return the root that is ``wanted`` by the project ``own``: a ``PROJECT:PATH``, or a path, in the project ``name``.

    A name alone is that of ``own``. Where ``own`` never pushed anything it may be that of the only project that has it,
    as on a second computer; and what was pushed before projects had an identity may be anybody's. Raises `UsageError`
    where none or several are meant, and names what is there.
    """
    every = roots(store)
    found = _of_project(wanted, every) or _of_name(name, every, own)
    if len(found) == 1:
        return found[0]
    names = labels(every)
    same = found or [root for root in every if root["path"] == name]
    others = sorted(names[project_id(root), root["path"]] for root in same)
    if others:
        raise UsageError(
            f"{store.place} has no dataset {wanted} of this project, but of others: {listed(others, _SHOWN)}. Give one of "
            f"these names."
        )
    known = [(root, names[project_id(root), root["path"]]) for root in every]
    shown = [root["path"] if _of_name(root["path"], every, own) == [root] else named for root, named in known]
    there = listed(sorted(shown), _SHOWN) if shown else "nothing that was pushed"
    raise UsageError(f"{store.place} has no dataset {wanted}; it has {there}.")


def _of_name(name: str, every: Iterable[Root], own: Project | None) -> list[Root]:
    """Return the pushed roots that a name alone may mean for the project ``own``."""
    same = [root for root in every if root["path"] == name]
    if own is None:
        return same
    return [root for root in same if project_id(root) == own.id] or [root for root in same if not project_id(root)]


def refuse_newer(there: AnyStore, before: Root, seen: Collection[str], name: str) -> None:
    """Raise `UsageError` where the manifest of ``before`` is none of those that the pushing project has ``seen``."""
    manifest = str(before["manifest"])
    if manifest in seen:
        return
    written = time.strftime("%Y-%m-%d %H:%M", time.localtime(before.get("written_s", 0)))
    raise UsageError(
        f"{there.place} holds another {name} than this project has had here: {manifest[:12]}, pushed on {written}. `tacpipe "
        f"store checkout {manifest[:12]} --remote {there.place} -o DIRECTORY` brings it; --replace pushes all the same, and "
        f"keeps it as an earlier snapshot."
    )


def lasting(store: AnyStore, manifest: str) -> bool:
    """Return whether a pushed manifest holds recordings or labels set by hand, or cannot be read to know that."""
    try:
        found = manifest_of.stored(store, manifest)
    except StorageError:
        raise
    except TacpipeError:
        return True
    return replacing.lasting(found)


def forget(store: AnyStore, wanted: str, *, dry_run: bool = False) -> bool:
    """Keep no longer what ``wanted`` names: all snapshots of ``PROJECT:PATH``, or one by `SHORTEST` or more of its digits.

    Returns whether there was any. Raises `UsageError` where several are meant.
    """
    every = roots(store)
    found = _of_project(wanted, every) or [root for root in every if root["path"] == wanted]
    if len(found) > 1:
        names = listed((label(root, every) for root in found), _SHOWN)
        raise UsageError(f"{store.place} keeps several datasets {wanted}: {names}. Give one of these names.")
    if found:
        if not dry_run:
            store.roots.remove(found[0])
        return True
    snapshots = {
        one for root in every for one in _manifests(root) if len(wanted) >= SHORTEST and one.startswith(wanted)
    }
    if len(snapshots) > 1:
        raise UsageError(
            f"{len(snapshots)} snapshots in {store.place} begin with {wanted}; give more of its hex digits."
        )
    for root in every if snapshots and not dry_run else ():
        _without(store, root, *snapshots)
    return bool(snapshots)


def _manifests(root: Root) -> list[str]:
    """Return the digests of a root's manifests, newest first."""
    return [str(one["manifest"]) for one in (root, *root.get("history", []))]


def _without(store: AnyStore, root: Root, manifest: str) -> None:
    """Take a manifest out of a pushed root; of those that stay the newest is what a pull takes."""
    kept = [one for one in (root, *root.get("history", [])) if one["manifest"] != manifest]
    if kept and len(kept) <= len(root.get("history", [])):
        newest = {key: kept[0].get(key) for key in ("manifest", "written_s")}
        previous = kept[1]["manifest"] if len(kept) > 1 else None
        store.roots.write({**root, **newest, "previous": previous, "history": kept[1:]})
    if manifest in _manifests(root):
        store.roots.remove(root)  # what was just written is another one
