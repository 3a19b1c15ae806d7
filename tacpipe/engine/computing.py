"""Compute the records of tasks: lease the key, run the stage, commit the result.

With a remote store, results are uploaded while other tasks are computed.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.datasets.manifest import VALUES, Manifest
from tacpipe.engine import execution, provenance
from tacpipe.engine.execution import ScratchStore
from tacpipe.engine.keys import Done, WorkerTask
from tacpipe.errors import TacpipeError, is_input_error
from tacpipe.io.hashing import digest
from tacpipe.plugins import registry
from tacpipe.plugins.stage import AnyStage
from tacpipe.store.location import open_store
from tacpipe.store.records import Provenance, StoredResult
from tacpipe.store.store import Store
from tacpipe.training import devices

if TYPE_CHECKING:
    from concurrent.futures import Future

MAX_PENDING = 8  # maximum number of tasks that wait for a remote store while one is computed
_MANY = 4  # minimum number of tasks for which threads are started


class _Computing:
    """Computes one task, or several with overlapping requests to a remote store."""

    def __call__(self, task: WorkerTask) -> Done:
        """Compute a task and return its outcome; a `TacpipeError` becomes a `Done` with its message."""
        store = open_store(task.store, task.run)
        try:
            return _compute_task(task, store)()
        finally:
            store.close()

    def compute_all(self, tasks: Sequence[WorkerTask]) -> Iterator[Done]:
        """Yield the outcome of each task in order.

        While a task is computed, the records of the next tasks are fetched from a remote store and results of earlier
        tasks are uploaded, because each request takes as long as a small recording.
        """
        stores: dict[tuple[str, str], Store] = {}
        for task in tasks:
            if (task.store, task.run) not in stores:
                stores[task.store, task.run] = open_store(task.store, task.run)
        pairs = [(task, stores[task.store, task.run]) for task in tasks]
        try:
            if len(tasks) >= _MANY and any(store.distant for store in stores.values()):
                yield from _overlap_tasks(pairs)
            else:
                for task, store in pairs:
                    yield _compute_task(task, store)()
        finally:
            for store in stores.values():
                store.close()


compute = _Computing()


def _overlap_tasks(tasks: Sequence[tuple[WorkerTask, Store]]) -> Iterator[Done]:
    """Yield the outcome of each task. Stages run only in this thread; other threads look up records and upload results."""
    from concurrent.futures import ThreadPoolExecutor  # not loaded for a cache hit

    pool = ThreadPoolExecutor(MAX_PENDING)
    lookups: deque[Future[None]] = deque()
    uploads: deque[Future[Done]] = deque()
    finishers: list[Callable[[], Done]] = []
    try:
        for task, store in tasks[:MAX_PENDING]:
            lookups.append(pool.submit(store.seek, digest(task.identity)))
        for index, (task, store) in enumerate(tasks):
            with contextlib.suppress(TacpipeError):  # the next access reports the error
                lookups.popleft().result()
            if index + MAX_PENDING < len(tasks):
                later, later_store = tasks[index + MAX_PENDING]
                lookups.append(pool.submit(later_store.seek, digest(later.identity)))
            finishers.append(_compute_task(task, store))
            uploads.append(pool.submit(finishers[-1]))
            while uploads and (uploads[0].done() or len(uploads) > MAX_PENDING):
                finishers.pop(0)
                yield uploads.popleft().result()
        while uploads:
            finishers.pop(0)
            yield uploads.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        for finish, future in zip(finishers, uploads, strict=False):
            if future.cancelled() and isinstance(finish, _Sending):
                finish.leases.close()


def _compute_task(task: WorkerTask, store: Store) -> Callable[[], Done]:
    """Compute the task unless its record is stored; return a function that stores the result and returns the outcome."""
    key = digest(task.identity)
    try:
        with ExitStack() as leases:
            with devices.use_device(task.device):
                outcome = _compute_result(task, store, key, leases)
            if isinstance(outcome, _Made):
                return _Sending(task, store, outcome, leases.pop_all())
    except TacpipeError as error:
        outcome = _failure(task, store, error)
    failure: Done = outcome
    return lambda: failure


def _failure(task: WorkerTask, store: Store, error: TacpipeError) -> Done:
    execution.remove_empty_workspace(store, digest(task.identity))
    return Done(task.recording, None, str(error), error.exit_code, at_fault=is_input_error(error))


@dataclass(frozen=True)
class _Made:
    """A stage's result whose content is stored, before its record is written."""

    result: StoredResult
    provenance: Provenance
    replace: bool  # whether an existing record refers to missing objects
    durable: bool


@dataclass(frozen=True)
class _Sending:
    """Commits a result when called, and then ends the leases."""

    task: WorkerTask
    store: Store
    computed: _Made
    leases: ExitStack

    def __call__(self) -> Done:
        task, store, computed = self.task, self.store, self.computed
        try:
            with self.leases:
                record = store.commit(
                    task.identity,
                    computed.result,
                    computed.provenance,
                    replace=computed.replace,
                    durable=computed.durable,
                )
                execution.remove_workspace(store, task)
        except TacpipeError as error:
            return _failure(task, store, error)
        return Done(task.recording, record)


def _compute_result(task: WorkerTask, store: Store, key: str, leases: ExitStack) -> Done | _Made:
    """Return the stored result of a task as `Done`, or compute a new one, which is still to be stored.

    A new result comes with the lease of ``key`` in ``leases``. The result of a dry task is never stored.
    """
    if task.dry:
        result, *_ = execution.execute(task, store, ScratchStore())
        return Done(task.recording, {"result": result, "provenance": provenance.describe_provenance(0.0)})
    leases.enter_context(store.leases.hold(key, f"{task.name} {task.recording}".strip()))
    record = store.record(key)
    if record is not None and not task.rerun and store.is_complete(record):
        return Done(task.recording, record, is_new=False)
    started = time.perf_counter()
    replace = task.replace or record is not None
    with registry.collect_packages() as packages:
        stage = registry.load_step(task.name)
        code = provenance.code(stage)  # read first, because the file may be edited while the stage runs
        result, notes, rows = execution.execute(task, store, store)
    origin: Provenance = {
        **provenance.describe_provenance(round(time.perf_counter() - started, 4)),
        "irreplaceable": stage.source is not None,
        "code": code,
        "packages": provenance.code_of_packages(task.identity, packages),
        "notes": notes,
    }
    if rows is not None:
        origin["rows"] = rows.to_json()
    if stage.source is not None:
        origin["columns"] = _stored_columns(store, result)
        # until a dataset's manifest exists, only the record marks this as a recording
        _single_manifest(task, stage, result).keep(store, durable=True)
    return _Made(result, origin, replace, stage.source is not None)


def _stored_columns(store: Store, result: StoredResult) -> dict[str, list[str]]:
    """Return the names of the columns of each stream of a recording that was just stored."""
    from tacpipe.io import parquet

    (entry,) = result["recordings"].values()
    return {
        stream: parquet.column_names(store.object_path(shard["digest"])) for stream, shard in entry["shards"].items()
    }


def _single_manifest(task: WorkerTask, stage: AnyStage, result: StoredResult) -> Manifest:
    """Return a manifest with one recording that was read from published files."""
    (entry,), inputs = result["recordings"].values(), task.identity["inputs"]
    files, values = inputs[stage.argument("Files") or ""], inputs.get(stage.argument("Values") or "")
    return Manifest(
        task.name,
        stage.version,
        task.identity["params"],
        recordings={task.recording: entry},
        sources={task.recording: {**files, **({VALUES: digest(values)} if values else {})}},
    )
