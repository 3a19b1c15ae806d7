"""Find and name the trials of published sets, and recognize their recordings. Imports no heavy libraries.

A recording is recognized by the month in which it was recorded. The figures of a paper, and facts about the
measurement, apply only to the published recordings, not to a lab's own recordings in the same format.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from tacpipe.datasets import paths
from tacpipe.datasets.selection import PUBLISHED
from tacpipe.errors import TacpipeError
from tacpipe.io.files import walk
from tacpipe.plugins.stage import Attribute, Files
from tacpipe.plugins.stream_selection import StreamSelection

PREFIX = "data_sample_"


@dataclass(frozen=True)
class Params(StreamSelection):
    """How trials are read."""

    # part of the authors' split in this folder; empty: none
    authors_role: Literal["", "train", "val", "test"] = ""


def trials(source: Path, names: Sequence[str]) -> dict[str, dict[str, Path]]:
    """Return the files that exist for each trial below ``source``: path by file name, by recording name.

    A trial is a folder named ``data_sample_…`` or with a file in ``names``; ``source`` itself may be one. The recording
    has the folder's name without the prefix, preceded by parent folders if that name is not unique. Raises
    `TacpipeError` if ``source`` is not a folder or contains no trial, `UsageError` if two trials still share a name.
    """
    if not source.is_dir():
        raise TacpipeError(
            f"{source} is not a folder; give the folder that holds the trials, each a folder of CSV files."
        )
    expected_names = set(names)
    present_files: dict[Path, set[str]] = {}  # expected files in each trial
    for directory, _, files in walk(source):
        present_names = expected_names.intersection(files)
        if present_names or os.path.basename(directory).startswith(PREFIX):  # noqa: PTH119  (once a folder, on every hit)
            present_files[Path(directory)] = present_names
    parents = {folder.parent for folder in present_files}
    folders = sorted(folder for folder, present in present_files.items() if present or folder not in parents)
    if not folders:
        raise TacpipeError(
            f"{source} holds no trial: no folder in it has {', '.join(names[:3])} or the like. "
            f"Give the folder of the unpacked data set."
        )
    by_name: dict[str, list[Path]] = {}
    for folder in folders:
        by_name.setdefault(paths.folded_name(valid(folder.name)), []).append(folder)
    named_folders: list[tuple[str, Path]] = []
    for same_name in by_name.values():
        for folder in same_name:
            name = valid(folder.name)
            above = folder.relative_to(source).parts[:-1]
            named_folders.append((name if len(same_name) == 1 else valid("-".join([*above, name])), folder))
    paths.refuse_shared_names(named_folders)
    return {
        name: {file: folder / file for file in names if file in present_files[folder]}
        for name, folder in sorted(named_folders)
    }


def by_object(
    source: Path, names: Sequence[str], noun: str, *, example: str, described: Sequence[str], prefix: str = ""
) -> dict[str, dict[str, Path]]:
    """Return the files of each folder ``OBJECT/FOLDER`` below ``source`` that has a file of ``names``, by recording name.

    Recordings are named ``OBJECT-FOLDER``, without the ``prefix`` of folders; files have names relative to ``source``.
    ``noun``, ``example`` (an object) and ``described`` (some of ``names``) are for errors. Raises `TacpipeError` if
    ``source`` is not a folder or contains none, `UsageError` if two have the same name.
    """
    if not source.is_dir():
        raise TacpipeError(
            f"{source} is not a folder; give the folder that holds those of the objects, {example} and so on."
        )
    files_by_recording: dict[str, dict[str, Path]] = {}
    named_folders: list[tuple[str, Path]] = []
    for directory, _, files in walk(source):
        present_names = [name for name in names if name in files]
        if present_names:
            parent, name = os.path.split(os.path.abspath(directory))  # noqa: PTH100  (once a folder, on every hit)
            label, folder = text(os.path.basename(parent)), text(name)  # noqa: PTH119
            recording = valid(f"{label}-{folder.removeprefix(prefix)}")
            named_folders.append((recording, Path(directory)))
            files_by_recording[recording] = {
                f"{label}/{folder}/{file}": Path(directory, file) for file in present_names
            }
    paths.refuse_shared_names(named_folders)
    if not files_by_recording:
        raise TacpipeError(
            f"{source} holds no {noun}: no folder in it has {', '.join(described)}. Give the folder of the unpacked data "
            f"set."
        )
    return dict(sorted(files_by_recording.items()))


def require(files: Files, names: Sequence[str]) -> str:
    """Return the name of the trial's folder. Raises `TacpipeError` if one of the files ``names`` is missing."""
    folder = next((path.parent for path in files.values()), None)
    missing = [name for name in names if name not in files]
    if missing:
        subject = str(folder) if folder else "A trial folder"
        raise TacpipeError(f"{subject} lacks {' and '.join(missing)}; copy the trial again or leave it out.")
    assert folder is not None
    return text(folder.name)


def text(name: str) -> str:
    """Return a file name as text, with bytes that are not UTF-8 replaced by U+FFFD."""
    return os.fsencode(name).decode(errors="replace")


def valid(name: str) -> str:
    """Return a folder's name as a recording name (`paths.valid_name`), without the prefix of trials."""
    return paths.valid_name(name.removeprefix(PREFIX) or name) or "trial"


MONTHS = {  # first and last month (UTC) of recording by format; a format without timestamps is recognized by its layout
    "biotac-slide": ("2020-02", "2020-02"),
    "vision2tactile": ("2019-05", "2019-07"),
    "xela-flat": ("2021-11", "2021-11"),
}


def published_attribute(name: str, t_ns: int | None = None) -> dict[str, Attribute]:
    """Return the attribute with the published set of a recording, from its format and its first timestamp (UTC).

    Returns an empty dictionary for recordings of another time. A recording in a format without timestamps belongs to
    the set.

    >>> [published_attribute("vision2tactile", second * 10**9) for second in (1561629162, 1861629162)]
    [{'published': 'vision2tactile'}, {}]
    >>> published_attribute("roboskin")
    {'published': 'roboskin'}
    """
    if t_ns is None:
        return {PUBLISHED: name}
    first, last = MONTHS[name]
    month = f"{datetime.fromtimestamp(t_ns // 10**9, UTC):%Y-%m}"
    return {PUBLISHED: name} if first <= month <= last else {}
