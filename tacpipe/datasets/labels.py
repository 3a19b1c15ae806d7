"""Set labels by hand after recording, without changing a shard."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from tacpipe.datasets import directory as directory_of
from tacpipe.datasets import intervals, pages
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets.manifest import Found, Manifest
from tacpipe.errors import UsageError
from tacpipe.io import config_text
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, plain
from tacpipe.store.location import locate

_NAMED = 5  # number of recordings named in an error


def parse(sets: Sequence[str], exclude: str | None, *, include: bool) -> dict[str, Attribute]:
    """Return the labels in ``name=value`` texts; numbers and true, false, null are parsed.

    Raises `UsageError` if a text is not a label, or there is nothing to change.
    """
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
    """Return the value of a text that is a number, true, false or null, or else the text."""
    return None if text == "null" else config_text.plain_value(text)


@dataclass(frozen=True)
class Changed:
    """A dataset with changed labels, and the recordings whose labels changed."""

    directory: Path
    recordings: list[str]


ByRecording = Mapping[str, Mapping[str, Attribute]]


def change(
    path: Path,
    patterns: Sequence[str],
    labels: Mapping[str, Attribute],
    interval: tuple[str, float, float] | None = None,
) -> Changed:
    """Set ``labels`` on the recordings whose names match and return the dataset's directory and their names.

    ``interval`` (name, start and end in seconds) is added to the intervals of that name. Raises `UsageError` if a pattern
    matches no recording, or if the interval is invalid.
    """
    if interval is None:
        return _change(path, lambda dataset: dict.fromkeys(_matching(dataset, patterns), labels))
    kind, begin, end = interval
    name, added = intervals.attribute(kind), intervals.checked_interval(begin, end)

    def labels_for(dataset: Found) -> ByRecording:
        new_labels = {}
        for recording in _matching(dataset, patterns):
            attributes = dataset.manifest.recordings[recording]["attributes"]
            existing = intervals.intervals_of(attributes, kind) or []
            new_labels[recording] = {**labels, name: intervals.to_text([*existing, added])}
        return new_labels

    return _change(path, labels_for)


def require_recordings(labels_by_name: ByRecording, existing: ByRecording, path: Path) -> ByRecording:
    """Return ``labels_by_name``, those of the file ``path``.

    Raises `UsageError` if it names recordings that do not exist.
    """
    unknown = sorted(set(labels_by_name) - set(existing))
    if unknown:
        raise UsageError(
            f"{path} names {listed(unknown, _NAMED)}, and the dataset has no such recording. It has "
            f"{listed(sorted(existing), _NAMED)}."
        )
    return labels_by_name


def change_each(path: Path, new_labels: Callable[[ByRecording], ByRecording]) -> Changed:
    """Set different labels on each recording. ``new_labels`` maps the attributes of all recordings to labels by name.

    Recordings that already have the labels are not changed, so nothing is recomputed for them.
    """
    return _change(
        path, lambda dataset: changed_labels(attributes(dataset.manifest), new_labels(attributes(dataset.manifest)))
    )


def planned(path: Path, new_labels: Callable[[ByRecording], ByRecording]) -> tuple[ByRecording, ByRecording]:
    """Return the attributes of all recordings and the labels that `change_each` would set, by name. Changes nothing."""
    dataset = manifest_of.find(path)
    _refuse_made(dataset.manifest, dataset.directory)
    now = attributes(dataset.manifest)
    return now, changed_labels(now, new_labels(now))


def attributes(manifest: Manifest) -> ByRecording:
    """Return the attributes of each recording by name."""
    parts = pages.parts(manifest.recordings)
    return {name: entry["attributes"] for part in parts for name, entry in part.items()}


def changed_labels(current: ByRecording, new: ByRecording) -> dict[str, dict[str, Attribute]]:
    """Return the labels in ``new`` that differ from ``current``, by recording; 1 differs from true.

    >>> changed_labels({"a": {"n": 1}, "b": {"n": 1}}, {"a": {"n": 1}, "b": {"n": True, "m": None}})
    {'b': {'n': True}}
    """
    differences = {
        name: {key: value for key, value in labels.items() if _differ(current[name].get(key), value)}
        for name, labels in new.items()
    }
    return {name: labels for name, labels in differences.items() if labels}


def _differ(value: Attribute, current: Attribute) -> bool:
    return value != current or type(value) is not type(current)


def _change(path: Path, new_labels: Callable[[Found], ByRecording]) -> Changed:
    """Set the labels that ``new_labels`` returns for the current dataset. Raises `UsageError` as `_refuse_made` does."""
    dataset = manifest_of.find(path)
    store, directory = locate(dataset.directory), dataset.directory
    _refuse_made(dataset.manifest, directory)
    names: list[str] = []

    def labelled() -> directory_of.DirectoryChange:
        current = manifest_of.find(directory)  # read again, because another process may have changed it
        labels = {name: dict(values) for name, values in new_labels(current).items()}
        names.extend(labels)
        current.manifest.keep(store)
        return directory_of.DirectoryChange(current.manifest.labelled(labels), relabelled=True)

    with store.at_work([dataset.digest]):
        directory_of.change(store, directory, labelled)
    return Changed(directory, names)


def _refuse_made(manifest: Manifest, directory: Path) -> None:
    """Raise `UsageError` for a dataset that was made from others, because the next run would undo its labels."""
    if manifest.inputs:
        raise UsageError(
            f"{directory} was made by {manifest.stage} from other datasets, and the next run would undo its labels. "
            f"Label the recordings that it comes from; `tacpipe explain {directory}` names them."
        )


def _matching(dataset: Found, patterns: Sequence[str]) -> list[str]:
    """Return the names of the recordings that match a pattern, sorted. Raises `UsageError` if a pattern matches none."""
    recordings = dataset.manifest.recordings
    names: set[str] = set()
    for pattern in patterns:
        if pattern in recordings:  # reads only one page of a large dataset
            names.add(pattern)
            if not any(mark in pattern for mark in "*?["):
                continue
        matching = {name for name in recordings if fnmatchcase(name, pattern)}
        if not matching:
            existing = listed(sorted(recordings), _NAMED)
            raise UsageError(f"{dataset.directory} has no recording {plain(pattern)}; it has {existing}.")
        names |= matching
    return sorted(names)
