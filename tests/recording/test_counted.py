"""Test that each number that a device counted is in the dataset once, in order, or is reported as lost.

The device and what compares are of this test's own: they share no code with tacpipe or its emulator, and read the dataset's
files with pyarrow alone.
"""

import itertools
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from tests.conftest import Lab
from tests.recording import counted_device

pytestmark = pytest.mark.rig
ROOT = Path(__file__).parents[2]
HANGS_S = 600.0
RIG = (
    counted_device.WIRE
    + """
[[stream]]
name = "net"
sensor = "generic"
transport = "udp::{port}?sender=127.0.0.1"

[stream.options]
rate_hz = 200
packets = true
numbers = [{{ name = "n", type = "u32" }}, {{ name = "value", type = "u16" }}]
sequence = {{ number = "n" }}
"""
)
# how long a device may take is as in all tests of this tier, but what counts as a stall is as for users
RUN = "from tests.recording import patient; import pytest, os, time; del patient.LIMITS['tacpipe.recording.pace'];"
RUN += "patient.relax(pytest.MonkeyPatch()); {change}; from tacpipe.cli import main as cli; cli.main()"
SLOW = "sync = os.fdatasync; os.fdatasync = lambda handle: (time.sleep(1.0), sync(handle))[1]"


@dataclass(frozen=True)
class Counting:
    """The device at work."""

    folder: Path
    rig: str

    def sends(self, count: int) -> None:
        """Wait until it has sent so many more."""
        until_s, target = time.monotonic() + HANGS_S, self.sent + count
        while self.sent < target:
            assert time.monotonic() < until_s, "the device hangs"
            time.sleep(0.01)

    @property
    def sent(self) -> int:
        """How many it has sent."""
        content = (self.folder / "sent").read_bytes() if (self.folder / "sent").exists() else b""
        return int(struct.unpack("<Q", content)[0]) if len(content) == 8 else 0


@pytest.fixture(scope="module")
def device(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Counting]:
    folder = tmp_path_factory.mktemp("counted")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-I", counted_device.__file__, str(port)]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        announced = json.loads(process.stdout.readline())
        yield Counting(folder, RIG.format(port=port, **announced))
        process.kill()


class Recorder:
    """A recording that runs in a process of its own, and has begun."""

    def __init__(self, lab: Lab, device: Counting, options: str = "", change: str = "pass") -> None:
        (lab.folder / "rig.toml").write_text(device.rig)
        words = [sys.executable, "-c", RUN.format(change=change), "acquire", "rig.toml", "-o", "rec", "--name", "one"]
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        self.process = subprocess.Popen(
            [*words, *options.split()],
            cwd=lab.folder,
            env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.lab, self.device = lab, device
        until_s = time.monotonic() + HANGS_S
        while not any(path.stat().st_size > 2000 for path in (lab.folder / ".tacpipe/spool").glob("*/bytes")):
            assert self.process.poll() is None and time.monotonic() < until_s, "nothing is recorded"
            time.sleep(0.01)

    def ends(self, number: signal.Signals, code: int = 0) -> None:
        """Send a signal, and wait until the process has ended so."""
        self.process.send_signal(number)
        _, err = self.process.communicate(timeout=HANGS_S)
        assert self.process.returncode == code, err


def record(lab: Lab, stream: str) -> tuple[list[int], dict[str, Any]]:
    """Return the numbers that a stream of the dataset holds, and its attributes; fails unless each value is the number's."""
    table = pq.read_table(lab.folder / "rec/one" / f"{stream}.parquet")
    numbers = table.column("seq").to_pylist()
    assert table.column("value").to_pylist() == [counted_device.value(number) for number in numbers]
    manifest = json.loads((lab.folder / "rec/manifest.json").read_text())
    return numbers, manifest["recordings"]["one"]["attributes"]


def events(lab: Lab) -> list[dict[str, Any]]:
    """Return the rows of what went wrong."""
    path = lab.folder / "rec/one/events.parquet"
    return pq.read_table(path).to_pylist() if path.exists() else []


def check(lab: Lab, min_count: int) -> None:
    """Fail unless each number from the first to the last is there once, in order, or is reported as lost by the network."""
    for stream in ("wire", "net"):
        numbers, attributes = record(lab, stream)
        assert len(numbers) >= min_count
        assert all(number < following for number, following in itertools.pairwise(numbers)), "out of order, or twice"
        missing = numbers[-1] - numbers[0] + 1 - len(numbers)
        assert missing == attributes[f"{stream}_lost"]
        assert missing == 0 or stream == "net", "the terminal loses nothing"


def test_a_recorder_that_was_stopped_has_every_number_and_says_which_are_late(lab: Lab, device: Counting) -> None:
    recorder = Recorder(lab, device)
    recorder.process.send_signal(signal.SIGSTOP)
    time.sleep(1.0)  # the shortest wait, however busy the computer is
    device.sends(200)
    recorder.process.send_signal(signal.SIGCONT)
    device.sends(100)
    recorder.ends(signal.SIGINT)

    check(lab, min_count=300)
    stalls = [event["stream"] for event in events(lab) if event["cause"] == "recorder_stalled"]
    assert set(stalls) == {"wire", "net"}
    wire, net = (pq.read_table(lab.folder / f"rec/one/{stream}.parquet") for stream in ("wire", "net"))
    uncertain_ns = wire.column("t_uncertain_ns").to_numpy()
    assert (uncertain_ns > 0).sum() >= 150 and uncertain_ns.max() > 0.9e9
    assert "t_uncertain_ns" not in net.column_names  # the kernel's stamps


def test_a_disk_that_is_slow_to_sync_costs_no_number(lab: Lab, device: Counting) -> None:
    recorder = Recorder(lab, device, change=SLOW)
    device.sends(400)
    recorder.ends(signal.SIGINT)

    check(lab, min_count=350)


def test_a_recorder_that_was_killed_leaves_every_number_up_to_then(lab: Lab, device: Counting) -> None:
    recorder = Recorder(lab, device, "--duration-s 1000")
    device.sends(200)
    recorder.ends(signal.SIGKILL, -signal.SIGKILL)
    lab.run("acquire --recover")

    check(lab, min_count=100)
    _, attributes = record(lab, "wire")
    assert (attributes["ended"], attributes["requested_duration_s"]) == ("recovered", 1000.0)
    assert [event["cause"] for event in events(lab) if not event["stream"]] == ["recovered"]


def test_a_recorder_whose_terminal_was_closed_has_every_number_up_to_then(lab: Lab, device: Counting) -> None:
    recorder = Recorder(lab, device, "--duration-s 1000")
    device.sends(200)
    recorder.ends(signal.SIGHUP)

    check(lab, min_count=150)
    assert record(lab, "wire")[1]["ended"] == "interrupted"
