"""Dask workers: those of a running scheduler, or processes on this computer that are started for one command.

``dask`` starts workers on this computer; ``dask://localhost:8786`` and ``tls://host:8786`` connect to a scheduler.
Anyone who can connect to a scheduler without TLS can run programs as its user, so schedulers on other computers must
use TLS. Certificates come from Dask's own configuration.

A worker needs tacpipe and access to the store. It receives keys, and reads and writes the store itself. If a worker
dies, Dask gives its tasks to another one; finished results are already in the store.
"""

from __future__ import annotations

import contextlib
import functools
import ipaddress
import logging
import multiprocessing
import os
import threading
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import replace
from multiprocessing import util
from pathlib import Path
from queue import Queue
from typing import TYPE_CHECKING, Any

from tacpipe.engine import execution, provenance
from tacpipe.engine.executors.local import compute_chunk, divide_into_chunks, without_working_directory
from tacpipe.engine.keys import Done, WorkerTask
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import terminal, termination
from tacpipe.io.hashing import digest
from tacpipe.plugins import extras, registry
from tacpipe.store import records
from tacpipe.store.location import open_store
from tacpipe.store.store import Store
from tacpipe.training import following

if TYPE_CHECKING:
    from distributed import Client, Future


def local_versions(stage: str) -> dict[str, str]:
    """Return the versions that must match for another process to compute a task of ``stage``.

    Raises `UsageError` if the stage does not exist.
    """
    stage_object = registry.load(registry.stage_name(stage))
    environment = provenance.describe_provenance(0.0)
    python = ".".join(environment["python"].split(".")[:2])
    code = provenance.code(stage_object)
    return {
        "Python": python,
        **environment["libraries"],
        f"stage {registry.stage_name(stage)}": f"version {stage_object.version}{f', code {code[:12]}' if code else ''}",
    }


def version_differences(local: Mapping[str, str], worker: Mapping[str, str]) -> list[str]:
    """Return phrases about the differences between a ``worker`` and this process.

    >>> version_differences({"Python": "3.11", "numpy": "2.1", "torch": "2.13"}, {"Python": "3.11", "numpy": "1.26"})
    ['numpy 1.26 (here 2.1)', 'no torch (here 2.13)']
    """
    return [
        f"{name} {worker[name]} (here {value})" if name in worker else f"no {name} (here {value})"
        for name, value in local.items()
        if worker.get(name) != value
    ]


NO_PAGES: dict[str, list[str]] = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
_MAX_BATCH = 50  # tasks per Dask task, which spreads its overhead of 1.6 ms
_CONNECT_S = 10
_POLL_S = 1.0
# clusters of an interrupted command, referenced so that nothing closes them
_abandoned: list[contextlib.ExitStack] = []


@contextlib.contextmanager
def connected(address: str, jobs: int) -> Iterator[Dask]:
    """Yield the workers of the scheduler at ``address`` (``host:port`` on this computer), or ``jobs`` newly started ones.

    Raises `UsageError` for a scheduler on another computer, `TacpipeError` if it does not respond, and
    `MissingModuleError` if Dask is not installed.
    """
    if not address:
        with _start_workers(jobs or provenance.jobs()) as workers:
            yield workers
        return
    if not _is_here(address):
        raise UsageError(
            f"dask://{address} is a scheduler without TLS on another computer. Anyone who reaches it can run "
            f"programs as its user. Start it with TLS and give tls://{address}, or give dask://localhost:PORT of an SSH "
            f"tunnel to it."
        )
    with _client(f"tcp://{address}") as client:
        yield Dask(client)


@contextlib.contextmanager
def encrypted(address: str, jobs: int) -> Iterator[Dask]:
    """Yield the workers of the scheduler at ``address``, connected with TLS. The scheduler sets the number of ``jobs``.

    Raises `UsageError` without an address or certificates, and the errors of `connected`, which has no TLS.
    """
    if not address:
        raise UsageError("The executor tls needs the address of a scheduler: give tls://HOST:PORT.")
    with extras.explain_missing("The executor tls"):
        from distributed import Security

    try:
        certified = Security().get_connection_args("client")["ssl_context"]  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise UsageError(
            f"tls://{address}: the certificates of Dask's configuration cannot be read: {error}."
        ) from error
    if certified is None:
        raise UsageError(
            f"tls://{address} needs certificates, and Dask's configuration has none. Name them there under "
            f"distributed.comm.tls: ca-file, client.cert and client.key."
        )
    with _client(f"tls://{address}") as client:
        yield Dask(client)


class Dask:
    """The workers that a Dask client is connected to."""

    def __init__(self, client: Client, expected: int = 0) -> None:
        """Wrap a client. ``expected`` is the number of workers if they do not all start at the same time."""
        self.client, self._expected = client, expected
        self._scheduler = str(client.scheduler_info(n_workers=0)["address"])

    def run(
        self, compute: Callable[[WorkerTask], Done], tasks: Sequence[WorkerTask], preload: Sequence[str]
    ) -> Iterator[Done]:
        """Yield ``compute(task)`` for every task, in any order.

        Raises `TacpipeError` if there is no worker, if a worker has other versions or cannot reach the store, if
        workers repeatedly die on a task, and if the scheduler is lost.
        """
        if not tasks:
            return
        versions = local_versions(tasks[0].name)
        workers = max(len(self._workers()), self._expected)
        task_chunks = [[_absolute(task) for task in chunk] for chunk in divide_into_chunks(tasks, workers, _MAX_BATCH)]
        summary = f"{len(tasks)} tasks were given to {workers} workers"
        with (
            self._follow_task(tasks) as topic,
            termination.reporting(
                f"tacpipe: interrupted; {summary}: those that wait are cancelled, those at work end."
            ),
        ):
            futures = [self.client.submit(_work, versions, compute, chunk, topic, pure=False) for chunk in task_chunks]
            store = open_store(tasks[0].store, tasks[0].run)
            try:
                for result in self._results(futures, tasks[0].name):
                    if result.record is not None:  # the worker also announces it, but only until the worker ends
                        store.announce(records.digests(result.record["result"]))
                    yield result
            finally:
                store.close()
                with contextlib.suppress(Exception):  # the scheduler forgets them anyway when the client disconnects
                    self.client.cancel(futures)  # type: ignore[no-untyped-call]

    @contextlib.contextmanager
    def _follow_task(self, tasks: Sequence[WorkerTask]) -> Iterator[str]:
        """Follow the training of a task in a worker. Yields the topic of its messages, "" without followers.

        Followers are called in a separate thread, because the client's thread must not wait for a tracker's server.
        """
        with contextlib.ExitStack() as stack:
            followers = stack.enter_context(execution.watching(tasks[0])) if len(tasks) == 1 else ()
            if not followers:
                yield ""
                return
            topic = f"tacpipe-{uuid.uuid4().hex}"
            messages: Queue[following.TrainingMessage | None] = Queue()
            thread = threading.Thread(target=_pass_messages, args=(messages, followers), daemon=True)
            thread.start()
            self.client.subscribe_topic(topic, lambda event: messages.put(event[1]))  # type: ignore[no-untyped-call]
            try:
                yield topic
            finally:
                with contextlib.suppress(Exception):  # the scheduler may be lost
                    self.client.unsubscribe_topic(topic)  # type: ignore[no-untyped-call]
                messages.put(None)
                thread.join()

    def _workers(self) -> Collection[str]:
        """Return the addresses of the workers. Raises `TacpipeError` if there is none."""
        workers: Collection[str] = self.client.scheduler_info(n_workers=-1)["workers"]
        if not workers:
            raise TacpipeError(
                f"The scheduler at {self._scheduler} has no worker. Start some, for example with `dask worker "
                f"{self._scheduler} --nthreads 1`."
            )
        return workers

    def _results(self, futures: Sequence[Future[Any]], stage: str) -> Iterator[Done]:
        """Yield the results of each chunk when it is finished. Raises the errors of `run`."""
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        try:
            for future in as_completed(futures, loop=self.client.loop):  # type: ignore[no-untyped-call]
                if future.status == "error":
                    raise future.exception()
                results = future.result()
                if isinstance(results, Exception):
                    raise results
                yield from results
                future.release()
        except KilledWorker as error:
            raise TacpipeError(
                f"{error.allowed_failures + 1} workers died one after another on the same recordings of {stage}, most "
                f"likely for lack of memory. Finished results are kept: run the same command again on workers with "
                f"more memory."
            ) from error
        except CancelledError as error:
            raise TacpipeError(
                f"The scheduler at {self._scheduler} is gone. Finished results are kept: run the same command again."
            ) from error
        except ModuleNotFoundError as error:
            raise TacpipeError(
                f"A worker cannot import {error.name}: install tacpipe and the plug-ins of {stage} there, as here."
            ) from error


@contextlib.contextmanager
def _start_workers(workers: int) -> Iterator[Dask]:
    """Yield single-threaded worker processes on this computer that end with the block or with this process."""
    with extras.explain_missing("The executor dask"):
        import cryptography  # noqa: F401  (TLS of one command's own: other users of this computer reach its port)
        import dask
        from distributed import Client, LocalCluster, Security

    security = Security.temporary()  # type: ignore[no-untyped-call]
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(quiet())
            stack.enter_context(without_working_directory())
            stack.enter_context(dask.config.set(NO_PAGES))
            cluster = stack.enter_context(
                LocalCluster(  # type: ignore[no-untyped-call]
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    protocol="tls",
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    memory_limit=0,
                    scheduler_kwargs={"dashboard": False},
                    silence_logs=logging.CRITICAL,
                    security=security,
                )
            )
            yield Dask(stack.enter_context(Client(cluster, security=security, set_as_default=False)))  # type: ignore[no-untyped-call]
        except RuntimeError as error:
            if "failed to start" not in str(error):  # of distributed, which omits the cause
                raise
            cause: BaseException = error
            while earlier := cause.__cause__ or cause.__context__:
                cause = earlier
            raise TacpipeError(
                f"Dask's workers do not start: {cause}. They need /dev/shm and a folder for temporary files that can be "
                f"written. Or leave out --executor dask."
            ) from error
        except KeyboardInterrupt:
            if termination.requested():  # closing the cluster takes seconds, and this process is ending
                _abandoned.append(stack.pop_all())
                for process in multiprocessing.active_children():
                    process.kill()
                util._run_finalizers(0)  # type: ignore[attr-defined]  # else Python reports semaphores of the workers as leaked
            raise


@contextlib.contextmanager
def _client(address: str) -> Iterator[Client]:
    """Yield a client of the scheduler at ``address`` (``protocol://host:port``).

    Raises `UsageError` if the address is invalid, `TacpipeError` if no scheduler responds.
    """
    host, _, port = address.partition("://")[2].rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise UsageError(f"{address} is not the address of a scheduler; it needs host and port, as localhost:8786.")
    with extras.explain_missing("The executor dask"):
        from distributed import Client

    with quiet():
        try:
            client = Client(  # type: ignore[no-untyped-call]
                address, timeout=_CONNECT_S, set_as_default=False, name="tacpipe"
            )
        except (OSError, TimeoutError, ValueError, RuntimeError, TypeError) as error:
            raise TacpipeError(f"No scheduler of Dask answers at {address}: {error}") from error
        with client:
            yield client


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence Dask's log within the block; lost workers and schedulers are reported as errors of tacpipe."""
    dask_names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
    loggers = [logging.getLogger(name) for name in ("asyncio", "tornado.application", *dask_names)]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def _is_here(address: str) -> bool:
    """Return whether a scheduler's address is on this computer.

    >>> _is_here("localhost:8786"), _is_here("127.0.0.1:8786"), _is_here("[::1]:8786"), _is_here("10.0.0.7:8786")
    (True, True, True, False)
    """
    host = address.rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _absolute(task: WorkerTask) -> WorkerTask:
    """Return the task with absolute paths, which are valid in other processes."""
    if task.files is None:
        return task
    return replace(task, files={name: str(Path(path).absolute()) for name, path in task.files.items()})


def _pass_messages(messages: Queue[following.TrainingMessage | None], followers: Sequence[following.Follower]) -> None:
    """Call followers with each message until None arrives."""
    receiver = following.Receiver(followers)
    while (message := messages.get()) is not None:
        receiver.take(message)
    receiver.close()


# ---- in a worker

_one_at_a_time = threading.Lock()  # a process computes one task at a time, whatever its number of threads
_leases: dict[str, str] = {}  # this worker's leases by the lease of their run


def _work(
    versions: Mapping[str, str], compute: Callable[[WorkerTask], Done], tasks: Sequence[WorkerTask], topic: str
) -> list[Done] | Exception:
    """Return ``compute`` of each task, or the error that prevented it. Progress of trainings is published on ``topic``."""
    from distributed import get_worker

    worker = get_worker()
    name = str(worker.name)
    senders = [following.Sender(functools.partial(worker.log_event, topic))] if topic else []
    with _one_at_a_time, terminal.showing_progress(False), provenance.worker(name), following.track_with(senders):
        try:
            _check(name, versions, tasks[0])
            lease = _lease(tasks[0])
        except TacpipeError as error:
            return error
        return compute_chunk(compute, [replace(task, run=lease) for task in tasks])


def _check(name: str, versions: Mapping[str, str], task: WorkerTask) -> None:
    """Raise an error if this worker would compute other results, or does not reach the store of the client."""
    differences = version_differences(versions, local_versions(task.name))
    if differences:
        raise UsageError(
            f"Worker {name} would compute other results than this computer: {'; '.join(differences)}. Install the "
            f"same there."
        )
    store = open_store(task.store)
    if store.distant:  # opened by its address, with this worker's own credentials
        try:
            store.record(digest(task.identity))
        except TacpipeError as error:
            raise TacpipeError(f"Worker {name} does not reach the store: {error}") from error
    elif task.run and not _is_run_alive(task.run):
        raise TacpipeError(
            f"Worker {name} does not find the store {task.store} as this command sees it, or the command has ended: workers "
            f"need the store at the same path, as on a shared file system."
        )


def _is_run_alive(run: str) -> bool:
    """Return whether the command that started a run is still running, according to its lease."""
    return os.path.exists(run)  # noqa: PTH110


def _lease(task: WorkerTask) -> str:
    """Return a lease of this worker that announces the objects it creates while the task's run is active.

    Two computers never write to one lease, because on a network file system one would overwrite the other's entries. In
    a bucket the client has announced the keys, so no lease is needed.
    """
    if open_store(task.store).distant:
        return ""
    if not task.run or task.run in _leases:
        return _leases.get(task.run, "")
    lease_paths: Queue[str] = Queue()
    threading.Thread(target=_hold_lease, args=(Store(task.store), task.run, lease_paths), daemon=True).start()
    _leases[task.run] = lease_paths.get()
    return _leases[task.run]


def _hold_lease(store: Store, run: str, lease_paths: Queue[str]) -> None:
    """Hold a lease until a run has ended. Puts the lease's path into ``lease_paths``."""
    run_ended = threading.Event()
    with store.leases.running() as announcing:
        lease_paths.put(announcing.path)
        while _is_run_alive(run):
            run_ended.wait(_POLL_S)
        with _one_at_a_time:
            del _leases[run]
