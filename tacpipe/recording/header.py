"""The header of a spool that an earlier process left: checked before anything is written for it.

A folder of spools may have been unpacked, copied or shared, so what a header names is validated: the dataset, the name of
the recording, its streams, its attributes.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from tacpipe.datasets import manifest, paths
from tacpipe.errors import TacpipeError
from tacpipe.printable import excerpt
from tacpipe.store import location
from tacpipe.store.layout import BESIDE_NAME
from tacpipe.store.store import Store

FILE = re.compile(r"rig-[0-9a-f]{8}\.toml")  # rig files next to the recordings
MOST_NS = 1 << 62  # of the readings of a clock


def output(store: Store, dataset: Path) -> str:
    """Return how a header names its dataset: relative to the project that the store lies next to, so both can be moved.

    Outside of that project, and where the store lies elsewhere, the path is absolute.
    """
    path, project = Path(os.path.abspath(dataset)), _project(store)  # noqa: PTH100  (without following links)
    return str(path.relative_to(project) if project is not None and path.is_relative_to(project) else path)


def destination(header: Mapping[str, Any], store: Store, opened: Path | None) -> Path:
    """Return the dataset that a spool is to be appended to.

    That is the one that this command was given (``opened``), or one within the project of the store or of the current
    folder, reached without a link that leads out of it. Raises `TacpipeError` for any other.
    """
    named = header.get("output")
    if isinstance(named, str) and named and "\0" not in named:
        for project in _projects(store):
            path = project / named
            if opened is not None and path == Path(os.path.abspath(opened)):  # noqa: PTH100
                return path
            if _within(path, project):
                return path
    raise TacpipeError(
        f"It was recorded for {excerpt(named)}, which is neither the -o of this command nor in the project of its store. If "
        f"that is right, `tacpipe acquire --recover -o` with that path seals it."
    )


def check(header: Mapping[str, Any], streams: Iterable[str]) -> None:
    """Raise `TacpipeError` for a header that names what no dataset can hold; ``streams`` are those of its rig file."""
    name, attributes, clock = header.get("recording"), header.get("attributes"), header.get("clock")
    if not isinstance(name, str) or not is_name(name):
        raise TacpipeError(f"Its recording is called {excerpt(name)}, and no file can have that name.")
    if header.get("streams") != list(streams):
        raise TacpipeError(f"Its streams are {excerpt(header.get('streams'))}, and its rig file has others.")
    if not isinstance(attributes, dict) or not all(_is_attribute(value) for value in attributes.values()):
        raise TacpipeError(
            f"Its attributes are {excerpt(attributes)}; each must be text, a finite number, true or false."
        )
    duration_s = header.get("duration_s")  # spools of before have none
    if duration_s is not None and (not _is_attribute(duration_s) or isinstance(duration_s, str)):
        raise TacpipeError(f"Its duration is {excerpt(duration_s)}; it must be a number of seconds.")
    readings = [clock.get(key) for key in ("monotonic_ns", "utc_ns")] if isinstance(clock, dict) else [None]
    if not all(type(one) is int and abs(one) < MOST_NS for one in readings):
        raise TacpipeError(f"Its clock is {excerpt(clock)}; it must hold monotonic_ns and utc_ns, whole nanoseconds.")


def is_name(name: str) -> bool:
    """Return whether a recording can have this name: one that is a folder's, and no file's of its dataset.

    >>> [is_name(name) for name in ("press-001", "木", "a/b", "../a", ".a", "manifest.json", "rig-0123abcd.toml")]
    [True, True, False, False, False, False, False]
    """
    return "/" not in name and paths.safe_path(name) and name.lower() != manifest.NAME and not FILE.fullmatch(name)


def _is_attribute(value: object) -> bool:
    return isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))


def _project(beside: Store) -> Path | None:
    """Return the project that a store lies next to, None for one that is named by TACPIPE_STORE."""
    root = Path(os.path.abspath(beside.root))  # noqa: PTH100
    return root.parent if root.name == BESIDE_NAME else None


def _projects(beside: Store) -> list[Path]:
    """Return where a spool's dataset may lie; relative paths begin at the first one."""
    project = _project(beside)
    here = location.project()
    return [here] if project is None or project == here else [project, here]


def _within(path: Path, project: Path) -> bool:
    if not path.is_relative_to(project) or not paths.safe_path(path.relative_to(project).as_posix()):
        return False
    return path.resolve().is_relative_to(project.resolve())
