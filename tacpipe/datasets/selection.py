"""Select recordings of a dataset by names, roles and labels, and merge datasets.

The attributes of a result record whether its recordings were simulated or belong to a published set. Figures of a paper
are shown only next to results on its data; a lab's own recordings are not marked.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, ItemsView, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from tacpipe.channels.schema import TRUTH
from tacpipe.datasets import pages
from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import UsageError
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, listed, plain, suggestion
from tacpipe.store.records import Content, RecordingEntry, Step

if TYPE_CHECKING:
    from tacpipe.datasets.reading import ReadableDataset

Wanted = Attribute | Collection[Attribute] | Callable[[Any], bool]  # a label's value, several values, or a predicate
SPLIT_FILE = "split.parquet"
_RECORDING = "split"  # name of a split's only recording


def split_digest(manifest: Manifest, place: str) -> str:
    """Return the digest of a split's table. Raises `UsageError`, which names ``place``, for any other dataset."""
    if set(manifest.recordings) != {_RECORDING}:
        raise UsageError(f"{place} is not a split; make one with `tacpipe split`.")
    return manifest.recordings[_RECORDING]["shards"][""]["digest"]


def read_roles(content: bytes) -> dict[tuple[str, int], str]:
    """Return the role by (recording, fold) from the Parquet bytes of a split."""
    from tacpipe.io.parquet import from_parquet

    rows = from_parquet(content, ["recording", "fold", "role"]).to_pydict()
    return dict(zip(zip(rows["recording"], rows["fold"], strict=True), rows["role"], strict=True))


def roles_in_fold(roles: Mapping[tuple[str, int], str], fold: int, place: str) -> dict[str, str]:
    """Return the role by recording in a fold of the split ``place``. Raises `UsageError` if it has no such fold."""
    folds = sorted({number for _, number in roles})
    if fold not in folds:
        raise UsageError(f"The split {place} has the folds {folds}, not {fold}.")
    return {recording: role for (recording, number), role in roles.items() if number == fold}


_SHOWN, _LABELS = 5, 12  # number of names or values, and of labels, in an error


def roles_of(split: ReadableDataset | None, role: str | None, fold: int) -> dict[str, str] | None:
    """Return the role by recording in ``fold`` of an opened split, only recordings with a role; None without a split.

    Raises `UsageError` if it is not a split or has no such fold, and for a ``role`` or a fold without a split.
    """
    if split is None:
        if role is not None or fold:
            raise UsageError(
                "A role and a fold are those of a split: give split too, as in select(split=PATH, role='test')."
            )
        return None
    place = str(split.path or "this dataset")
    split_digest(split.source, place)
    (only,) = split
    rows = only.table(columns=["recording", "fold", "role"]).to_pydict()
    table = dict(zip(zip(rows["recording"], rows["fold"], strict=True), rows["role"], strict=True))
    return roles_in_fold(table, fold, place)


def select_names(
    dataset: ReadableDataset,
    patterns: Sequence[str],
    roles: Mapping[str, str] | None,
    role: str | None,
    labels: Mapping[str, Wanted],
) -> list[str]:
    """Return the names of the recordings that match a pattern, have the role and meet each condition on a label.

    Raises `UsageError` if there are none, for a label that no recording has, and for a pattern that is no text.
    """
    if not all(isinstance(pattern, str) for pattern in patterns):
        raise UsageError(
            "A name is a text. For a list of names, write select(*names), or only(names) without patterns."
        )
    names = [
        name for name in dataset.recordings if not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)
    ]
    if not names:
        existing = listed(dataset.recordings, _SHOWN)
        raise UsageError(f"No recording is named {' or '.join(patterns) or 'anything'}; there are {existing}.")
    if roles is not None:
        names = [name for name in names if name in roles and role in (None, roles[name])]
        if not names:
            existing = ", ".join(sorted(set(roles.values())))
            raise UsageError(
                f"No recording has the role {role or 'of any kind'} in this split; its roles are {existing}."
            )
    for label, condition in labels.items():
        names = _select_by_label(dataset, names, label, condition)
    return names


def unknown_label(dataset: ReadableDataset, label: str) -> UsageError:
    """Return the error for a label that no recording has; it lists the existing labels."""
    existing = sorted({name for recording in dataset for name in recording.attributes if not name.startswith(TRUTH)})
    return UsageError(
        f"No recording has the label {plain(label)}; there are {listed(existing, _LABELS)}.{suggestion(label, existing)}"
    )


def _select_by_label(dataset: ReadableDataset, names: Sequence[str], label: str, condition: Wanted) -> list[str]:
    """Return the names whose label meets the condition.

    Raises `UsageError` if no recording has the label, or none meets it.
    """
    values = {name: dataset[name].attributes[label] for name in names if label in dataset[name].attributes}
    if not values:
        raise unknown_label(dataset, label)
    meets = _predicate(condition)
    matching = [name for name, value in values.items() if meets(value)]
    if not matching:
        existing = listed(sorted({str(value) for value in values.values()}), _SHOWN)
        description = "a value that meets the condition" if callable(condition) else excerpt(condition)
        raise UsageError(f"No recording has {description} for the label {plain(label)}; its values are {existing}.")
    return matching


def _predicate(condition: Wanted) -> Callable[[Attribute], Any]:
    """Return the condition as a function of a label's value: equal, one of several, or the function itself."""
    if callable(condition):
        return condition
    is_collection = isinstance(condition, Collection) and not isinstance(condition, str)
    values: Collection[Attribute] = condition if is_collection else (condition,)  # type: ignore[assignment]
    return lambda value: value in values


class RecordingAttributes(Mapping[str, Mapping[str, Attribute]]):
    """The attributes of each recording, sorted by name; for a large dataset they are read on access."""

    def __init__(self, dataset: ReadableDataset) -> None:
        included = dataset.source.included
        is_large = isinstance(included, pages.Recordings) and len(included) == len(dataset)
        self.entries = included if is_large else {name: included[name] for name in dataset.recordings}

    def __getitem__(self, name: str) -> Mapping[str, Attribute]:
        return self.entries[name]["attributes"]

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def items(self) -> ItemsView[str, Mapping[str, Attribute]]:
        """Return names and attributes, of which each page of a manifest is loaded once."""
        return _AttributeItems(self)


class _AttributeItems(ItemsView[str, Mapping[str, Attribute]]):
    """Names and attributes of recordings, in the order of their entries."""

    _mapping: RecordingAttributes

    def __iter__(self) -> Iterator[tuple[str, Mapping[str, Attribute]]]:
        return ((name, entry["attributes"]) for name, entry in self._mapping.entries.items())


def equal_recordings(entries: Mapping[str, RecordingEntry]) -> list[list[str]]:
    """Return the groups of recordings whose streams have equal names and digests, each sorted by name.

    >>> shard = {"digest": "1f", "bytes": 4, "rows": 1}
    >>> equal_recordings({name: {"attributes": {}, "shards": {"": shard}} for name in "ba"})
    [['a', 'b']]
    """
    names_by_content: dict[object, list[str]] = {}
    for part in pages.parts(entries):
        for name, entry in sorted(part.items()):
            content = frozenset((stream, shard["digest"]) for stream, shard in entry["shards"].items())
            names_by_content.setdefault(content or name, []).append(name)
    return [sorted(names) for names in names_by_content.values() if len(names) > 1]


PUBLISHED, SIMULATED = "published", "simulated"


def is_simulated(dataset: ReadableDataset) -> bool:
    """Return whether any recording of a dataset was simulated."""
    return any(bool(recording.attributes.get(SIMULATED)) for recording in dataset.recordings.values())


def combine_origins(recordings: Iterable[Mapping[str, Attribute]]) -> dict[str, Attribute]:
    """Return the attributes of a result of several recordings: simulated if any of them is, published if all are.

    >>> combine_origins([{"published": "b"}, {"published": "a"}]), combine_origins([{"published": "a"}, {"simulated": True}])
    ({'published': 'a,b'}, {'simulated': True})
    """
    attributes = list(recordings)
    origin: dict[str, Attribute] = (
        {SIMULATED: True} if any(recording.get(SIMULATED) for recording in attributes) else {}
    )
    sets = {str(recording.get(PUBLISHED) or "") for recording in attributes}
    if sets and "" not in sets:
        origin[PUBLISHED] = ",".join(sorted(sets))
    return origin


def merge_manifests(manifests: Sequence[Manifest]) -> Manifest:
    """Return several datasets of the same kind merged into one.

    Raises `UsageError` if two recordings share a name, or if files or chains of stages differ.
    """
    if len(manifests) == 1:
        return manifests[0]
    recordings: dict[str, RecordingEntry] = {}
    files: dict[str, Content] = {}
    for manifest in manifests:
        shared = next((name for name in manifest.recordings if name in recordings), None)
        if shared is not None:
            raise UsageError(
                f"Two of the datasets hold a recording named {shared}. Names must be unique; leave one dataset out."
            )
        if manifest.chain != manifests[0].chain:
            raise UsageError(
                f"These datasets were made in different ways and cannot be read as one: "
                f"{chain_difference(manifests[0].chain, manifest.chain)}."
            )
        recordings.update(manifest.recordings)
        files.update(manifest.files)
    first = manifests[0]
    return Manifest(first.stage, first.version, first.params, {}, first.chain, recordings, files)


def chain_difference(expected: Sequence[Step], chain: Sequence[Step]) -> str:
    """Describe the first difference between two chains of stages.

    >>> step = {"stage": "synchronize", "version": 1, "params": {"rate_hz": 50.0}, "fitted": None}
    >>> chain_difference([step], [{**step, "params": {"rate_hz": 100.0}}])
    'synchronize has rate_hz 100.0 instead of 50.0'
    """
    for ours, theirs in zip(expected, chain, strict=False):
        if ours["stage"] != theirs["stage"]:
            return f"{theirs['stage']} is where {ours['stage']} should be"
        if ours["version"] != theirs["version"]:
            return f"{ours['stage']} has version {theirs['version']} instead of {ours['version']}"
        our_params, their_params = (
            params_of.with_current_names(step["stage"], step["params"]) for step in (ours, theirs)
        )
        for name in sorted({*our_params, *their_params}):
            expected_value, value = our_params.get(name), their_params.get(name)
            if expected_value != value:
                return f"{ours['stage']} has {name} {value} instead of {expected_value}"
        if ours["fitted"] != theirs["fitted"]:
            return f"{ours['stage']} was fitted on other recordings"
    if len(expected) != len(chain):
        longer = expected if len(expected) > len(chain) else chain
        return f"only one of them went through {longer[min(len(expected), len(chain))]['stage']}"
    return "they are the same"
