"""A folder in which one tool runs the chain of `steps`, and is done harm."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.promises.trust import steps

PROJECT = Path(__file__).parents[3]
RECORDINGS = tuple(f"rec-{number}" for number in range(8))
VICTIM = RECORDINGS[3]


@dataclass(frozen=True)
class Cell:
    """Outcome of a tool under a fault; ``good`` is None where the fault does not apply."""

    outcome: str
    good: bool | None

    def to_text(self) -> str:
        """Return the cell of the table."""
        return f"{ {True: 'holds', False: '**fails**', None: 'does not apply'}[self.good] }: {self.outcome}"


@dataclass(frozen=True)
class Done:
    """How a command ended, and what it printed."""

    code: int
    out: str
    err: str

    @property
    def printed(self) -> str:
        """Return its output of both streams."""
        return self.out + self.err


class Lab:
    """A folder with raw recordings, and what is right to come out of them."""

    def __init__(self, folder: Path, environment: dict[str, str], rows: int = 300) -> None:
        self.folder = folder
        self.log_path = folder.with_name(f"{folder.name}.log")
        paths = [str(PROJECT), environment.get("PYTHONPATH", "")]
        plain = {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": os.pathsep.join(paths)}
        self.environment = environment_of(**environment | plain | {steps.LOG: str(self.log_path)})
        (folder / "raw").mkdir(parents=True)
        draw = np.random.default_rng(0)
        self.raw = {name: draw.integers(0, 1 << 40, rows) for name in RECORDINGS}
        for name, values in self.raw.items():
            self.write_raw(name, values)

    def write_raw(self, name: str, values: np.ndarray) -> None:
        """Write the file of one recording as whoever records would."""
        path = self.folder / "raw" / f"{name}.txt"
        path.write_text("\n".join(map(str, values.tolist())))
        self.raw[name] = values

    def right(self, step: str, factor: int = 2) -> dict[str, object]:
        """Return what ``step`` should give."""
        times = 1 if step == "load" else factor
        if step == "total":
            return {name: int(values.sum()) * times for name, values in self.raw.items()}
        return {name: (values * times).tolist() for name, values in self.raw.items()}

    # ---- commands

    def start(self, words: Sequence[str], **variables: str) -> subprocess.Popen[str]:
        """Start a command, alone in its group of processes as a shell would."""
        return subprocess.Popen(
            list(words),
            cwd=self.folder,
            env={**self.environment, **variables},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )

    def run(self, words: Sequence[str], **variables: str) -> Done:
        """Run a command to its end."""
        return wait_until_finished(self.start(words, **variables))

    def must(self, words: Sequence[str], **variables: str) -> Done:
        """Run a command that has no reason to fail."""
        completed = self.run(words, **variables)
        if completed.code:
            raise RuntimeError(f"{' '.join(words)} completed with {completed.code}: {completed.printed}")
        return completed

    # ---- what the steps noted

    def computed(self, step: str) -> list[str]:
        """Return the recordings that ``step`` began to compute, as often as it did."""
        lines = self.log_path.read_text().splitlines() if self.log_path.exists() else []
        return [line.split()[1] for line in lines if line.split()[0] == step]

    # ---- a stage held up at work

    def start_gated(self, words: Sequence[str], step: str, when: str = "after") -> subprocess.Popen[str]:
        """Start a command and return once ``step`` waits before, or after, it has read the victim; the rest may go on."""
        process = self.start(words, **{steps.GATE: f"{step} {when} {VICTIM} {self._gate}"})
        deadline = time.monotonic() + steps.PATIENCE_S
        while not Path(f"{self._gate}.reached").exists():
            if time.monotonic() > deadline:
                raise RuntimeError(f"{step} did not begin in {steps.PATIENCE_S:g} s.")
            time.sleep(0.01)
        return process

    def open_gate(self) -> None:
        """Let go on what waits."""
        Path(f"{self._gate}.open").touch()

    @property
    def _gate(self) -> Path:
        return self.folder.with_name(f"{self.folder.name}-gate")

    def alive(self) -> list[int]:
        """Return the processes that work in this lab."""
        mark, processes = f"{steps.LOG}={self.log_path}".encode(), []
        for place in Path("/proc").glob("[0-9]*"):
            try:
                if mark in (place / "environ").read_bytes().split(b"\0"):
                    processes.append(int(place.name))
            except OSError:  # it ended, or is another user's
                continue
        return processes

    def wait_until_still(self, within_s: float) -> bool:
        """Return whether no process of this lab is left after so long."""
        deadline = time.monotonic() + within_s
        while self.alive() and time.monotonic() < deadline:
            time.sleep(0.05)
        return not self.alive()

    def files(self) -> set[Path]:
        """Return every file, relative to the folder."""
        return {path.relative_to(self.folder) for path in self.folder.rglob("*") if path.is_file()}


def wait_until_finished(process: subprocess.Popen[str]) -> Done:
    """Wait for a command's end, and only for its own: what it left running may hold its pipes."""
    try:
        out, err = process.communicate(timeout=steps.PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
        return Done(-9, out, f"{err}\nkilled after {steps.PATIENCE_S:g} s")
    return Done(process.returncode, out, err)


def environment_of(**variables: str) -> dict[str, str]:
    """Return the environment of this process without a named store, with this Python's programs first."""
    inherited = {name: value for name, value in os.environ.items() if name != "TACPIPE_STORE"}
    programs = f"{Path(sys.executable).parent}{os.pathsep}{inherited.get('PATH', '')}"
    return {**inherited, "PATH": programs, **variables}


def python(module: str, *words: str) -> list[str]:
    """Return the command that runs a module of this folder."""
    return [sys.executable, "-m", f"tests.promises.trust.{module}", *words]


def parse_mapping(text: str) -> dict[str, object]:
    """Return the mapping that a command printed, or none."""
    try:
        value = json.loads(text)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


# ---- harm


def edit_bit(path: Path) -> None:
    """Change one bit in the middle of a file in place; size, mode and time of change stay as they were."""
    before = path.stat()
    path.chmod(0o644)
    with path.open("r+b") as file:
        file.seek(before.st_size // 2)
        byte = file.read(1)[0]
        file.seek(before.st_size // 2)
        file.write(bytes([byte ^ 1]))
    path.chmod(before.st_mode)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def truncate(path: Path) -> None:
    """Cut a file to its first half."""
    mode = path.stat().st_mode
    path.chmod(0o644)
    os.truncate(path, path.stat().st_size // 2)
    path.chmod(mode)
