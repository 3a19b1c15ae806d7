"""A lab for tests: a project folder with its own store, the command line at hand, and a third party's plug-in."""

import fcntl
import functools
import gc
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from hypothesis import settings

from tacpipe.cli import main
from tacpipe.datasets import manifest, pages
from tacpipe.datasets.manifest import Manifest, find
from tacpipe.engine import provenance
from tacpipe.io import memory, terminal
from tacpipe.plugins import architectures, registry
from tacpipe.store.store import Store

ENTRY_POINTS = """
[tacpipe.stages]
simulate.toy = toy_stages:make
scale = toy_stages:scale
named = toy_stages:named
centre = toy_stages:centre
total = toy_stages:total
halves = toy_stages:halves
page = toy_stages:page

[tacpipe.formats]
numbers = toy_stages:read

[tacpipe.sensors]
pulse = toy_sensor:Pulse
"""

settings.register_profile("tacpipe", deadline=None, max_examples=40)  # nothing is timed in tests
settings.register_profile("faults", deadline=None, max_examples=500)  # `make test-faults` runs with it.
settings.load_profile("tacpipe")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # Under nohup, programs that the tests interrupt inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config: pytest.Config) -> None:
    gc.disable()  # until all is imported: what a collection makes stays, and looking through it takes seconds
    name_signals()


def pytest_collection_finish(session: pytest.Session) -> None:
    gc.freeze()
    gc.enable()


def name_signals() -> None:
    """Have a signal that would end this process print its name first: else a worker dies and nobody knows why."""
    error = os.dup(2)  # now: while tests run it is captured, and what is captured dies with the process

    def name(number: int, frame: FrameType | None) -> None:
        test = os.environ.get("PYTEST_CURRENT_TEST", "no test")
        message = f"\nprocess {os.getpid()} of pytest ends by {signal.Signals(number).name} in {test}:\n"
        os.write(error, (message + "".join(traceback.format_stack(frame, limit=4))).encode())
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)

    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGALRM, signal.SIGIO, signal.SIGUSR1, signal.SIGUSR2):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.SIG_IGN):  # `nohup` has SIGHUP ignored: tests send it
            signal.signal(number, name)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--every", default="1/1", help="K/N: of all chosen tests, run each Nth from the Kth; N: from the first."
    )
    parser.addoption("--faults", default="1/1", help="K/N: of those marked faults, run each Nth from the Kth.")


@pytest.hookimpl(trylast=True)  # The markers choose what runs first.
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    faults = [id(item) for item in items if item.get_closest_marker("faults")]
    deselected = left_out(faults, config.getoption("--faults"))
    deselected |= left_out([id(item) for item in items], config.getoption("--every"))
    config.hook.pytest_deselected(items=[item for item in items if id(item) in deselected])
    items[:] = [item for item in items if id(item) not in deselected]
    items.sort(
        key=lambda item: item.get_closest_marker("minutes") is None
    )  # last, they would keep one worker busy alone


def left_out(items: Sequence[int], part: str) -> set[int]:
    """Return those of the items that do not belong to a part ``K/N``, which is each Nth from the Kth; N alone is 1/N."""
    first, _, step = part.rpartition("/")
    return {item for number, item in enumerate(items, 1) if (number - int(first or 1)) % int(step)}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return a worker more than there are cores: tests of recording wait for devices while others compute."""
    return (os.cpu_count() or 1) + 1


@dataclass
class FileCalls:
    """The files that this process opened to read, and the names that it gave to files, since the last `clear`."""

    opened: list[str] = field(default_factory=list)
    named: list[str] = field(default_factory=list)

    def clear(self) -> None:
        """Forget the calls."""
        self.opened.clear()
        self.named.clear()

    def take(self, folder: str) -> int:
        """Return how many files in folders of this name were opened, and forget all calls."""
        count = sum(folder in Path(path).parts for path in self.opened)
        self.clear()
        return count


_traced: list[FileCalls] = []


@pytest.fixture(autouse=True)
def _visible_notes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Undo ``--quiet`` of commands that earlier tests ran in this process."""
    monkeypatch.setattr(terminal, "_quiet", False)


@pytest.fixture
def file_calls() -> Iterator[FileCalls]:
    """The calls of this process to open and rename files during the test."""
    _install_trace()
    calls = FileCalls()
    _traced.append(calls)
    yield calls
    _traced.remove(calls)


@functools.cache
def _install_trace() -> None:
    sys.addaudithook(_trace)  # it cannot be removed


def _trace(event: str, arguments: Sequence[Any]) -> None:
    for calls in _traced:
        if event == "open" and isinstance(arguments[0], str) and not arguments[2] & (os.O_WRONLY | os.O_RDWR):
            calls.opened.append(arguments[0])
        elif event == "os.rename":
            calls.named.append(os.fspath(arguments[1]))


@pytest.fixture
def few_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """All datasets of two recordings and more have pages, with two recordings in the mean, and none is remembered."""
    monkeypatch.setattr(pages, "INLINE", 1)
    monkeypatch.setattr(pages, "GROUPED", 2)
    monkeypatch.setattr(manifest, "_parsed", {})


@pytest.fixture
def eight_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """The system lets this process use eight cores, and its environment states no number of threads or processes."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    for name in (*provenance.THREADS, provenance.JOBS):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def leave_memory(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """A function that leaves so many bytes of memory to this process."""
    return lambda size: monkeypatch.setattr(memory, "available", lambda: size)


@pytest.fixture
def unbundled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages of results hold a mark in place of the library of charts, because bundling takes a second."""
    from tacpipe.report import page

    monkeypatch.setattr(page, "bundle", lambda: "/* library */")


@dataclass
class Ran:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


@dataclass
class Lab:
    """A project folder in which commands run."""

    folder: Path
    call: Callable[[str], Ran]

    def run(self, command: str) -> Ran:
        """Run a command that must succeed."""
        ran = self.call(command)
        assert ran.code == 0, f"{command} ended with {ran.code}: {ran.err}"
        return ran

    def run_json(self, command: str) -> Any:
        """Run a command that must succeed with ``--json``, and return the value that it prints."""
        return json.loads(self.run(f"{command} --json").out)

    def manifest(self, path: str) -> Manifest:
        """Return the manifest of a dataset."""
        return find(self.folder / path).manifest

    @property
    def store(self) -> Store:
        """The project's store."""
        return Store(self.folder / ".tacpipe")


def write_source(folder: str | Path, **texts: str) -> None:
    """Write a source of the format ``numbers``, one text of numbers per recording."""
    Path(folder).mkdir(exist_ok=True)
    for recording, text in texts.items():
        Path(folder, f"{recording}.txt").write_text(text)


def write_plugin(folder: Path, name: str, entry_points: str, **modules: str) -> None:
    """Write the modules and the metadata of a package into ``folder``, which then need only be on the path."""
    metadata = folder / f"{name}.egg-info"
    metadata.mkdir(parents=True, exist_ok=True)
    (metadata / "entry_points.txt").write_text(entry_points)
    for module, source in modules.items():
        (folder / f"{module}.py").write_text(source)


def sample_data() -> Path:
    """Return the folder in which published recordings are looked for."""
    configured = os.environ.get("TACPIPE_SAMPLE_DATA")
    return Path(configured) if configured else Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an installed plug-in with small stages."""
    folder = tmp_path_factory.mktemp("plugin")
    for name in ("toy_stages.py", "toy_sensor.py"):
        shutil.copy(Path(__file__).parent / "plugin" / name, folder)
    write_plugin(folder, "toy", ENTRY_POINTS)
    return folder


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[str], Ran]:
    """A function that runs a command in this process."""

    def run(command: str) -> Ran:
        capsys.readouterr()
        monkeypatch.setattr(sys, "argv", ["tacpipe", *shlex.split(command)])
        code = main.answer(sys.argv[1:])
        out, err = capsys.readouterr()
        return Ran(code, out, err)

    return run


def without_created_store(err: str) -> str:
    """Return what a command printed, without the line on the store that it created."""
    return "".join(line for line in err.splitlines(keepends=True) if not line.startswith("tacpipe: created the store "))


@pytest.fixture
def lab(tmp_path: Path, plugin: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[[str], Ran]) -> Iterator[Lab]:
    """An empty project, its commands run in this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TACPIPE_STORE", raising=False)
    monkeypatch.syspath_prepend(plugin)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(plugin), os.environ.get("PYTHONPATH", "")]))
    (tmp_path / ".tacpipe").mkdir()
    forget()
    yield Lab(tmp_path, call)
    forget()


@pytest.fixture(scope="module")
def chained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project in which the forward chain has run; tests may add to it, but change nothing that is there."""
    from tests import chain

    folder = tmp_path_factory.mktemp("chained") / "project"  # a module's own: no other's results lie in its store
    return shutil.copytree(make_once(tmp_path_factory, "chain", chain.run), folder, symlinks=True)


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that ``make`` fills, once for all workers that run tests: who comes second waits for it."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / f"made-{name}"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "whole").exists():
            shutil.rmtree(
                folder / "content", ignore_errors=True
            )  # An attempt that failed in another worker fails in this one too.
            (folder / "content").mkdir()
            make(folder / "content")
            (folder / "whole").touch()
    return folder / "content"


def forget() -> None:
    """Make the registry look again for what is installed."""
    registry.installed.cache_clear()
    registry.provider_of.cache_clear()
    registry.entry_points.cache_clear()
    registry.stages.cache_clear()
    architectures.kinds.cache_clear()


def tacpipe(folder: Path, command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    return run_python(folder, "-m", "tacpipe", *shlex.split(command), environment=environment)


def run_python(
    folder: Path, *arguments: str, environment: Mapping[str, str] | None = None, check: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run Python with these arguments in a process of its own, and keep what it prints."""
    command, variables = [sys.executable, *arguments], {**os.environ, **(environment or {})}
    return subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=check)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """An empty store in a folder."""
    prepared = Store(tmp_path / ".tacpipe")
    prepared.prepare()
    return prepared


@pytest.fixture
def toys(lab: Lab) -> Lab:
    """A project with three recordings of the toy simulation."""
    lab.run("simulate toy --trials 3 --rows 5 -o data/r")
    return lab
