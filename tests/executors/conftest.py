"""A Dask scheduler and workers in separate processes, because threads of this process would disturb other tests."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import Lab, Ran, tacpipe
from tests.executors import slurm_server

GIVE_UP_S = 300.0  # only what hangs takes so long


class Cluster:
    """A scheduler and workers as a lab starts them, in processes that a test may kill."""

    def __init__(self, folder: Path, **environment: str) -> None:
        self.folder, self.environment = folder, environment
        self.scheduler = self._start("scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0")
        self.address = self._wait_for_log("scheduler", r"Scheduler at:\s+tcp://(\S+)")
        self.workers: dict[str, subprocess.Popen[bytes]] = {}

    def work(self, name: str, *options: str) -> None:
        """Start a worker, a process that nobody starts again."""
        arguments = ("--nthreads", "1", "--no-nanny", "--name", name, "--memory-limit", "0", *options)
        self.workers[name] = self._start(name, "worker", f"tcp://{self.address}", *arguments)
        self._wait_for_log(name, r"Starting established connection to (tcp)")

    @property
    def executor(self) -> str:
        return f"dask://{self.address}"

    def close(self) -> None:
        for process in (*self.workers.values(), self.scheduler):
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
            process.wait()

    def _start(self, name: str, *words: str) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", **self.environment}
        with (self.folder / f"{name}.log").open("wb") as log:
            return subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{words[0]}", *words[1:], "--no-dashboard"],
                cwd="/",
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def _wait_for_log(self, name: str, pattern: str) -> str:
        """Return what a pattern finds in a process's log, once it is there."""
        began_s = time.monotonic()
        while time.monotonic() - began_s < GIVE_UP_S:
            match = re.search(pattern, (self.folder / f"{name}.log").read_text())
            if match:
                return match[1]
            time.sleep(0.05)
        raise AssertionError((self.folder / f"{name}.log").read_text())


class Apart(Lab):
    """A project whose commands that use Dask run in processes of their own: its threads and files would stay in this one."""

    def __init__(self, lab: Lab) -> None:
        super().__init__(lab.folder, self._call)
        self.inside = lab.call  # Commands run in this process where a test replaces something.

    def _call(self, command: str) -> Ran:
        if not re.search(r"--executor (dask|tls|slurm)", command):
            return self.inside(command)
        process = tacpipe(self.folder, command)
        return Ran(process.returncode, process.stdout, process.stderr)


@pytest.fixture
def lab(lab: Lab) -> Apart:
    """An empty project with the plug-in."""
    return Apart(lab)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory, plugin: Path) -> Iterator[str]:
    """The executor of two workers that find the plug-in of ``lab``."""
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    workers = Cluster(tmp_path_factory.mktemp("scheduler"), PYTHONPATH=str(plugin))
    workers.work("first")
    workers.work("second")
    yield workers.executor
    workers.close()


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory, lab: object) -> Iterator[Cluster]:
    """A scheduler without workers, which find the plug-in of ``lab``."""
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    workers = Cluster(tmp_path_factory.mktemp("cluster"))
    yield workers
    workers.close()


@pytest.fixture(scope="module")
def slurm_of_tests(plugin: Path) -> Iterator[dict[str, str]]:
    """The environment in which commands find a Slurm that runs, whose jobs find the plug-in of ``lab``."""
    pytest.importorskip("dask_jobqueue", reason="the extra slurm is not installed")
    if reason := slurm_server.lacking():
        pytest.skip(reason)
    with slurm_server.running() as environment:
        yield {**environment, "PYTHONPATH": str(plugin)}


@pytest.fixture
def slurm(slurm_of_tests: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> str:
    """The executor ``slurm`` of a Slurm that runs."""
    for name, value in slurm_of_tests.items():
        monkeypatch.setenv(name, value)
    return "slurm"
