"""Roots: which paths hold which manifest. What they name is needed, and so is all that it descends from."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tacpipe.files import read_json, readable_errors
from tacpipe.hashing import digest

if TYPE_CHECKING:
    from tacpipe.store import Store

BESIDE_NAME = ".tacpipe"  # of a store that lies beside its project
BESIDE, ABSOLUTE, PUSHED = "beside", "absolute", "pushed"  # kinds of roots
# {"path", "kind", "manifest", "previous", "written_s", "history"}, and "missing_since_s" while out of reach
Root = dict[str, Any]
ROOT_BYTES = 1 << 24  # the largest root that is read: a history of 100,000 entries
HISTORY = 20  # manifests that a path held before and that are remembered; ``lasting`` ones are remembered for ever


class Roots:
    """The roots of a store."""

    def __init__(self, store: Store) -> None:
        self.store = store

    def set(
        self, path: Path, manifest: str, *, pushed: bool = False, durable: bool = False, lasting: bool = False
    ) -> None:
        """Note that ``path`` now holds ``manifest``; the one before goes into the history of the path.

        That one is ``lasting`` where it held recordings or labels that are not in the new one: `gc` then keeps it. A dataset
        that was ``pushed`` here has a name instead of a path, and is kept until `forget`.
        """
        kind, name = self.named(path, pushed=pushed)
        known = self.get(path, pushed=pushed)
        if known is None or known["manifest"] != manifest:
            previous = None if known is None else known["manifest"]
            root = {"path": name, "kind": kind, "manifest": manifest, "previous": previous}
            history = [] if known is None else _history(known, manifest, lasting=lasting)
            self.write({**root, "written_s": int(time.time()), "history": history})
        if durable:
            self.store.sync(self._file(kind, name))

    def get(self, path: Path, *, pushed: bool = False) -> Root | None:
        """Return the root of ``path``, or None; its ``path`` is where the dataset lies now."""
        return self.at(self._file(*self.named(path, pushed=pushed)))

    def all(self) -> list[Root]:
        """Return all roots. Damaged ones are quarantined: the next run of their stage writes them anew."""
        found = (self.at(path) for path in self.store.listed("roots", "*.json"))
        return [root for root in found if root is not None]

    def write(self, root: Mapping[str, Any]) -> None:
        """Replace a root, as `all` gave it or with more to say."""
        kind, name = root["kind"], str(root["path"])
        if kind == BESIDE and Path(name).is_absolute():
            name = os.path.relpath(name, self.store.root.parent)
        content = {key: value for key, value in root.items() if key != "check"} | {"path": name, "kind": kind}
        text = json.dumps({**content, "check": digest(content)}, sort_keys=True)
        self.store.write_file(self._file(kind, name), text.encode())

    def forget(self, name: str) -> bool:
        """Drop the roots of this path or pushed name; return whether there was one."""
        wanted = [self.named(Path(name).absolute()), self.named(Path(name), pushed=True)]
        there = [file for file in (self._file(*one) for one in wanted) if file.exists()]
        for file in there:
            with readable_errors(self.store.root):
                file.unlink(missing_ok=True)
        return bool(there)

    def at(self, file: Path) -> Root | None:
        """Return the root that lies in ``file``; None if none does, and a damaged one is quarantined."""
        with readable_errors(self.store.root):
            if not os.path.lexists(file):
                return None
            root = read_json(file, ROOT_BYTES) or {}
        check = root.pop("check", None)
        if check is None and "kind" not in root and {"path", "manifest"} <= set(root):  # as they were once written
            return {**root, "kind": ABSOLUTE if Path(root["path"]).is_absolute() else PUSHED}
        if check is None or check != digest(root):
            self.store.quarantine(file)
            return None
        beside = root["kind"] == BESIDE
        return {**root, "path": str(self.store.root.parent / root["path"])} if beside else root

    def damaged(self) -> list[str]:
        """Return the names of roots that were damaged and not written anew: nobody knows which datasets they stood for."""
        names = {path.name[len("root-") :].partition(".")[0] for path in self.store.listed("quarantine", "root-*")}
        return sorted(name for name in names if not (self.store.root / "roots" / f"{name}.json").exists())

    def is_of(self, name: str, path: Path) -> bool:
        """Return whether the root of this name stands for the dataset at ``path``."""
        return self._file(*self.named(path)).stem == name

    def named(self, path: Path, *, pushed: bool = False) -> tuple[str, str]:
        """Return kind and name of a root: relative where the dataset lies beside its store, so that both can move."""
        if pushed:
            return PUSHED, str(path)
        beside = self.store.root.parent
        if self.store.root.name == BESIDE_NAME and path.is_relative_to(beside):
            return BESIDE, str(path.relative_to(beside))
        return ABSOLUTE, str(path)

    def _file(self, kind: str, name: str) -> Path:
        return self.store.root / "roots" / f"{digest(name if kind == ABSOLUTE else [kind, name])}.json"


def _history(known: Root, manifest: str, *, lasting: bool) -> list[dict[str, Any]]:
    """Return what a path held before it held ``manifest``, newest first: all that is lasting, and `HISTORY` others."""
    newest = {"manifest": known["manifest"], "written_s": known.get("written_s", 0), "lasting": lasting}
    older = [one for one in known.get("history", []) if one["manifest"] not in (manifest, newest["manifest"])]
    kept, room = [], HISTORY
    for one in [newest, *older]:
        room -= not one["lasting"]
        if one["lasting"] or room >= 0:
            kept.append(one)
    return kept
