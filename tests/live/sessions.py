"""Live sessions in separate processes, with the messages of subscribers and the recordings."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tests.conftest import Lab
from tests.recording import live

MODULES = (b"tacpipe.live.process", b"tests.live.persistent")  # modules that a model's process runs

# commands that train a small forecaster, models/f, on simulated recordings
TRAINED = (
    "simulate forward --trials 4 --duration-s 4 --robot-rate-hz 200 -o data/r",
    "synchronize data/r -o data/synced",
    "segment contacts data/synced -o data/c",
    "split data/c -o data/split --scheme random --val 0.25 --calibration 0.25 --test 0",
    "train forward data/c --split data/split -o models/f --architecture gru --hidden 4 --epochs 1 --context 3 --horizon 2",
)

# The command that gives it quantiles: models/g
CALIBRATED = "calibrate models/f data/c --split data/split -o models/g"


def started(lab: Lab, options: str, behaviour: str = "") -> subprocess.Popen[str]:
    """Return ``tacpipe live`` with a model that predicts no change, running in a process of its own."""
    words = [sys.executable, "-m", "tests.live.persistent", "live", "rig.toml", "--model", "none", *options.split()]
    path = os.pathsep.join([str(live.ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "BEHAVIOUR": behaviour}
    return subprocess.Popen(
        words, cwd=lab.folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def commanded(lab: Lab, command: str) -> subprocess.Popen[str]:
    """Return ``tacpipe`` with a command in a lab, in a process of its own whose limits suit a busy computer."""
    return subprocess.Popen(
        [sys.executable, "-m", "tests.recording.patient", *command.split()],
        cwd=lab.folder,
        env={**os.environ, "PYTHONPATH": str(live.ROOT)},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def await_from(process: subprocess.Popen[str], condition: Callable[[], Any]) -> None:
    """Wait until a condition holds while a session runs. If it ends before, fail with what it printed."""

    def holds() -> bool:
        assert process.poll() is None, process.communicate()
        return bool(condition())

    live.awaited(holds)


def model_process(session: subprocess.Popen[str]) -> int:
    """Return the number of a session's process that runs the model."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            words = (folder / "cmdline").read_bytes()
        except (OSError, ValueError):
            continue
        if parent == session.pid and any(module in words for module in MODULES):
            return int(folder.name)
    raise AssertionError("the session has no process of a model")


def ended(process: subprocess.Popen[str], *, interrupt: bool = False) -> dict[str, Any]:
    """Return what a session printed as JSON, once it is over."""
    if interrupt:
        process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert process.returncode == 0 and "Traceback" not in err, err
    printed: dict[str, Any] = json.loads(out)
    return printed


@contextmanager
def subscriber() -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """Yield the port of a subscriber, and the messages that it got so far."""
    messages: list[dict[str, Any]] = []
    over = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        port.bind(("127.0.0.1", 0))
        port.settimeout(0.1)

        def listen() -> None:
            while not over.is_set():
                try:
                    messages.append(json.loads(port.recv(1 << 16)))
                except TimeoutError:
                    continue

        listening = threading.Thread(target=listen)
        listening.start()
        try:
            yield port.getsockname()[1], messages
        finally:
            over.set()
            listening.join()


def forecasts(messages: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [message for message in messages if message["kind"] == "forecast" and message["values"] is not None]


def whole(shard: Any, name: str) -> bool:
    """Return whether no sample of a stream was lost on its way into the recording."""
    counts = shard.table(name).column("seq").to_numpy()
    return bool((np.diff(counts) == 1).all()) and shard.attributes[f"{name}_lost"] == 0
