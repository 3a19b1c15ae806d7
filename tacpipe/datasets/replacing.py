"""Decide whether a command may replace its output, because recordings and labels cannot be recomputed.

The rules, each with exit code 2:

- an output that is one of the command's inputs is never replaced;
- a dataset of another stage, and recordings or hand-set labels that the new dataset lacks, require ``--replace``;
- edited files of an export require ``--replace``;
- a stage may replace its own dataset, which has other params or other inputs.

Replaced content stays in the store and is listed by `tacpipe store list`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages
from tacpipe.datasets.manifest import ACQUIRE, VALUES, Manifest
from tacpipe.datasets.pages import Item
from tacpipe.datasets.paths import folded_name
from tacpipe.errors import DamagedError, StorageError, TacpipeError, UsageError
from tacpipe.io import files, regular
from tacpipe.io.hashing import digest
from tacpipe.plugins.stage import Attribute, StoredParams
from tacpipe.printable import listed, plain
from tacpipe.store import layout
from tacpipe.store.store import Store

_SHOWN = 5  # number of names listed before the others are counted
_BACK = "What is there now stays in the store, and `tacpipe store list` names it."
_KEEP = f"Give -o another directory, or --replace. {_BACK}"


@dataclass(frozen=True)
class Losses:
    """Recordings that a new dataset lacks or has with other content, and recordings whose labels it lacks."""

    recordings: Sequence[str] = ()
    labels: Sequence[str] = ()

    def __bool__(self) -> bool:
        return bool(self.recordings or self.labels)


@dataclass(frozen=True)
class ResultPlan:
    """Properties of a result that are known before it is computed."""

    stage: str
    version: int
    params: StoredParams = field(default_factory=dict)
    sources: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # digests of raw files by recording


def refuse_inputs(output: Path, inputs: Iterable[Path]) -> None:
    """Raise `UsageError` if ``output`` is one of the ``inputs`` of a command, an address, or inside a store."""
    files.local(output)
    layout.refuse_within(output)
    for path in inputs:
        if _is_same_path(output, path.parent if path.name == manifest_of.NAME else path):
            raise UsageError(
                f"{output} is an input of this command, and writing there would replace it. Give -o another directory."
            )


def _is_same_path(output: Path, path: Path) -> bool:
    return output.resolve() == path.resolve()


def refuse_foreign(path: Path, mark: bytes) -> None:
    """Raise `UsageError` if the file at ``path`` lacks ``mark`` in its first 64 KiB, because another program wrote it."""
    if not path.exists():
        return
    beginning = b""
    if path.is_file():
        with regular.opened(path) as file:
            beginning = file.read(2**16)
    if mark not in beginning:
        raise UsageError(f"{path} already exists, and this command did not write it. Give -o another path.")


def occupant(store: Store, output: Path) -> Manifest | None:
    """Return the manifest of the dataset at ``output``, or None if there is none.

    A damaged one is read from the store. Raises `DamagedError` if that is not possible, because the content to replace
    is then unknown.
    """
    if not (output / manifest_of.NAME).exists():
        return None
    try:
        return manifest_of.find(output).manifest
    except StorageError:
        raise
    except TacpipeError as error:
        former_manifest = former(store, output)
        if former_manifest is None:
            raise DamagedError(
                f"{error} Labels that were set by hand may be in it, and would be lost. Restore it with git, or remove "
                f"it to continue without them."
            ) from None
        return former_manifest


def former(store: Store, output: Path) -> Manifest | None:
    """Return the manifest that was last written at ``output``, whatever is there now, or None if it is not in the store."""
    root = store.roots.get(output.absolute())
    return None if root is None else manifest_of.stored_or_none(store, root["manifest"])


def irreplaceable(manifest: Manifest) -> bool:
    """Return whether the recordings were ingested or acquired, so that no stage can recompute them."""
    return manifest.stage == ACQUIRE or bool(manifest.sources)


def lasting(manifest: Manifest) -> bool:
    """Return whether a dataset contains recordings or hand-set labels, which no stage can recompute."""
    return irreplaceable(manifest) or bool(manifest.labels)


def possessions(manifest: Manifest) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the irreplaceable content of ``manifest`` in a form that can be compared between manifests.

    Each item is (identity, value): a recording is identified by name and content, a label also by its own name.
    """
    lasts = irreplaceable(manifest)
    for name in manifest.recordings if lasts else manifest.labels:
        if name not in manifest.recordings:
            continue
        item = manifest.item(name)
        content = digest({stream: shard["digest"] for stream, shard in item.entry["shards"].items()})
        if lasts:
            yield (name, content), None
        for label, value in (item.labels or {}).items():
            yield (name, content, label), value


def losses(before: Manifest, after: Manifest) -> Losses:
    """Return the irreplaceable content of ``before`` that ``after`` lacks."""
    if not lasting(before):
        return Losses()
    # names of lost recordings (True), and of recordings that lost only labels (False)
    lost: dict[bool, list[str]] = {True: [], False: []}
    for name in pages.differing(before.recordings, after.recordings)[0]:
        if irreplaceable(before) and _is_gone(name, before, after):
            lost[True].append(name)
        elif any(after.labels.get(name, {}).get(key) != value for key, value in before.labels.get(name, {}).items()):
            lost[False].append(name)
    return Losses(sorted(lost[True]), sorted(lost[False]))


def _is_gone(name: str, before: Manifest, after: Manifest) -> bool:
    """Return whether ``after`` has neither the content nor the raw files of a recording under its name.

    An acquired recording has no raw files of its own: its source is the rig file, which it shares with others.
    """
    if name not in after.recordings:
        return True
    earlier, now = (_raw(manifest.sources.get(name, {})) for manifest in (before, after))
    same_files = name in before.sources and earlier == now and before.stage != ACQUIRE
    return not same_files and before.recordings[name]["shards"] != after.recordings[name]["shards"]


def _raw(source: Mapping[str, str]) -> dict[str, str]:
    """Return the digests of a recording's raw files, without that of its labels."""
    return {file: digest for file, digest in source.items() if file != VALUES}


def refuse_plan(before: Manifest | None, output: Path, plan: ResultPlan) -> None:
    """Raise `UsageError` if ``plan`` would replace recordings or labels. This is checked before anything is computed."""
    if before is None:
        return
    if before.stage != plan.stage:
        raise UsageError(f"{output} holds {_describe_dataset(before)}; {plan.stage} would replace it. {_KEEP}")
    sources = {name: (_raw(before.sources.get(name, source)), _raw(source)) for name, source in plan.sources.items()}
    changed = [name for name, (earlier, now) in sources.items() if earlier != now]
    hint = f"or --replace, after which {output} holds the recordings of this source alone. {_BACK}"
    if changed:
        raise UsageError(
            f"{output} holds recordings of the same name that came from other files: {listed(sorted(changed), _SHOWN)}. "
            f"Rename the new ones, or give -o another directory, {hint}"
        )
    _refuse_alike(before, output, plan, hint)
    other_names = sorted(set(before.recordings) - set(plan.sources)) if plan.sources else []
    if other_names and (before.version, dict(before.params)) != (plan.version, dict(plan.params)):
        raise UsageError(
            f"{output} holds {len(other_names)} recordings that this source does not have "
            f"({listed(other_names, _SHOWN)}), and they were made by version {before.version} of {before.stage} with "
            f"{_params(before.params)}. Ingest all of them together, or give -o another directory, {hint}"
        )


def _refuse_alike(before: Manifest, output: Path, plan: ResultPlan, hint: str) -> None:
    """Raise `UsageError` if a new recording has the raw files of an existing one, or its name in other case."""
    new = [name for name in plan.sources if name not in before.recordings]
    if not new:
        return
    names = {folded_name(name): name for name in before.recordings}
    files = {frozenset(dict(digests).items()): name for name, digests in before.sources.items()}
    for name in new:
        same = files.get(frozenset(dict(plan.sources[name]).items()))
        if same is not None:
            raise UsageError(
                f"{output} holds the files of {plain(name)} already, as the recording {plain(same)}. Name the folder as it "
                f"was, or give -o another directory, {hint}"
            )
        if (existing := names.get(folded_name(name))) is not None:
            raise UsageError(
                f"{output} holds the recording {plain(existing)}, which differs from {plain(name)} only in case. Rename the "
                f"new one, or give -o another directory, {hint}"
            )


def refuse_losses(before: Manifest | None, output: Path, after: Manifest) -> None:
    """Raise `UsageError` if ``after`` would replace another stage's dataset, or lose recordings or labels of ``before``."""
    refuse_plan(before, output, ResultPlan(after.stage, after.version, after.params))
    lost = Losses() if before is None else losses(before, after)
    if lost.recordings:
        count = len(lost.recordings)
        raise UsageError(
            f"{output} holds {count} recordings that the new dataset does not have ({listed(lost.recordings, _SHOWN)}). "
            f"{_KEEP}"
        )
    if lost.labels:
        raise UsageError(
            f"{output} holds labels that were set by hand on recordings that the new dataset does not have or labels "
            f"differently ({listed(lost.labels, _SHOWN)}). {_KEEP}"
        )


def edited_files_error(output: Path, paths: Sequence[str]) -> UsageError:
    """Return the error for edited files of an export."""
    plural = len(paths) > 1
    return UsageError(
        f"{output} holds {'files' if plural else 'a file'} that {'were' if plural else 'was'} edited after the export "
        f"({listed(paths, _SHOWN)}). Move {'them' if plural else 'it'} elsewhere, or give -o another directory, or "
        f"--replace. {_BACK}"
    )


def append_manifest(before: Manifest, ingested: Manifest) -> Manifest:
    """Return the recordings of ``before`` and ``ingested``, which takes precedence.

    Recordings that could not be read this time are kept unchanged.
    """
    items = {name: Item(entry, None, ingested.sources.get(name)) for name, entry in ingested.recordings.items()}
    combined = before.with_recordings(items)
    skipped = {
        name: reason
        for name, reason in {**before.skipped, **ingested.skipped}.items()
        if name not in combined.recordings
    }
    return replace(
        ingested, recordings=combined.recordings, skipped=skipped, sources=combined.sources, labels=combined.labels
    )


def returning_labels(
    store: Store, output: Path, before: Manifest | None, result: Manifest
) -> dict[str, Mapping[str, Attribute]]:
    """Return the hand-set labels of recordings that return to ``output``, which had them earlier, but not in ``before``.

    A recording returns if it has the same content or raw files; it gets its last labels.
    """
    coming = {
        name
        for name in result.recordings
        if before is None or name not in before.recordings or _is_gone(name, before, result)
    }
    root = store.roots.get(output.absolute()) if coming else None
    if root is None:
        return {}
    # the successor of a manifest that is not lasting contains the same recordings
    names = [root["manifest"], *(version["manifest"] for version in root.get("history", []) if version["lasting"])]
    labels: dict[str, Mapping[str, Attribute]] = {}
    for name in names if before is None else [name for name in names if name != before.content_digest]:
        former_manifest = manifest_of.stored_or_none(store, name)
        if former_manifest is not None and former_manifest.stage == result.stage:
            back = {
                recording
                for recording in coming & set(former_manifest.recordings)
                if not _is_gone(recording, former_manifest, result)
            }
            labels |= {name: former_manifest.labels[name] for name in back & set(former_manifest.labels)}
            coming -= back
    return labels


def keep_replaced(store: Store, directory: Path) -> Manifest | None:
    """Store and return the manifest that a publication at ``directory`` replaces, or return None if there is none.

    It is also stored if it comes from git or from a copy, so that it can be checked out later. Raises `StorageError`.
    """
    try:
        dataset = manifest_of.find(directory)
        manifest = dataset.manifest
    except StorageError:
        raise
    except TacpipeError:
        return former(store, directory)
    root = store.roots.get(directory)
    if root is None or root["manifest"] != dataset.digest:
        former_manifest = former(store, directory)
        manifest.keep(store, durable=manifest.recorded)
        store.roots.set(
            directory, dataset.digest, lasting=former_manifest is not None and bool(losses(former_manifest, manifest))
        )
    return manifest


def _describe_dataset(manifest: Manifest) -> str:
    count = len(manifest.recordings)
    recordings = f"{count} recording{'s' if count != 1 else ''}" if count else "files"
    labels = f" with labels set by hand on {len(manifest.labels)}" if manifest.labels else ""
    return f"{recordings} written by {manifest.stage}{labels}"


def _params(params: StoredParams) -> str:
    return ", ".join(f"{name} {value}" for name, value in params.items()) or "no params"
