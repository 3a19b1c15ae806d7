"""Trials as folders: how they are read, found and named, and what one must hold. Imports nothing heavy."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tacpipe.datasets import recording_names
from tacpipe.errors import TacpipeError
from tacpipe.io.files import walk
from tacpipe.plugins.stage import Files
from tacpipe.plugins.stream_selection import StreamSelection

PREFIX = "data_sample_"


@dataclass(frozen=True)
class Params(StreamSelection):
    """How trials are read."""

    # part of the authors' split that this folder is; empty: none
    authors_role: Literal["", "train", "val", "test"] = ""


def trials(source: Path, names: Sequence[str]) -> dict[str, dict[str, Path]]:
    """Return the trials below ``source``: recording name to file name to path, with only the files that are there.

    A trial is a folder named ``data_sample_…`` or one that holds a file of ``names``; ``source`` may be one itself. The
    recording's name is the folder's without the prefix; where two folders would share one, the folders above go before.
    Raises `TacpipeError` if ``source`` is not a folder or holds no trial, `UsageError` where two trials share a name
    even so.
    """
    if not source.is_dir():
        raise TacpipeError(
            f"{source} is not a folder; give the folder that holds the trials, each a folder of CSV files."
        )
    wanted = set(names)
    holds: dict[Path, set[str]] = {}  # which of the wanted files each trial has
    for place, _, files in walk(source):
        there = wanted.intersection(files)
        if there or os.path.basename(place).startswith(PREFIX):  # noqa: PTH119  (once a folder, on every hit)
            holds[Path(place)] = there
    parents = {folder.parent for folder in holds}
    folders = sorted(folder for folder, present in holds.items() if present or folder not in parents)
    if not folders:
        raise TacpipeError(
            f"{source} holds no trial: no folder in it has {', '.join(names[:3])} or the like. "
            f"Give the folder of the unpacked data set."
        )
    by_name: dict[str, list[Path]] = {}
    for folder in folders:
        by_name.setdefault(recording_names.folded(valid(folder.name)), []).append(folder)
    named: list[tuple[str, Path]] = []
    for same in by_name.values():
        for folder in same:
            name = valid(folder.name)
            above = folder.relative_to(source).parts[:-1]
            named.append((name if len(same) == 1 else valid("-".join([*above, name])), folder))
    recording_names.refuse_shared(named)
    return {name: {file: folder / file for file in names if file in holds[folder]} for name, folder in sorted(named)}


def require(files: Files, names: Sequence[str]) -> str:
    """Return the name of the trial's folder, as `text`. Raises `TacpipeError` if it lacks one of the files ``names``."""
    folder = next((path.parent for path in files.values()), None)
    missing = [name for name in names if name not in files]
    if missing:
        place = str(folder) if folder else "A trial folder"
        raise TacpipeError(f"{place} lacks {' and '.join(missing)}; copy the trial again or leave it out.")
    assert folder is not None
    return text(folder.name)


def text(name: str) -> str:
    """Return a name of the file system as text: bytes in it that are not a UTF-8 become U+FFFD."""
    return os.fsencode(name).decode(errors="replace")


def valid(name: str) -> str:
    """Return a folder's name as that of a recording (`recording_names.valid`), without the prefix of trials."""
    return recording_names.valid(name.removeprefix(PREFIX) or name) or "trial"
