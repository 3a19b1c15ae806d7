"""Name the datasets that projects pushed, find a dataset by its name, and reject a push that would replace a newer one.

A name belongs to a project: ``exp:data/rec`` is ``data/rec`` of the project ``exp``. Each push is a snapshot. A pull
reads the newest one; earlier ones are the history of the name.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Iterable

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import replacing
from tacpipe.errors import UsageError
from tacpipe.printable import listed
from tacpipe.store.projects import Project
from tacpipe.store.remote import AnyStore
from tacpipe.store.roots import PUSHED, Root, WrittenManifest, project_id

MIN_DIGITS = 6  # minimum number of digits that identify a project or a manifest
_SHOWN_DIGITS = 8  # digits of a project's id, shown if several projects have its name
_SHOWN = 20  # number of datasets listed before the others are counted


def roots(store: AnyStore) -> list[Root]:
    """Return the roots of pushed datasets in a store, by name."""
    pushed_roots = [root for root in store.roots.all() if root["kind"] == PUSHED]
    return sorted(pushed_roots, key=lambda root: (str(root["path"]), project_id(root)))


def labels(all_roots: Iterable[Root]) -> dict[tuple[str, str], str]:
    """Return a label for each pushed root, by its project's id and its path: the project's name or id, and the path.

    >>> first, second = ({"id": digit * 32, "name": "exp"} for digit in "ab")
    >>> list(labels([{"path": "rec", "project": first}]).values())
    ['exp:rec']
    >>> list(labels([{"path": "rec", "project": first}, {"path": "rec", "project": second}]).values())
    ['aaaaaaaa:rec', 'bbbbbbbb:rec']
    """
    pushed_roots = list(all_roots)
    names = {project_id(root): root["project"]["name"] if "project" in root else "" for root in pushed_roots}
    counts = Counter(names.values())
    labels_by_key = {}
    for root in pushed_roots:
        identifier, path = project_id(root), root["path"]
        name = names[identifier]
        is_ambiguous = counts[name] > 1 or ":" in name
        labels_by_key[identifier, path] = f"{identifier[:_SHOWN_DIGITS] if is_ambiguous else name}:{path}"
    return labels_by_key


def label(root: Root, all_roots: Iterable[Root]) -> str:
    """Return the name of a root among ``all_roots``: its path, after its project if it was pushed."""
    if root["kind"] != PUSHED:
        return str(root["path"])
    return labels([*(candidate for candidate in all_roots if candidate["kind"] == PUSHED), root])[
        project_id(root), root["path"]
    ]


def _roots_of_project(requested: str, pushed_roots: Iterable[Root]) -> list[Root]:
    """Return the pushed roots that ``PROJECT:PATH`` names.

    A project is given by its name, or by `MIN_DIGITS` or more digits of its id.
    """
    project, colon, path = requested.partition(":")
    return [root for root in pushed_roots if colon and root["path"] == path and _belongs_to(project, root)]


def _belongs_to(project: str, root: Root) -> bool:
    by_id = len(project) >= MIN_DIGITS and project_id(root).startswith(project)
    return by_id or ("project" in root and root["project"]["name"] == project)


def project_in(store: AnyStore, requested: str) -> Project:
    """Return the project of a store that has this name, or an id that begins so. Raises `UsageError` if there is not one."""
    names_by_id = {project_id(root): root["project"]["name"] for root in roots(store)}
    matching = [
        identifier
        for identifier, name in names_by_id.items()
        if requested == name or (len(requested) >= MIN_DIGITS and identifier.startswith(requested))
    ]
    if len(matching) != 1:
        names = listed((f"{name} ({identifier[:_SHOWN_DIGITS]})" for identifier, name in names_by_id.items()), _SHOWN)
        subject = "several projects are" if matching else "no project is"
        raise UsageError(
            f"{subject} called {requested} in {store.place}; it has {names}. Give one's name, or digits of its id."
        )
    return Project(matching[0], names_by_id[matching[0]])


def find(store: AnyStore, requested: str, name: str, project: Project | None) -> Root:
    """Return the root that ``project`` requested: a ``PROJECT:PATH``, or a path, which is ``name`` within the project.

    A path without a project belongs to ``project``. If that project never pushed anything, the path may belong to the
    only project that has it, as on a second computer. Raises `UsageError` with the candidates if no root or several
    roots match.
    """
    all_roots = roots(store)
    matching = _roots_of_project(requested, all_roots) or _roots_of_name(name, all_roots, project)
    if len(matching) == 1:
        return matching[0]
    names = labels(all_roots)
    same_name = matching or [root for root in all_roots if root["path"] == name]
    other_labels = sorted(names[project_id(root), root["path"]] for root in same_name)
    if other_labels:
        raise UsageError(
            f"{store.place} has no dataset {requested} of this project, but of others: {listed(other_labels, _SHOWN)}. Give "
            f"one of these names."
        )
    labelled = [(root, names[project_id(root), root["path"]]) for root in all_roots]
    shown_names = [
        root["path"] if _roots_of_name(root["path"], all_roots, project) == [root] else root_label
        for root, root_label in labelled
    ]
    available = listed(sorted(shown_names), _SHOWN) if shown_names else "nothing that was pushed"
    raise UsageError(f"{store.place} has no dataset {requested}; it has {available}.")


def _roots_of_name(name: str, pushed_roots: Iterable[Root], project: Project | None) -> list[Root]:
    """Return the pushed roots that a name without a project may refer to."""
    return [
        root for root in pushed_roots if root["path"] == name and (project is None or project_id(root) == project.id)
    ]


def refuse_newer(store: AnyStore, before: Root, seen_manifests: Collection[str | None], name: str) -> None:
    """Raise `UsageError` if the manifest of ``before`` is none of those that the pushing project has ``seen_manifests``.

    ``name`` is the name of the pushed dataset.
    """
    manifest = str(before["manifest"])
    if manifest in seen_manifests:
        return
    date = time.strftime("%Y-%m-%d %H:%M", time.localtime(before.get("written_s", 0)))
    raise UsageError(
        f"{store.place} holds another {name} than this project had here: {manifest[:12]}, pushed on {date}. `tacpipe "
        f"store checkout {manifest[:12]} --remote {store.place} -o DIRECTORY` writes it to a directory. --replace "
        "pushes anyway, and keeps it as an earlier snapshot."
    )


def lasting(store: AnyStore, manifest: str) -> bool:
    """Return whether a pushed manifest contains recordings or hand-set labels, or cannot be read to find out."""
    pushed_manifest = manifest_of.stored_or_none(store, manifest)
    return pushed_manifest is None or replacing.lasting(pushed_manifest)


def forget(store: AnyStore, requested: str, *, dry_run: bool = False) -> bool:
    """Forget all snapshots of ``PROJECT:PATH``, or the one whose digest starts with ``requested``.

    At least `MIN_DIGITS` digits are required. Returns whether there was one. Raises `UsageError` if several match.
    """
    all_roots = roots(store)
    matching = _roots_of_project(requested, all_roots) or _roots_of_name(requested, all_roots, None)
    if len(matching) > 1:
        names = listed((label(root, all_roots) for root in matching), _SHOWN)
        raise UsageError(f"{store.place} keeps several datasets {requested}: {names}. Give one of these names.")
    if matching:
        if not dry_run:
            store.roots.remove(matching[0])
        return True
    snapshots: set[str] = set()
    if len(requested) >= MIN_DIGITS:
        for root in all_roots:
            snapshots |= {digest for digest in manifests(root) if digest.startswith(requested)}
    if len(snapshots) > 1:
        raise UsageError(
            f"{len(snapshots)} snapshots in {store.place} begin with {requested}; give more of its hex digits."
        )
    for root in all_roots if snapshots and not dry_run else ():
        _remove_manifest(store, root, *snapshots)
    return bool(snapshots)


def manifests(root: Root) -> list[str]:
    """Return the digests of a root's manifests, newest first."""
    return [root["manifest"], *(entry["manifest"] for entry in root.get("history", []))]


def _remove_manifest(store: AnyStore, root: Root, manifest: str) -> None:
    """Remove a manifest from a pushed root; the newest remaining one is then what a pull gets."""
    if manifest not in manifests(root):
        return
    earlier = [entry for entry in root.get("history", []) if entry["manifest"] != manifest]
    newest: WrittenManifest | None = root
    if root["manifest"] == manifest:
        newest = earlier.pop(0) if earlier else None
    if newest is not None:
        reduced: Root = {**root, "manifest": newest["manifest"], "written_s": newest.get("written_s", 0)}
        store.roots.write({**reduced, "previous": earlier[0]["manifest"] if earlier else None, "history": earlier})
    store.roots.remove(root)  # the root that was just written has another key, so the old one is removed
