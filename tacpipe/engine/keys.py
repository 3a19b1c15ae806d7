"""Compute the identities of shards, datasets and runs, whose digests are keys, and define the tasks that compute results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

from tacpipe.datasets import pages
from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import UsageError
from tacpipe.io.hashing import digest
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.stage import ALL, AnyStage, Source, StoredParams, Values
from tacpipe.store.records import ComputedResult, Content, GroupIdentity, RecordingEntry, StageIdentity, Step
from tacpipe.store.store import Store
from tacpipe.training.devices import AUTO, Device

_MAX_TRIALS = 1_000_000


@dataclass(frozen=True)
class WorkerTask:
    """One key to compute, with everything that a worker process needs."""

    store: str  # path or address of the store
    name: str  # name of the stage
    identity: StageIdentity
    recording: str = ""
    files: Mapping[str, str] | None = None  # paths of the files of a published source, by name
    dataset_dirs: tuple[str, ...] = ()  # dataset directories whose shards can be adopted
    replace: bool = False  # whether the existing record refers to missing objects
    dry: bool = False  # whether the result is only compared and not stored
    rerun: bool = False  # whether to compute even if a result is stored
    device: Device = AUTO  # device for training networks
    run: str = ""  # lease of the run that the task belongs to


@dataclass(frozen=True)
class Done:
    """Outcome of a task: a record, or the error of the recording."""

    recording: str
    record: ComputedResult | None
    error: str = ""
    exit_code: int = 0
    is_new: bool = True  # False if another process finished first
    # whether the recording caused the error, rather than the disk, a damaged input or another process
    at_fault: bool = True


class DatasetLineage(TypedDict):
    """How a dataset was made, as far as a key depends on it."""

    stage: str
    version: int
    params: StoredParams
    chain: Sequence[Step]


class DatasetIdentity(TypedDict):
    """The part of a key that describes a dataset."""

    lineage: DatasetLineage
    recordings: Mapping[str, RecordingEntry]
    files: Mapping[str, str]  # digests


class RolesIdentity(TypedDict):
    """The part of a key that describes the roles in one fold of a split."""

    roles: str  # digest of the table of the split
    fold: int


def identity(name: str, version: int, params: Any, inputs: Values) -> StageIdentity:
    """Return the identity of a result, whose digest is the key. ``params`` is a stage's dataclass, or its values by name."""
    values = params if isinstance(params, Mapping) else params_of.to_json(params)
    return {"stage": name, "version": version, "params": values, "inputs": inputs}


def of_recording(entry: RecordingEntry, reads: tuple[str, ...] | None) -> RecordingEntry:
    """Return a recording's part of a key: the digests of its streams, and the attributes in ``reads`` (None for all)."""
    attributes = entry["attributes"]
    if reads is not None and reads != ALL:
        attributes = {name: attributes[name] for name in reads if name in attributes}
    return {**pages.key_entry(entry), "attributes": attributes}


def of_dataset(
    manifest: Manifest, reads: tuple[str, ...] | None, chosen: Mapping[str, RecordingEntry]
) -> DatasetIdentity:
    """Return a dataset's part of a key: names, attributes and digests of the ``chosen`` recordings, chain, files."""
    recordings: Mapping[str, RecordingEntry]
    if isinstance(chosen, pages.Recordings) and reads in (None, ALL):
        recordings = pages.KeyRecordings(chosen.pages)
    else:
        recordings = {name: of_recording(entry, reads) for name, entry in sorted(chosen.items())}
    return {
        "lineage": {
            "stage": manifest.stage,
            "version": manifest.version,
            "params": manifest.params,
            "chain": manifest.chain,
        },
        "recordings": recordings,
        "files": {name: file["digest"] for name, file in manifest.files.items()},
    }


def chain_step(name: str, stage: AnyStage, params: Any, fitted: Mapping[str, Content] | None) -> Step:
    """Return the link of a chain that a map stage adds."""
    files = {file: value["digest"] for file, value in fitted.items()} if fitted is not None else None
    return {"stage": name, "version": stage.version, "params": params_of.to_json(params), "fitted": files}


def of_group(step: Step, stage: AnyStage, entries: Mapping[str, RecordingEntry]) -> GroupIdentity:
    """Return the identity of a map stage's results for a group, which covers the keys of all its recordings."""
    recordings_digest = digest({name: of_recording(entry, stage.reads or ()) for name, entry in entries.items()})
    return {"group": step["stage"], "step": step, "recordings": recordings_digest}


def shard_tasks(store: Store, source: Manifest, step: Step, dataset_dirs: tuple[str, ...]) -> list[WorkerTask]:
    """Return one task per included recording of ``source`` for the stage ``step`` of a chain."""
    stage = registry.load_step(step["stage"])
    fitted = {name: step["fitted"] for name, kind in stage.arguments.items() if kind == "Fitted"}
    (recording,) = (name for name, kind in stage.arguments.items() if kind == "Recording")
    name_argument = stage.argument("RecordingName")

    def task(name: str, entry: RecordingEntry) -> WorkerTask:
        inputs = {
            recording: of_recording(entry, stage.reads or ()),
            **fitted,
            **({name_argument: name} if name_argument else {}),
        }
        task_identity = identity(step["stage"], stage.version, step["params"], inputs)
        return WorkerTask(store.place, step["stage"], task_identity, name, dataset_dirs=dataset_dirs)

    return [task(name, entry) for name, entry in sorted(source.included.items())]


def source_tasks(
    store: Store,
    name: str,
    stage: AnyStage,
    params: Any,
    sources: Mapping[str, Source],
    digests: Mapping[str, Mapping[str, str]],
) -> list[WorkerTask]:
    """Return one task per recording of a published source."""
    argument, values, called = (stage.argument(kind) for kind in ("Files", "Values", "RecordingName"))
    assert argument is not None

    def task(recording: str, source: Source) -> WorkerTask:
        inputs = {
            argument: {file: digests[recording][file] for file in source.files},
            **({} if values is None else {values: dict(source.values)}),
            **({} if called is None else {called: recording}),
        }
        task_identity = identity(name, stage.version, params, inputs)
        return WorkerTask(
            store.place, name, task_identity, recording, files={file: str(path) for file, path in source.files.items()}
        )

    return [task(recording, source) for recording, source in sources.items()]


def trial_tasks(store: Store, name: str, stage: AnyStage, params: Any) -> list[WorkerTask]:
    """Return one task per recording to simulate, named ``trial-000`` and so on.

    Raises `UsageError` if there are too many.
    """
    (argument,) = (name for name, kind in stage.arguments.items() if kind == "Trial")
    count = int(params.trials)
    if count > _MAX_TRIALS:
        raise UsageError(f"--trials is {count}; a dataset holds at most {_MAX_TRIALS:,} recordings.")
    width = max(3, len(str(count - 1)))
    return [
        WorkerTask(
            store.place,
            name,
            identity(name, stage.version, params, {argument: number}),
            f"trial-{number:0{width}d}",
        )
        for number in range(count)
    ]
