"""What a command would replace at its output, and whether it may: recordings and labels cannot be computed again.

The rules, each with exit code 2:

- an output that is one of the command's inputs is always refused;
- a dataset of another stage, and recordings or hand-set labels that the new dataset would not hold, need ``--replace``;
- files of an export that somebody edited need ``--replace``;
- a stage may write its own dataset again: other params and other inputs are what it is for.

What was replaced stays in the store and is listed by `tacpipe store list`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages, recording_names
from tacpipe.datasets.manifest import ACQUIRE, VALUES, Manifest
from tacpipe.datasets.pages import Item
from tacpipe.errors import DamagedError, StorageError, TacpipeError, UsageError
from tacpipe.io import files, regular
from tacpipe.io.hashing import digest
from tacpipe.printable import listed, plain
from tacpipe.store import layout
from tacpipe.store.store import Store

_SHOWN = 5  # names listed before the rest is counted
_BACK = "What is there now stays in the store, and `tacpipe store list` names it."
_KEEP = f"Give -o another directory, or --replace. {_BACK}"


@dataclass(frozen=True)
class Losses:
    """Names of recordings that a new dataset lacks or has with other content, and of those whose labels it lacks."""

    recordings: Sequence[str] = ()
    labels: Sequence[str] = ()

    def __bool__(self) -> bool:
        return bool(self.recordings or self.labels)


@dataclass(frozen=True)
class Plan:
    """What a command knows of its result before it computes anything."""

    stage: str
    version: int
    params: Mapping[str, Any] = field(default_factory=dict)
    sources: Mapping[str, Any] = field(default_factory=dict)  # of ingest: recording to file to digest


def refuse_inputs(output: Path, inputs: Iterable[Path]) -> None:
    """Raise `UsageError` if ``output`` is one of the ``inputs`` of a command, an address, or within a store."""
    files.local(output)
    layout.refuse_within(output)
    for path in inputs:
        if _same(output, path.parent if path.name == manifest_of.NAME else path):
            raise UsageError(
                f"{output} is an input of this command, and writing there would replace it. Give -o another directory."
            )


def _same(output: Path, given: Path) -> bool:
    return output.resolve() == given.resolve()


def refuse_foreign(path: Path, mark: bytes) -> None:
    """Raise `UsageError` if there is a file at ``path`` whose first 64 KiB lack ``mark``: another program wrote it."""
    if not path.exists():
        return
    found = b""
    if path.is_file():
        with regular.opened(path) as file:
            found = file.read(2**16)
    if mark not in found:
        raise UsageError(f"{path} is there already and this command did not write it. Give -o another place.")


def occupant(store: Store, output: Path) -> Manifest | None:
    """Return the manifest of the dataset at ``output``, None if there is none.

    One that is damaged is read from the store. Raises `DamagedError` where that is not possible: nobody knows then what
    would be replaced.
    """
    if not (output / manifest_of.NAME).exists():
        return None
    try:
        return manifest_of.find(output).manifest
    except StorageError:
        raise
    except TacpipeError as error:
        known = former(store, output)
        if known is None:
            raise DamagedError(
                f"{error} Labels that were set by hand may be in it, and would be lost: bring it back with git, or remove "
                f"it to continue without them."
            ) from None
        return known


def former(store: Store, output: Path) -> Manifest | None:
    """Return the manifest that was last written at ``output``, whatever is there now; None if the store has none."""
    root = store.roots.get(output.absolute())
    try:
        if root is not None:
            return manifest_of.stored(store, root["manifest"], "the stored manifest")
    except StorageError:
        raise
    except TacpipeError:
        pass
    return None


def irreplaceable(manifest: Manifest) -> bool:
    """Return whether the recordings were ingested or acquired: no stage can compute them from anything in the store."""
    return manifest.stage == ACQUIRE or bool(manifest.sources)


def lasting(manifest: Manifest) -> bool:
    """Return whether a dataset holds recordings or labels set by hand, which no stage can compute again."""
    return irreplaceable(manifest) or bool(manifest.labels)


def possessions(manifest: Manifest) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield what ``manifest`` holds that cannot be computed again, in a form in which manifests can be compared.

    Each is (what it is, value): a recording by name and content, and a label by that and its own name, with its value.
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
    """Return what of ``before`` cannot be computed again and is not in ``after``."""
    if not lasting(before):
        return Losses()
    lost: dict[bool, list[str]] = {True: [], False: []}  # names by whether the recording is lost, or labels alone
    for name in pages.differing(before.recordings, after.recordings)[0]:
        if irreplaceable(before) and _gone(name, before, after):
            lost[True].append(name)
        elif any(after.labels.get(name, {}).get(key) != value for key, value in before.labels.get(name, {}).items()):
            lost[False].append(name)
    return Losses(sorted(lost[True]), sorted(lost[False]))


def _gone(name: str, before: Manifest, after: Manifest) -> bool:
    """Return whether ``after`` lacks a recording: neither its content nor its raw files are there under the name.

    An acquired recording has no raw files: its source is the rig file, which it shares with others.
    """
    if name not in after.recordings:
        return True
    earlier, now = (_raw(one.sources.get(name, {})) for one in (before, after))
    same_files = name in before.sources and earlier == now and before.stage != ACQUIRE
    return not same_files and before.recordings[name]["shards"] != after.recordings[name]["shards"]


def _raw(source: Mapping[str, Any]) -> dict[str, Any]:
    """Return the digests of a recording's raw files, without that of the labels that were read with them."""
    return {file: one for file, one in source.items() if file != VALUES}


def refuse_plan(before: Manifest | None, output: Path, plan: Plan) -> None:
    """Raise `UsageError` if ``plan`` would replace what it must not, as far as that is known before anything is computed."""
    if before is None:
        return
    if before.stage != plan.stage:
        raise UsageError(f"{output} holds {_described(before)}; {plan.stage} would replace it. {_KEEP}")
    given = {name: (_raw(before.sources.get(name, source)), _raw(source)) for name, source in plan.sources.items()}
    changed = [name for name, (earlier, now) in given.items() if earlier != now]
    alone = f"or --replace, after which {output} holds the recordings of this source alone. {_BACK}"
    if changed:
        raise UsageError(
            f"{output} holds recordings of the same name that came from other files: {listed(sorted(changed), _SHOWN)}. "
            f"Rename the new ones, or give -o another directory, {alone}"
        )
    _refuse_alike(before, output, plan, alone)
    others = sorted(set(before.recordings) - set(plan.sources)) if plan.sources else []
    if others and (before.version, dict(before.params)) != (plan.version, dict(plan.params)):
        raise UsageError(
            f"{output} holds {len(others)} recordings that this source does not have ({listed(others, _SHOWN)}), and they "
            f"were made by version {before.version} of {before.stage} with {_params(before.params)}. Ingest all of them "
            f"together, or give -o another directory, {alone}"
        )


def _refuse_alike(before: Manifest, output: Path, plan: Plan, alone: str) -> None:
    """Raise `UsageError` where a new recording has the raw files of one at ``output``, or its name but for case."""
    new = [name for name in plan.sources if name not in before.recordings]
    if not new:
        return
    names = {recording_names.folded(name): name for name in before.recordings}
    files = {frozenset(dict(digests).items()): name for name, digests in before.sources.items()}
    for name in new:
        same = files.get(frozenset(dict(plan.sources[name]).items()))
        if same is not None:
            raise UsageError(
                f"{output} holds the files of {plain(name)} already, as the recording {plain(same)}. Name the folder as it "
                f"was, or give -o another directory, {alone}"
            )
        if (other := names.get(recording_names.folded(name))) is not None:
            raise UsageError(
                f"{output} holds the recording {plain(other)}, which differs from {plain(name)} only in case. Rename the "
                f"new one, or give -o another directory, {alone}"
            )


def refuse_losses(before: Manifest | None, output: Path, after: Manifest) -> None:
    """Raise `UsageError` if ``after`` would replace another stage's dataset, or lose recordings or labels of ``before``."""
    refuse_plan(before, output, Plan(after.stage, after.version, after.params))
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


def edited(output: Path, paths: Sequence[str]) -> UsageError:
    """Return the error for files of an export that somebody edited."""
    plural = len(paths) > 1
    return UsageError(
        f"{output} holds {'files' if plural else 'a file'} that {'were' if plural else 'was'} edited after the export "
        f"({listed(paths, _SHOWN)}). Move {'them' if plural else 'it'} elsewhere, or give -o another directory, or "
        f"--replace. {_BACK}"
    )


def appended(before: Manifest, made: Manifest) -> Manifest:
    """Return the ingested recordings ``made`` with those of ``before``; where both have a name, ``made`` holds.

    Recordings that could not be read this time stay as they were.
    """
    items = {name: Item(entry, None, made.sources.get(name)) for name, entry in made.recordings.items()}
    kept = before.with_recordings(items)
    skipped = {name: why for name, why in {**before.skipped, **made.skipped}.items() if name not in kept.recordings}
    return replace(made, recordings=kept.recordings, skipped=skipped, sources=kept.sources, labels=kept.labels)


def returning_labels(
    store: Store, output: Path, before: Manifest | None, made: Manifest
) -> dict[str, Mapping[str, Any]]:
    """Return hand-set labels of recordings that are in ``made``, not the same in ``before``, and lay at ``output`` earlier.

    A recording that comes back, with the same content or raw files, has the labels that it had there last.
    """
    coming = {
        one for one in made.recordings if before is None or one not in before.recordings or _gone(one, before, made)
    }
    root = store.roots.get(output.absolute()) if coming else None
    if root is None:
        return {}
    # what a manifest held that is not lasting, the one after it holds too
    names = [root["manifest"], *(one["manifest"] for one in root.get("history", []) if one["lasting"])]
    found: dict[str, Mapping[str, Any]] = {}
    for name in names if before is None else [name for name in names if name != before.content_digest]:
        try:
            known = manifest_of.stored(store, name, "the stored manifest")
        except StorageError:
            raise
        except TacpipeError:
            continue
        if known.stage == made.stage:
            back = {one for one in coming & set(known.recordings) if not _gone(one, known, made)}
            found |= {one: known.labels[one] for one in back & set(known.labels)}
            coming -= back
    return found


def outgoing(store: Store, directory: Path) -> Manifest | None:
    """Return the manifest that a publication at ``directory`` replaces, None if there is none.

    It is known to the store afterwards, so that it can be checked out: one that git brought, or a copy, is stored.
    """
    try:
        found = manifest_of.find(directory)
        here = found.manifest
    except StorageError:
        raise
    except TacpipeError:
        return former(store, directory)
    root = store.roots.get(directory)
    if root is None or root["manifest"] != found.digest:
        known = former(store, directory)
        here.keep(store, durable=here.recorded)
        store.roots.set(directory, found.digest, lasting=known is not None and bool(losses(known, here)))
    return here


def _described(manifest: Manifest) -> str:
    count = len(manifest.recordings)
    recordings = f"{count} recording{'s' if count != 1 else ''}" if count else "files"
    labels = f" with labels set by hand on {len(manifest.labels)}" if manifest.labels else ""
    return f"{recordings} written by {manifest.stage}{labels}"


def _params(params: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in params.items()) or "no params"
