"""Slurm jobs as workers, submitted for one command with the resources in Dask's configuration.

Account, partition, cores, memory, walltime and other directives are in the section ``jobqueue.slurm`` of Dask's
configuration, as documented by dask-jobqueue; ``slurm://PARTITION`` selects another partition. Each job is one worker.
Its connection is encrypted, with certificates created for the command.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tacpipe.engine.executors import dask as dask_workers
from tacpipe.engine.executors.local import SAFE_PATH
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.plugins import extras

if TYPE_CHECKING:
    from dask_jobqueue import SLURMCluster
    from distributed import Client, Security

JOBS = 4  # number of jobs without --jobs
CORES, MEMORY = 1, "4 GiB"  # resources of a job that Dask's configuration does not set
SECTION = "jobqueue.slurm"
# set to 1 in Dask's workers unless configured
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_POLL_S = 0.5
_SHOWN_S = 5.0  # a longer wait is reported


@contextlib.contextmanager
def connected(address: str, jobs: int) -> Iterator[dask_workers.Dask]:
    """Yield ``jobs`` workers (`JOBS` for 0), each a job in the partition ``address`` or in the configured one.

    Waits for the first worker; others join when Slurm starts them. The jobs are cancelled at the end of the block.
    Raises `TacpipeError` if jobs cannot be submitted or all end before one has started, and `MissingModuleError` if
    dask-jobqueue is not installed.
    """
    with extras.explain_missing("The executor slurm"), _restore_interrupts():
        import dask_jobqueue  # noqa: F401, I001  (first: what else is missing comes with it; it adds to Dask's configuration)
        import cryptography  # noqa: F401  (of the certificates)
        import dask
        from distributed import Client

    if not shutil.which("sbatch"):
        raise TacpipeError(
            "There is no sbatch on this computer: the executor slurm submits jobs from where Slurm's commands are "
            "installed, as on a login node."
        )
    jobs = jobs or JOBS
    with (
        dask_workers.quiet(),
        dask.config.set(dask_workers.NO_PAGES),
        tempfile.TemporaryDirectory(prefix="slurm-", dir=_shared_folder(dask.config)) as folder,
        _submit_jobs(address, jobs, _create_certificate(Path(folder)), Path(folder), dask.config) as cluster,
        Client(cluster, security=cluster.security, set_as_default=False) as client,  # type: ignore[no-untyped-call]
    ):
        _wait(client, _numbers(cluster), Path(folder))
        yield dask_workers.Dask(client, jobs)


@contextlib.contextmanager
def _restore_interrupts() -> Iterator[None]:
    """Restore the handler of Ctrl-C: importing dask-jobqueue replaces it by one that exits with code 0."""
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _shared_folder(config: Any) -> Path:
    """Return the shared folder for certificates and job output: the configured one, or one in the home directory."""
    configured = config.get(f"{SECTION}.shared-temp-directory")
    folder = Path(configured).expanduser() if configured else Path.home() / ".cache/tacpipe"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _create_certificate(folder: Path) -> Security:
    """Return a new certificate and key, in files that only their owner can read."""
    from distributed import Security

    temporary = Security.temporary()  # type: ignore[no-untyped-call]
    files = {}
    for field in ("tls_ca_file", "tls_client_key"):
        path = folder / field
        path.touch(mode=0o600)
        path.write_text(getattr(temporary, field))
        files[field] = str(path)
    certificate, key = files.values()
    roles = {
        f"tls_{role}_{kind}": path
        for role in ("client", "scheduler", "worker")
        for kind, path in (("cert", certificate), ("key", key))
    }
    return Security(require_encryption=True, tls_ca_file=certificate, **roles)  # type: ignore[no-untyped-call]


@contextlib.contextmanager
def _submit_jobs(address: str, jobs: int, security: Security, folder: Path, config: Any) -> Iterator[SLURMCluster]:
    """Submit ``jobs`` jobs, yield their cluster, and cancel them at the end of the block.

    Raises `TacpipeError` if Slurm refuses a job.
    """
    from dask_jobqueue import SLURMCluster

    def setting(name: str, default: Any) -> Any:
        value = config.get(f"{SECTION}.{name}")
        return default if value is None else value

    cores = setting("cores", CORES)
    cluster = SLURMCluster(
        queue=address or None,
        cores=cores,
        memory=setting("memory", MEMORY),
        processes=1,
        nanny=True,  # without it, a worker may hang when it closes
        # one task at a time on all cores of the job; Slurm limits the memory
        worker_extra_args=[*setting("worker-extra-args", []), "--nthreads", "1", "--memory-limit", "0"],
        job_script_prologue=[
            *setting("job-script-prologue", []),
            f"export {SAFE_PATH}=1",
            *(f"export {name}={cores}" for name in _THREADS),
        ],
        job_name="tacpipe",
        log_directory=str(folder),
        protocol="tls://",
        security=security,
        scheduler_options={"dashboard": False, "dashboard_address": ":0"},
        silence_logs=logging.CRITICAL,
    )

    async def submit() -> None:
        await cluster

    job_ids: Sequence[str] = ()
    try:
        while len(cluster.worker_spec) < jobs:  # like `scale`, which discards the output of sbatch
            cluster.worker_spec.update(cluster.new_worker_spec())
        try:
            cluster.sync(submit)
        except RuntimeError as error:
            raise TacpipeError(f"Slurm refused a job: {_reason(str(error))}") from error
        job_ids = _numbers(cluster)
        yield cluster
    finally:
        if job_ids:  # `close` waits for each worker, but an interrupted command must end within a second
            subprocess.run(["scancel", *job_ids], check=False, capture_output=True)
        with contextlib.suppress(Exception):
            cluster.close(timeout=None if job_ids else 1.0)  # the default timeout without a worker is 10 s


def _numbers(cluster: SLURMCluster) -> list[str]:
    """Return the numbers of the submitted jobs."""
    return [str(job.job_id) for job in cluster.workers.values() if job.job_id]


def _reason(text: str) -> str:
    r"""Return what sbatch printed, of an error of dask-jobqueue.

    >>> _reason("Exit code: 1\nCommand:\nsbatch x\nstdout:\n\nstderr:\nsbatch: error: invalid partition: x\n\n")
    'invalid partition: x'
    """
    printed = text.rpartition("stderr:")[2].strip().splitlines()
    return "; ".join(line.removeprefix("sbatch: ").removeprefix("error: ") for line in printed) or text


def _wait(client: Client, numbers: Sequence[str], folder: Path) -> None:
    """Wait until a job has started to work. Raises `TacpipeError` if all jobs end first."""
    began_s, is_noted = time.monotonic(), False
    while not client.scheduler_info(n_workers=-1)["workers"]:
        if not _are_jobs_active(numbers):
            raise TacpipeError(
                f"No job started to work: {', '.join(numbers)} ended at once. {_last_error_line(folder)} Jobs need Python "
                f"and tacpipe at the same paths as on this computer, and a way to reach it."
            )
        if not is_noted and time.monotonic() - began_s > _SHOWN_S:
            is_noted = True
            terminal.note(f"tacpipe: waiting for Slurm to start one of the jobs {', '.join(numbers)}")
        time.sleep(_POLL_S)


def _are_jobs_active(numbers: Sequence[str]) -> bool:
    """Return whether any of the jobs is pending or running; True if Slurm does not respond."""
    command = ["squeue", "--noheader", "--format=%T", "--jobs", ",".join(numbers)]
    queue = subprocess.run(command, check=False, capture_output=True, text=True)
    return queue.returncode != 0 or bool(queue.stdout.strip())


def _last_error_line(folder: Path) -> str:
    """Return the last line of a job's standard error as a sentence."""
    for file in sorted(folder.glob("*.err")):
        lines = file.read_text(errors="replace").strip().splitlines()
        if lines:
            return f"Its last line was: {lines[-1].strip()}."
    return "They printed nothing."
