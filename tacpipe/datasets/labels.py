"""What a lab notices afterwards: labels set by hand, without touching a shard."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from math import isfinite
from pathlib import Path

from tacpipe.datasets import directory as directory_of
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages
from tacpipe.datasets.manifest import Found, Manifest
from tacpipe.errors import UsageError
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, plain
from tacpipe.store.location import locate

_NAMED = 5  # recordings that a refusal names


def parse(sets: Sequence[str], exclude: str | None, *, include: bool) -> dict[str, Attribute]:
    """Return the labels of ``name=value`` texts; numbers and true, false, null are read as YAML does."""
    labels: dict[str, Attribute] = {}
    for text in sets:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise UsageError(f"--label {plain(text)} should read name=value, as in --label material=foam.")
        labels[name] = of_text(value) if value else ""
    if exclude is not None and include:
        raise UsageError("--exclude and --include contradict each other; give one.")
    if exclude is not None:
        labels["excluded"] = exclude or "excluded"
    if include:
        labels["excluded"] = None
    if not labels:
        raise UsageError("Nothing to change: give --label name=value, --exclude REASON or --include.")
    return labels


def of_text(text: str) -> Attribute:
    """Return the value of a text, where that is a number, true, false or null; else the text."""
    from tacpipe.io import yaml_text

    try:
        found = yaml_text.load(text)
    except ValueError:
        return text
    if isinstance(found, float) and not isfinite(found):
        return text
    return found if isinstance(found, str | int | float | None) else text


@dataclass(frozen=True)
class Changed:
    """The dataset whose labels were changed, and the recordings that have new ones."""

    directory: Path
    recordings: list[str]


ByRecording = Mapping[str, Mapping[str, Attribute]]


def change(path: Path, patterns: Sequence[str], labels: Mapping[str, Attribute]) -> Changed:
    """Set ``labels`` on the recordings whose names match and return the dataset's directory and their names.

    Raises `UsageError` if a pattern matches no recording.
    """
    return _change(path, lambda found: dict.fromkeys(_matching(found, patterns), labels))


def change_each(path: Path, wanted: Callable[[ByRecording], ByRecording]) -> Changed:
    """Set other labels on each recording: ``wanted`` returns them by name, given the attributes of all.

    Recordings whose labels are so already stay untouched, and nothing is computed again for them.
    """
    return _change(path, lambda found: differing(attributes(found.manifest), wanted(attributes(found.manifest))))


def planned(path: Path, wanted: Callable[[ByRecording], ByRecording]) -> tuple[ByRecording, ByRecording]:
    """Return the attributes of all recordings and the labels that `change_each` would set, by name; nothing is changed."""
    found = manifest_of.find(path)
    _refuse_made(found.manifest, found.directory)
    now = attributes(found.manifest)
    return now, differing(now, wanted(now))


def attributes(manifest: Manifest) -> ByRecording:
    """Return the attributes of each recording by name."""
    parts = pages.parts(manifest.recordings)
    return {name: entry["attributes"] for part in parts for name, entry in part.items()}


def differing(now: ByRecording, wanted: ByRecording) -> dict[str, dict[str, Attribute]]:
    """Return the labels in ``wanted`` that are others than ``now``, of the recordings that have some; 1 is not true.

    >>> differing({"a": {"n": 1}, "b": {"n": 1}}, {"a": {"n": 1}, "b": {"n": True, "m": None}})
    {'b': {'n': True}}
    """
    found = {
        name: {key: value for key, value in labels.items() if _apart(now[name].get(key), value)}
        for name, labels in wanted.items()
    }
    return {name: labels for name, labels in found.items() if labels}


def _apart(one: Attribute, other: Attribute) -> bool:
    return one != other or type(one) is not type(other)


def _change(path: Path, wanted: Callable[[Found], ByRecording]) -> Changed:
    found = manifest_of.find(path)
    store, directory = locate(found.directory), found.directory
    _refuse_made(found.manifest, directory)
    names: list[str] = []

    def labelled() -> directory_of.Change:
        here = manifest_of.find(directory)  # once more: another process may have changed it while this one waited
        labels = {name: dict(values) for name, values in wanted(here).items()}
        names.extend(labels)
        here.manifest.keep(store)
        return directory_of.Change(here.manifest.labelled(labels), relabelled=True)

    with store.at_work([found.digest]):
        directory_of.change(store, directory, labelled)
    return Changed(directory, names)


def _refuse_made(manifest: Manifest, directory: Path) -> None:
    if manifest.inputs:
        raise UsageError(
            f"{directory} was made by {manifest.stage} from other datasets, and the next run would undo its labels. "
            f"Label the recordings that it comes from; `tacpipe explain {directory}` names them."
        )


def _matching(found: Found, patterns: Sequence[str]) -> list[str]:
    recordings = found.manifest.recordings
    names: set[str] = set()
    for pattern in patterns:
        if pattern in recordings:  # of a large dataset, one page is read
            names.add(pattern)
            if not any(mark in pattern for mark in "*?["):
                continue
        matching = {name for name in recordings if fnmatchcase(name, pattern)}
        if not matching:
            there = listed(sorted(recordings), _NAMED)
            raise UsageError(f"{found.directory} has no recording {plain(pattern)}; it has {there}.")
        names |= matching
    return sorted(names)
