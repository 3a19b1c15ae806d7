"""Trace a dataset to its raw files, and report which part of its key changed since the last run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict, TypeVar, final

from tacpipe import printable
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages
from tacpipe.datasets.manifest import InputDataset, Manifest
from tacpipe.errors import StorageError, TacpipeError, UsageError
from tacpipe.io import Json
from tacpipe.io.terminal import WIDTH, RowGroup, TerminalRow, TerminalTable
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.stage import Attribute, ParamValue, StoredParams
from tacpipe.printable import format_count, listed
from tacpipe.store import records
from tacpipe.store.location import locate
from tacpipe.store.records import Content, Provenance, RecordingEntry, RunIdentity
from tacpipe.store.roots import Root
from tacpipe.store.store import Store

V = TypeVar("V")
_SHOWN = 5  # number of names listed before the others are counted


@final
class LostNode(TypedDict):
    """A dataset of a lineage whose manifest cannot be read."""

    manifest: str  # digest
    digest: str
    lost: str  # reason why the manifest cannot be read


@final
class LineageNode(TypedDict):
    """A dataset of a lineage, and the datasets that it was computed from."""

    stage: str
    version: int
    params: StoredParams
    digest: str
    manifest: str  # digest
    path: str | None  # present location
    recordings: int
    rows: int
    files: dict[str, str]  # digests
    files_bytes: int
    labels: dict[str, dict[str, Attribute]]  # labels set by hand, by recording
    skipped: dict[str, str]  # reasons by recording
    sources: dict[str, dict[str, str]]  # digests of raw files by recording
    inputs: dict[str, list[LineageNode | LostNode]]  # inputs by argument
    provenance: NotRequired[Provenance | None]  # only for the traced dataset
    changes: NotRequired[list[str] | None]  # differences from its previous run, or None if there was none


def trace(path: Path) -> LineageNode:
    """Return the lineage of the dataset (or report) at ``path`` as a tree, with the changes since the previous run.

    Raises `UsageError` if it is not in this store.
    """
    store = locate(path if path.is_dir() else path.absolute().parent)
    root = store.roots.get((path.parent if path.name == manifest_of.NAME else path).absolute())
    if path.is_file() and path.name != manifest_of.NAME:
        if root is None:
            raise UsageError(f"{path} was not written by tacpipe, or into another store than {store.root}.")
        dataset = manifest_of.Found(path.parent, store.read(root["manifest"]), store)
    else:
        dataset = manifest_of.find(path)
    places = {entry["manifest"]: entry["path"] for entry in store.roots.all()}
    tree = _node(store, dataset.manifest, dataset.digest, places)
    changed = _describe_changes(store, root, dataset.manifest)
    written_s = 0 if root is None else int(root.get("written_s", 0))
    provenance = _provenance(store, dataset.digest, written_s, "" if root is None else root.get("key", ""))
    return {**tree, "provenance": provenance, "changes": changed}


def _node(store: Store, manifest: Manifest, name: str, paths: dict[str, str]) -> LineageNode:
    """Return the node of a manifest in the lineage, with its inputs; ``places`` are the paths of manifests by digest.

    Inputs that cannot be read are marked as lost. Raises `StorageError` if the system fails to read one.
    """
    inputs: dict[str, list[LineageNode | LostNode]] = {}
    for argument, datasets in manifest.inputs.items():
        inputs[argument] = []
        for dataset in datasets:
            try:
                source = manifest_of.stored(store, dataset["manifest"])
                inputs[argument].append(_node(store, source, dataset["manifest"], paths))
            except StorageError:
                raise
            except TacpipeError as error:
                inputs[argument].append(
                    {"manifest": dataset["manifest"], "digest": dataset["dataset"], "lost": str(error)}
                )
    return {
        "stage": manifest.stage,
        "version": manifest.version,
        "params": params_of.with_current_names(manifest.stage, manifest.params),
        "digest": manifest.digest,
        "manifest": name,
        "path": paths.get(name),
        "recordings": len(manifest.recordings),
        "rows": manifest.rows,
        "files": {file: value["digest"] for file, value in manifest.files.items()},
        "files_bytes": sum(value["bytes"] for value in manifest.files.values()),
        "labels": {recording: dict(labels) for recording, labels in manifest.labels.items()},
        "skipped": dict(manifest.skipped),
        "sources": {recording: dict(files) for recording, files in manifest.sources.items()},
        "inputs": inputs,
    }


def _provenance(store: Store, manifest: str, written_s: int, key: str) -> Provenance | None:
    """Return the provenance of a manifest written at its path at ``written_s``, or None if no record contains it.

    ``key`` names the run that produced or labelled it, if its root contains that; then no other record is read.
    """
    of_run = store.record(key) if key else None
    for record in store.find_naming(manifest, written_s) if of_run is None else [of_run]:
        file = record["result"]["files"].get(manifest_of.NAME)
        if file is not None and file["digest"] == manifest:
            return record["provenance"]
    return None


class CountedRows(TypedDict):
    """The rows that were read to produce a dataset."""

    stages: dict[str, Json]  # rows by stage; some runs include those of preceding stages
    uncounted: int  # number of results of older versions, whose rows were not counted


def counted_rows(store: Store, manifest: Manifest, key: str) -> CountedRows:
    """Return the rows that the run ``key``, which produced a dataset, read; "" if the run is unknown."""
    record = store.record(key) if key else None
    stages = dict(records.summary(record).get("stage_rows") or {}) if record is not None else {}
    try:
        mapped = manifest.stage == manifest_of.ACQUIRE or registry.load(manifest.stage).mapped
    except TacpipeError:  # the plug-in was removed
        mapped = True
    results = stages[manifest.stage]["results"] if manifest.stage in stages else 0
    return {"stages": stages, "uncounted": max(0, (len(manifest.recordings) if mapped else 1) - results)}


def chain_rows(store: Store, manifest: Manifest, name: str) -> list[CountedRows]:
    """Return the rows that were read for a dataset and for the datasets that it comes from, the oldest first.

    ``name`` is the digest of the manifest. Datasets whose manifest is lost are left out.
    """
    key_by_manifest = {root["manifest"]: root.get("key", "") for root in store.roots.all()}

    visited: set[str] = set()

    def collect(node: Manifest, name: str) -> Iterator[CountedRows]:
        visited.add(name)
        for dataset in node.inputs.get("datasets", ()):
            source = manifest_of.stored_or_none(store, dataset["manifest"])
            if source is not None and dataset["manifest"] not in visited:
                yield from collect(source, dataset["manifest"])
        yield counted_rows(store, node, key_by_manifest.get(name, ""))

    return list(collect(manifest, name))


def _describe_changes(store: Store, root: Root | None, now: Manifest) -> list[str] | None:
    """Describe the differences from the previous run; None if there was none."""
    previous = None if root is None else root.get("previous")
    if previous is None:
        return None
    before = manifest_of.stored_or_none(store, previous)
    if before is None:
        return ["the manifest of the run before is no longer in the store"]
    return changes(store, before, now)


def changes(store: Store, before: Manifest, now: Manifest) -> list[str]:
    """Describe how the keys of two datasets differ: stage, version, params, inputs, labels."""
    lines = []
    if before.stage != now.stage:
        lines.append(f"stage: {before.stage} became {now.stage}")
    if before.version != now.version:
        lines.append(f"version: {before.version} became {now.version}")
    old, new = (_leaves(params_of.with_current_names(manifest.stage, manifest.params)) for manifest in (before, now))
    lines += [
        f"params.{name}: {old.get(name)} became {new.get(name)}"
        for name in sorted({*old, *new})
        if old.get(name) != new.get(name)
    ]
    lines += _compare_groups("sources", *pages.differing(before.sources, now.sources))
    for argument in sorted({*before.inputs, *now.inputs}):
        lines += _input_changes(store, argument, before.inputs.get(argument, []), now.inputs.get(argument, []))
    lines += _compare_groups("labels", *pages.differing(before.labels, now.labels))
    if not lines and before.digest != now.digest and not _has_equal_content(before, now):
        lines.append("result: the same key gave other bytes")
    return lines


def _has_equal_content(before: Manifest, now: Manifest) -> bool:
    """Return whether two manifests, of which only one has pages, have the same content."""
    if (before.pages is None) == (now.pages is None) or len(before.recordings) != len(now.recordings):
        return False
    entries = pages.compared(before.recordings, now.recordings)
    return before.files == now.files and all(old == new for _, old, new in entries)


def _input_changes(
    store: Store, argument: str, before: Sequence[InputDataset], now: Sequence[InputDataset]
) -> list[str]:
    """Return lines that describe how the recordings and files of an argument's datasets differ.

    Raises `StorageError` if the store cannot be read.
    """
    if [dataset["dataset"] for dataset in before] == [dataset["dataset"] for dataset in now]:
        return []
    try:
        old_manifests = [manifest_of.stored(store, dataset["manifest"], argument) for dataset in before]
        new_manifests = [manifest_of.stored(store, dataset["manifest"], argument) for dataset in now]
    except StorageError:
        raise
    except TacpipeError:
        return [f"inputs.{argument}: another dataset, whose manifest is no longer in the store"]
    old_recordings, new_recordings = _merged_recordings(old_manifests), _merged_recordings(new_manifests)
    old_files, new_files = _merged_files(old_manifests), _merged_files(new_manifests)
    return [
        *_compare_recordings(f"inputs.{argument}", old_recordings, new_recordings),
        *_compare_groups(f"inputs.{argument}.files", old_files, new_files),
    ]


def _merged_files(manifests: Sequence[Manifest]) -> dict[str, Content]:
    return {name: file for manifest in manifests for name, file in manifest.files.items()}


def _merged_recordings(manifests: Sequence[Manifest]) -> Mapping[str, RecordingEntry]:
    if len(manifests) == 1:
        return manifests[0].recordings
    return {name: entry for manifest in manifests for name, entry in manifest.recordings.items()}


def _compare_recordings(
    subject: str, before: Mapping[str, RecordingEntry], now: Mapping[str, RecordingEntry]
) -> list[str]:
    """Describe which recordings of two datasets differ; recordings in shared pages are equal."""
    new_names: list[str] = []
    removed: list[str] = []
    changed_shards: list[str] = []
    changed_attributes: list[str] = []
    for name, old_entry, new_entry in pages.compared(*pages.differing(before, now)):
        if old_entry is None or new_entry is None:
            (new_names if old_entry is None else removed).append(name)
            continue
        changed_shards += [name] if old_entry["shards"] != new_entry["shards"] else []
        changed_attributes += [name] if old_entry["attributes"] != new_entry["attributes"] else []
    return [
        *_count_groups(f"{subject}.shards", {"new": new_names, "gone": removed, "other": changed_shards}),
        *_count_groups(f"{subject}.attributes", {"other": changed_attributes}),
    ]


def _compare_groups(subject: str, before: Mapping[str, V], now: Mapping[str, V]) -> list[str]:
    """Return lines with the names whose values are new, gone or different."""
    groups = {
        "new": sorted(set(now) - set(before)),
        "gone": sorted(set(before) - set(now)),
        "other": sorted(name for name in set(before) & set(now) if before[name] != now[name]),
    }
    return _count_groups(subject, groups)


def _count_groups(subject: str, groups: Mapping[str, Sequence[str]]) -> list[str]:
    return [f"{subject}: {len(names)} {kind} ({listed(names, _SHOWN)})" for kind, names in groups.items() if names]


def to_text(tree: LineageNode) -> str:
    """Return the tree as indented lines, after the changes."""
    lines = []
    changes, provenance = tree.get("changes"), tree.get("provenance")
    if changes is None:
        lines.append("First run here: there is nothing to compare with.")
    else:
        lines.append("Against the last run: " + ("; ".join(changes) or "nothing changed."))
    if provenance:
        libraries = ", ".join(f"{name} {version}" for name, version in provenance["libraries"].items())
        commit = f" at commit {provenance['git_commit'][:10]}" if provenance["git_commit"] else ""
        lines.append(f"Made on {provenance['host']}{commit} with {libraries}.")
    return printable.lines([*lines, "", *_lines(tree, 0, set())])


def _nested_params(value: Any) -> StoredParams | None:
    """Return a param with parts, such as a layout, which is stored as JSON, or None for a plain value."""
    nested = value
    if isinstance(value, str) and value.startswith("{"):
        try:
            nested = json.loads(value)
        except ValueError:
            return None
    return nested if isinstance(nested, Mapping) else None


def _rows(value: Any) -> list[StoredParams]:
    """Return the rows of a list of mappings, or an empty list for other values."""
    return value if isinstance(value, list) and all(isinstance(row, Mapping) for row in value) else []


def _leaves(params: StoredParams) -> StoredParams:
    """Return plain values by dotted name.

    >>> _leaves({"gap_ms": 50, "layout": '{"time": {"unit": "ns"}, "columns": [{"match": "x"}]}'})
    {'gap_ms': 50, 'layout.time.unit': 'ns', 'layout.columns.0.match': 'x'}
    """
    leaves: dict[str, ParamValue] = {}
    for name, value in params.items():
        parts = _nested_params(value) or {str(index): row for index, row in enumerate(_rows(value))}
        leaves |= {f"{name}.{part}": leaf for part, leaf in _leaves(parts).items()} if parts else {name: value}
    return leaves


def _nested_lines(name: str, tree: StoredParams) -> list[str]:
    """Return the lines of a nested param: plain values on one line, lists of columns as a table.

    >>> _nested_lines("layout", {"unit": "ns", "columns": [{"match": "x", "unit": "N"}, {"match": "dx"}]})
    ['layout: unit ns', 'layout.columns:', '  match  unit', '  x      N', '  dx']
    """
    plain = [f"{key} {value}" for key, value in tree.items() if not isinstance(value, Mapping) and not _rows(value)]
    lines = [f"{name}: {', '.join(plain)}"] if plain else []
    for key, value in tree.items():
        if isinstance(value, Mapping):
            lines += _nested_lines(f"{name}.{key}", value)
        elif rows := _rows(value):
            heads = list(dict.fromkeys(head for row in rows for head in row))
            cells = [TerminalRow([str(row.get(head, "")) for head in heads]) for row in rows]
            table = TerminalTable(heads, [RowGroup("", cells)], left=range(len(heads)))
            lines += [f"{name}.{key}:", *(f"  {line}" for line, _ in table.lines(WIDTH))]
    return lines


def _files(node: LineageNode) -> str:
    """Return the names of the files if there are few, or their number with the first names."""
    names = list(node["files"])
    if len(names) <= _SHOWN:
        return ", ".join(names)
    return f"{len(names)} files, {node['files_bytes'] / 1e6:.1f} MB: {listed(names, _SHOWN)}"


def _lines(node: LineageNode | LostNode, depth: int, described: set[str], argument: str = "") -> list[str]:
    """Return the lines of a node and its ancestors; nodes already ``described`` are only named."""
    pad = "  " * depth
    label = f"{argument}: " if argument else ""
    if "lost" in node:
        return [f"{pad}{label}dataset {node['digest'][:12]}, whose manifest is not in this store"]
    place = f"{pad}{label}{node['path'] or '(no longer at a path)'}  [{node['digest'][:12]}]"
    if node["manifest"] in described:
        return [f"{place}  as above"]
    described.add(node["manifest"])
    content = (
        f"{format_count(node['recordings'], 'recordings')}, {format_count(node['rows'], 'rows')}"
        if node["recordings"]
        else _files(node)
    )
    trees = {name: _nested_params(value) for name, value in node["params"].items()}
    nested = {name: tree for name, tree in trees.items() if tree is not None}
    params = ", ".join(f"{name}={value}" for name, value in node["params"].items() if name not in nested)
    lines = [
        f"{place}  {content}",
        f"{pad}  {node['stage']} version {node['version']}" + (f" ({params})" if params else ""),
        *(f"{pad}    {line}" for name, tree in nested.items() for line in _nested_lines(name, tree)),
    ]
    if node["sources"]:
        files = [digest for digests in node["sources"].values() for digest in digests.values()]
        first = next(iter(sorted(node["sources"])))
        name, digest = next(iter(sorted(node["sources"][first].items())))
        lines.append(
            f"{pad}  from {format_count(len(files), 'raw files')} of {format_count(len(node['sources']), 'recordings')}, as "
            f"{first}/{name}  [{digest[:12]}]"
        )
    if node["labels"]:
        lines.append(f"{pad}  labelled by hand: {listed(sorted(node['labels']), _SHOWN)}")
    if node["skipped"]:
        lines.append(f"{pad}  left out: {listed(sorted(node['skipped']), _SHOWN)}")
    for name, sources in node["inputs"].items():
        for source in sources:
            lines += _lines(source, depth + 1, described, name)
    return lines


def identities_of_manifests(store: Store) -> dict[str, RunIdentity]:
    """Return the identity of each recorded run by the digest of the manifest that the run wrote."""
    identities: dict[str, RunIdentity] = {}
    for _, record in store.records():
        identity, file = record["identity"], record["result"]["files"].get(manifest_of.NAME)
        if file is not None and "run" in identity:
            identities[file["digest"]] = identity
    return identities
