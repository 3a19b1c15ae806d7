"""Run a stage for a key: prepare its arguments from an identity, call it, and store its result."""

from __future__ import annotations

import contextlib
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from tacpipe.datasets import paths, selection
from tacpipe.datasets.dataset import Dataset, Reader, Recording
from tacpipe.datasets.manifest import ACQUIRE, Manifest
from tacpipe.datasets.paths import shard_path
from tacpipe.engine import provenance
from tacpipe.engine.keys import DatasetIdentity, RolesIdentity, WorkerTask
from tacpipe.errors import FAILED, DamagedError, StorageError, TacpipeError, is_input_error
from tacpipe.io import files, memory, regular
from tacpipe.io.files import Draft, Hashed, move, present
from tacpipe.io.hashing import bytes_digest, digest, remembered_file_digest
from tacpipe.plugins import extras, failures, registry
from tacpipe.plugins import params as params_of
from tacpipe.plugins.rows import RowCounts, RowTally, StageRows, tally_rows
from tacpipe.plugins.stage import AnyStage, RecordingOutput, Result, Stage
from tacpipe.store import records
from tacpipe.store.location import open_store
from tacpipe.store.records import Provenance, RecordingEntry, Shard, StageIdentity, StoredResult
from tacpipe.store.store import MissingError, Object, Store

if TYPE_CHECKING:
    from tacpipe.training import following

_MAX_MESSAGE_BYTES = 1 << 20  # maximum length of an error message


@dataclass(frozen=True)
class SharedFiles:
    """Files shared by the tasks of a run. They are kept with the run's drafts, so collection removes those of dead runs."""

    store: Store

    def file(self, content_key: Any, make: Callable[[Draft], None]) -> Path:
        """Return the file that ``make`` wrote for the JSON value ``content_key``, in this or an earlier process.

        Raises the errors of ``make``; an input error is stored and raised again for each caller.
        """
        key = digest({"run": self.store.run, "of": content_key})
        path, failed = (self.store.draft(digest([key, part])[:32]) for part in ("made", "failed"))
        if present(path):  # it was renamed when it was complete
            return Path(path)
        with self.store.leases.hold(key, "the recordings of a file"):
            if present(failed):
                raise TacpipeError(regular.content(failed, _MAX_MESSAGE_BYTES, follow=False).decode())
            if not present(path):
                name = self.store.draft()
                with files.new_draft(name, self.store.root) as draft:
                    try:
                        make(draft)
                    except TacpipeError as error:
                        if is_input_error(error):
                            self.store.write_file(failed, str(error).encode())
                        raise
                    move(name, path, in_store=True)
        return Path(path)


_CODE = "code"  # file in a workspace with the digest of the code that writes its checkpoints
log = logging.getLogger(__name__)


class ScratchStore:
    """Accepts content like a store and keeps only its digest and size."""

    def put(self, content: bytes, *, durable: bool = False) -> Object:
        """Return name and size of the content."""
        return Object(bytes_digest(content), len(content))

    def put_written(self, write: Callable[[Any], object], *, durable: bool = False) -> Object:
        """Return name and size of the content that ``write`` produces."""
        hashed = Hashed()
        write(hashed)
        return Object(hashed.digest, hashed.bytes)


def execute(
    task: WorkerTask, store: Store, sink: Store | ScratchStore, *, followed: bool = True
) -> tuple[StoredResult, list[str], StageRows | None]:
    """Call the stage for a task, put its content into ``sink``, and return the ``result`` of the record, notes and rows.

    With ``followed``, the progress of a training is reported to trackers and the display.
    """
    stage, stage_name = registry.load_step(task.name), registry.stage_name(task.name)
    params = params_of.from_json(stage, task.identity["params"])
    with (
        _arguments(stage, task, store) as arguments,
        _follow_training(task.name, stage, arguments if followed else {}),
        tally_rows() as tally,
    ):
        try:
            with (
                memory.raising_shortage(),
                extras.explain_missing(f"Stage {stage_name}", lambda: registry.package(stage_name)),
            ):
                with failures.naming_source((task.files or {}).values()) if stage.source else contextlib.nullcontext():
                    returned = _result(task.name, stage, stage(params, **arguments))
                if stage.source:
                    returned = _name_source_of_batches(returned, task.files or {})
                result = _store_returned(returned, sink, durable=stage.source is not None)  # batches are read here
        except Exception as error:
            failures.attach_stage(error, task.name, task.recording, (__file__, Stage.__call__.__code__.co_filename))
            raise
    notes = [*returned.notes, *(note for output in returned.recordings.values() for note in output.notes)]
    return result, notes, _counted_rows(stage, returned, result, tally)


def _name_source_of_batches(returned: Result, paths: Mapping[str, str]) -> Result:
    """Return a reader's result whose batches name the files ``paths`` in errors, also while they are stored."""
    import pyarrow as pa

    def name_files(rows: pa.Table | pa.RecordBatchReader) -> pa.Table | pa.RecordBatchReader:
        def read_batches() -> Iterator[pa.RecordBatch]:
            with failures.naming_source(paths.values()):
                yield from rows

        return rows if hasattr(rows, "num_rows") else pa.RecordBatchReader.from_batches(rows.schema, read_batches())

    recordings = {
        name: replace(output, tables={stream: name_files(rows) for stream, rows in output.streams.items()})
        for name, output in returned.recordings.items()
    }
    return replace(returned, recordings=recordings)


def _counted_rows(stage: AnyStage, returned: Result, result: StoredResult, tally: RowTally) -> StageRows | None:
    """Return the rows that a stage read, by stream, or None if they are not counted.

    Without statements of the stage, a stream was used if it, or the single table of the result, has as many rows in the
    result. Readers of files state only what they dropped.
    """
    outputs: list[Result | RecordingOutput] = [returned, *returned.recordings.values()]
    stated = [output.rows for output in outputs if output.rows is not None]
    stated += [{stream: counts} for (_, stream), counts in tally.counts.items()]
    if not stated and stage.argument("Recording"):
        entry = result["recordings"].get("")
        if entry is None:  # the result is files
            return None
        stored = {stream: shard.get("rows") for stream, shard in entry["shards"].items()}
        if any(stored.get(stream, stored.get("")) != rows for (_, stream), rows in tally.opened.items()):
            return None
        stated = [{stream: RowCounts.all_used(rows)} for (_, stream), rows in tally.opened.items()]
    elif not stated and (stage.source or (tally.opened and not stage.argument("Parts"))):
        return None
    if stage.source:
        used = {stream: shard["rows"] for stream, shard in result["recordings"][""]["shards"].items()}
        for stream in {*used, *tally.dropped}:
            count, dropped = used.get(stream, 0), tally.dropped.get(stream, {})
            stated.append({stream: RowCounts(count + sum(dropped.values()), count, dropped)})
    total = StageRows(1)
    for rows in stated:
        total.add(StageRows(0, dict(rows)))
    return total


def _result(name: str, stage: AnyStage, returned: Any) -> Result:
    if isinstance(returned, Result):
        return returned
    return Result(recordings={"": _recording(name, returned)}) if stage.mapped else _files(name, returned)


def _store_returned(returned: Result, sink: Store | ScratchStore, *, durable: bool) -> StoredResult:
    """Store the content of a stage's result, and return the ``result`` of the record."""
    recordings = {
        name: _entry(recording, sink, durable=durable) for name, recording in sorted(returned.recordings.items())
    }
    files = {name: sink.put(returned.files[name]).to_json() for name in sorted(returned.files)}
    files |= {name: sink.put_written(returned.written[name]).to_json() for name in sorted(returned.written)}
    return {"recordings": recordings, "files": files}


def differences(stored: StoredResult, recomputed: StoredResult, name: str) -> list[str]:
    """Return the paths of shards and files whose content differs. ``name`` is the recording of a map stage."""

    def digests_by_path(result: StoredResult) -> dict[str, str]:
        shards = {
            shard_path(recording or name, stream): shard["digest"]
            for recording, entry in result["recordings"].items()
            for stream, shard in entry["shards"].items()
        }
        return {**shards, **{file: value["digest"] for file, value in result["files"].items()}}

    old_digests, new_digests = digests_by_path(stored), digests_by_path(recomputed)
    return sorted(path for path in {*old_digests, *new_digests} if old_digests.get(path) != new_digests.get(path))


class _Reader:
    """The function that `reader` returns. Unpickled in another process, it reads from the same store."""

    def __init__(self, store: Store, dataset_dirs: tuple[str, ...], sizes: Mapping[str, int] | Manifest) -> None:
        self._store, self._dataset_dirs, self._sizes = store, dataset_dirs, sizes

    def __call__(self, name: str, path: str) -> bytes:
        sizes = self._sizes
        size = sizes.size_of(name, path) if isinstance(sizes, Manifest) else sizes.get(name)
        try:
            return self._store.read(name, size)
        except MissingError as error:
            try:
                content = _adopt(self._store, name, path, self._dataset_dirs, size)
            except StorageError as unread:  # try a copy before recomputing the object
                try:
                    return _remake(self._store, name, path, str(error), size)
                except DamagedError:
                    raise unread from error
            return _remake(self._store, name, path, str(error), size) if content is None else content

    def large_file(self, name: str, path: str, least_bytes: int) -> Path | None:
        """Return the path of a verified object of at least ``least_bytes`` in the store, or None for a smaller one."""
        file = Path(self._store.object_path(name))
        try:
            if file.stat().st_size < least_bytes:
                return None
            for _ in self._store.blocks(name):
                pass
        except OSError:  # reading the whole object reports the error
            return None
        except MissingError:
            self(name, path)
        return file

    def __reduce__(self) -> tuple[Any, ...]:
        sizes = self._sizes if isinstance(self._sizes, Manifest) else dict(self._sizes)
        return _open_reader, (self._store.place, self._dataset_dirs, sizes)


def _open_reader(place: str, dataset_dirs: tuple[str, ...], sizes: Mapping[str, int] | Manifest) -> _Reader:
    return _Reader(open_store(place), dataset_dirs, sizes)


def reader(
    store: Store, dataset_dirs: tuple[str, ...] = (), sizes: Mapping[str, int] | Manifest = MappingProxyType({})
) -> Callable[[str, str], bytes]:
    """Return a function (digest, path in its dataset) -> content that repairs damaged objects.

    It reads from the store. Missing objects are adopted from ``dataset_dirs`` or recomputed from their record.
    ``sizes`` are the sizes in bytes that a manifest declares by digest, or the manifest; nothing much larger is read.
    Raises `DamagedError` if the object cannot be restored. The function can be pickled.
    """
    return _Reader(store, dataset_dirs, sizes)


def _adopt(store: Store, name: str, path: str, dataset_dirs: tuple[str, ...], size: int | None) -> bytes | None:
    """Return an intact copy of an object from ``dataset_dirs``, and store it; None if there is no copy."""
    content = paths.verified_copy(name, path, dataset_dirs, size)
    if content is not None:
        with contextlib.suppress(TacpipeError):  # a read-only store stays damaged; the intact copy is used
            store.prepare()
            store.put(content, durable=True)
    return content


def _remake(store: Store, name: str, path: str, problem: str, size: int | None = None) -> bytes:
    """Recompute an object by running a stage that made it, and return its content.

    Raises `DamagedError`, which starts with ``problem``, if no stage makes the object again, or if it is a recording.
    """
    obstacle = ""
    for identity, made_by in _makers(store, name):
        acquired = identity["stage"] == ACQUIRE
        if acquired or registry.load_step(identity["stage"]).source:
            raise DamagedError(
                f"{problem} It is the recording {path}, which cannot be recomputed: restore it with `tacpipe store pull`"
                f"{'' if acquired else ', or ingest it again'}."
            )
        stage = registry.load_step(identity["stage"])
        if stage.version != identity["version"]:
            obstacle = f"{identity['stage']} has version {stage.version} now, and it was made by {identity['version']}"
            continue
        key = digest(identity)
        if key in _remaking:  # the stage returns its input, so another stage created the object
            continue
        _remaking.add(key)
        try:
            with store.leases.hold(key, f"{identity['stage']}, for {path}"):
                if not store.has(name, size):  # otherwise another process has recomputed it
                    execute(WorkerTask(store.place, identity["stage"], identity, run=store.run), store, store)
        except TacpipeError as error:
            if error.exit_code != FAILED:
                raise
            obstacle = str(error)
            continue
        finally:
            _remaking.discard(key)
        if store.has(name, size):
            return store.read(name, size)
        differences = "; ".join(provenance.environment_differences(made_by, provenance.describe_provenance(0.0)))
        obstacle = (
            f"{identity['stage']} gave something else when it was run again ({differences or 'it depends on chance'})"
        )
    reason = obstacle or f"nothing in the store says how {path} was made"
    raise DamagedError(
        f"{problem} It cannot be recomputed: {reason}. Bring {path} with `tacpipe store pull`, or run the stage again."
    )


_remaking: set[str] = set()  # keys that this process is recomputing, possibly as inputs of one another
_Maker = tuple[StageIdentity, Provenance]
_makers_by_object: dict[str, dict[str, list[_Maker]]] = {}  # makers of the results with an object, by store and digest


def _makers(store: Store, name: str) -> list[_Maker]:
    """Return identity and provenance of the records that name an object. Reads all records once for many objects."""
    root = str(store.root)
    if name not in _makers_by_object.get(root, {}):
        _makers_by_object[root] = {}
        for _, record in store.records():
            identity = record["identity"]
            if "stage" in identity:
                for object_name in set(records.digests(record["result"])):
                    _makers_by_object[root].setdefault(object_name, []).append((identity, record["provenance"]))
    return _makers_by_object[root].get(name, [])


@contextmanager
def _arguments(stage: AnyStage, task: WorkerTask, store: Store) -> Iterator[dict[str, object]]:
    """Yield the stage's arguments by name, prepared from the identity.

    Raises `StorageError` at the end of the block if a source file changed meanwhile.
    """
    read = reader(store, task.dataset_dirs)
    inputs = task.identity["inputs"]
    arguments: dict[str, object] = {}
    for name, kind in stage.arguments.items():
        if kind == "Recording":
            arguments[name] = Recording(task.recording, inputs[name], read)
        elif kind in ("Dataset", "Model", "Parts"):
            store.fetch(_digests(inputs[name]) if inputs[name] is not None else ())
            arguments[name] = _dataset(inputs[name], read) if inputs[name] is not None else None
        elif kind == "Datasets":
            store.fetch(name for value in inputs[name] for name in _digests(value))
            arguments[name] = tuple(_dataset(value, read) for value in inputs[name])
        elif kind == "Fitted":
            arguments[name] = {file: read(value, file) for file, value in inputs[name].items()}
        elif kind == "Files":
            arguments[name] = {file: Path(path) for file, path in (task.files or {}).items()}
        elif kind in ("Trial", "Values", "RecordingName", "Rows"):
            arguments[name] = inputs[name]
        elif kind == "Shared":
            arguments[name] = SharedFiles(store) if store.run else None
        elif kind == "Roles":
            arguments[name] = _roles(inputs[name], read)
        else:
            arguments[name] = _prepare_workspace(store, digest(task.identity))
    yield arguments
    for file, path in (task.files or {}).items():
        if remembered_file_digest(path) != inputs[stage.argument("Files") or ""][file]:
            raise StorageError(f"{path} changed while it was read. Run the same command again.")


def _roles(identity: str | RolesIdentity | None, read: Reader) -> dict[tuple[str, int], str]:
    """Return the role by (recording, fold) in a split, given by its digest, or in one of its folds."""
    if identity is None:
        return {}
    if isinstance(identity, str):
        return selection.read_roles(read(identity, selection.SPLIT_FILE))
    folds = selection.read_roles(read(identity["roles"], selection.SPLIT_FILE))
    return {(recording, fold): role for (recording, fold), role in folds.items() if fold == identity["fold"]}


def workspace(store: Store, key: str) -> Path:
    """Return the folder with the checkpoints from which a key's training resumes."""
    return store.root / "checkpoints" / key


def _prepare_workspace(store: Store, key: str) -> Path:
    """Return the workspace of a training; it is created if needed, and checkpoints that other code wrote are deleted.

    Raises `StorageError` if it is a symbolic link.
    """
    folder = workspace(store, key)
    if folder.is_symlink():
        raise StorageError(f"{folder} is a symbolic link, and none is followed within a store. Remove it.")
    files.make_folder(folder)
    code_file, code = folder / _CODE, provenance.code_of_training().encode()
    try:
        stored = regular.content(code_file, follow=False)
    except (FileNotFoundError, TacpipeError):
        stored = b""
    if stored != code:
        checkpoints = [path for path in folder.iterdir() if path.name != _CODE]
        if checkpoints:
            log.warning("The checkpoint in %s was written by other code; training starts over.", folder)
        for path in checkpoints:
            path.unlink(missing_ok=True)
        store.write_file(code_file, code)
    return folder


def remove_workspace(store: Store, task: WorkerTask) -> None:
    """Remove the checkpoints of a finished training."""
    if "Workspace" in registry.load_step(task.name).arguments.values():
        shutil.rmtree(workspace(store, digest(task.identity)), ignore_errors=True)


def remove_empty_workspace(store: Store, key: str) -> None:
    """Remove the workspace of a training that saved no checkpoint."""
    folder = workspace(store, key)
    with contextlib.suppress(OSError):
        if {path.name for path in folder.iterdir()} <= {_CODE}:
            shutil.rmtree(folder)


@contextmanager
def _follow_training(name: str, stage: AnyStage, arguments: Mapping[str, Any]) -> Iterator[None]:
    """Report a stage's training to trackers and the display within the block, if it has a workspace."""
    workspace = arguments.get(stage.argument("Workspace") or "")
    if workspace is None:
        yield
        return
    from tacpipe.training import display, following

    with (
        display.followers_on_stderr(registry.stage_name(name), workspace) as displays,
        following.in_workspace(workspace, *displays),
    ):
        yield


@contextmanager
def watching(task: WorkerTask) -> Iterator[Sequence[following.Follower]]:
    """Yield the followers in this process of a training in another process; an empty list if the stage trains nothing."""
    if registry.load_step(task.name).argument("Workspace") is None:
        yield ()
        return
    from tacpipe.training import display, following

    store = open_store(task.store)
    # the workspace of a remote store is in the worker's folder
    local_workspace = None if store.distant else workspace(store, digest(task.identity))
    with display.followers_on_stderr(registry.stage_name(task.name), local_workspace) as displays:
        yield (*following.trackers(), *displays)


def _digests(value: DatasetIdentity) -> Iterator[str]:
    """Yield the digests of the shards and files of a dataset in an identity."""
    yield from (shard["digest"] for entry in value["recordings"].values() for shard in entry["shards"].values())
    yield from value["files"].values()


def _dataset(value: DatasetIdentity, read: Callable[[str, str], bytes]) -> Dataset:
    """Return a dataset without path from its part of a key."""
    lineage = value["lineage"]
    manifest = Manifest(
        stage=lineage["stage"],
        version=lineage["version"],
        params=lineage["params"],
        chain=lineage["chain"],
        recordings=value["recordings"],
        files={name: {"digest": file} for name, file in value["files"].items()},
    )
    return Dataset(manifest, read)


def _recording(name: str, returned: Any) -> RecordingOutput:
    """Return what a stage returned for a recording as a `RecordingOutput`.

    Raises `TacpipeError` if it has another type.
    """
    if isinstance(returned, RecordingOutput):
        return returned
    if hasattr(returned, "schema") or isinstance(returned, Mapping):
        return RecordingOutput(returned)
    raise TacpipeError(f"Stage {name} returned a {type(returned).__name__}; it should be a table, tables or files.")


def _files(name: str, returned: Any) -> Result:
    if isinstance(returned, Mapping):
        return Result(files=returned)
    raise TacpipeError(f"Stage {name} returned a {type(returned).__name__}; it should be a Result or files by name.")


def _entry(recording: RecordingOutput, sink: Store | ScratchStore, *, durable: bool) -> RecordingEntry:
    shards = {stream: _store_shard(table, sink, durable=durable) for stream, table in sorted(recording.streams.items())}
    return {"attributes": dict(sorted(recording.attributes.items())), "shards": shards}


def _store_shard(table: Any, sink: Store | ScratchStore, *, durable: bool) -> Shard:
    """Store a table, or batches as they arrive, as a shard."""
    from tacpipe.io import parquet

    if hasattr(table, "num_rows"):
        return {**sink.put(parquet.to_parquet(table), durable=durable).to_json(), "rows": table.num_rows}
    rows: list[int] = []
    stored = sink.put_written(lambda file: rows.append(parquet.write(table, file)), durable=durable)
    return {**stored.to_json(), "rows": rows[0]}
