"""Follow a training while it runs: a growing file, the terminal, trackers. None of them changes the result.

A stage with a workspace is run within `in_workspace`; the loop calls `network` for each network that it trains there.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import NotRequired, Protocol, TypedDict

from tacpipe.io import terminal, termination

HISTORY = "history.jsonl"


def read_history(content: bytes) -> list[Line]:
    """Return the lines of a history file."""
    return [json.loads(line) for line in content.splitlines() if line.strip()]


def history_bytes(history: Iterable[Line]) -> bytes:
    """Return the content of a history file: one JSON line per epoch."""
    return "".join(json.dumps(line) + "\n" for line in history).encode()


class NetworkLabels(TypedDict, total=False):
    """Names of a network in its lines, where a stage trains several."""

    target: str
    network: int


class Validated(TypedDict):
    """Results of a validation: the loss, and of joint training those of each sensor."""

    val_loss: float
    alignment: NotRequired[float | None]
    train: NotRequired[dict[str, dict[str, float | None]]]  # sensor to the mean of each part of the training loss
    val: NotRequired[dict[str, dict[str, float]]]  # sensor to the validation accuracy and the parts of its loss


class Line(Validated, NetworkLabels):
    """One line of the history: the results of an epoch, as JSON holds them."""

    epoch: int  # from 1
    train_loss: float
    best: NotRequired[bool]  # true if a part of the model was never as good before


@dataclass(frozen=True)
class TrainedNetwork:
    """One of the networks that a stage trains: which it is, and how long it may take."""

    epochs: int  # upper limit
    number: int = 1
    count: int = 1
    labels: NetworkLabels = field(default_factory=NetworkLabels)  # are added to each of its lines

    @property
    def name(self) -> str:
        """Its number among several, or empty if it is the only one."""
        return f"network {self.number} of {self.count}" if self.count > 1 else ""


class Follower(Protocol):
    """Receive calls as a training proceeds."""

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Begin to follow the training of a network; ``history`` are its epochs before an interruption."""

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Follow a batch that was learned; ``passed`` is the fraction of the epoch, ``loss`` returns the mean so far."""

    def line(self, line: Line, learning_rate: float) -> None:
        """Follow an epoch that is over and whose checkpoint is written."""

    def end(self, *, trained: bool) -> None:
        """End: the network is trained, or an error or a user ended its training."""


@dataclass(frozen=True)
class Followers:
    """Several as one."""

    followers: Sequence[Follower] = ()

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Call ``batch`` of each."""
        for follower in self.followers:
            follower.batch(passed, loss)

    def line(self, line: Line, learning_rate: float) -> None:
        """Call ``line`` of each."""
        for follower in self.followers:
            follower.line(line, learning_rate)


_trackers: ContextVar[tuple[Follower, ...]] = ContextVar("trackers", default=())  # trackers of the command
_current: ContextVar[tuple[Follower, ...]] = ContextVar("followers", default=())  # followers of the stage that runs


@contextlib.contextmanager
def tracked(trackers: Sequence[Follower]) -> Iterator[None]:
    """Have each training in the block followed by ``trackers`` too."""
    before = _trackers.set(tuple(trackers))
    try:
        yield
    finally:
        _trackers.reset(before)


@contextlib.contextmanager
def in_workspace(workspace: Path, *displays: Follower) -> Iterator[None]:
    """Have a file in ``workspace``, ``displays`` and the command's trackers follow each training in the block."""
    file = _HistoryFile(workspace / HISTORY)
    before = _current.set((file, *_trackers.get(), *displays))
    try:
        yield
    finally:
        _current.reset(before)
        file.close()


def trackers() -> tuple[Follower, ...]:
    """Return the trackers of the block."""
    return _trackers.get()


@contextlib.contextmanager
def network(described: TrainedNetwork, history: Sequence[Line]) -> Iterator[Followers]:
    """Yield the followers of a network that is trained in the block."""
    followers, trained = _current.get(), False
    for follower in followers:
        follower.begin(described, history)
    try:
        yield Followers(followers)
        trained = True
    finally:
        for follower in followers:
            follower.end(trained=trained)


@contextlib.contextmanager
def resumable(network: TrainedNetwork, epochs_trained: int) -> Iterator[None]:
    """Have an interrupt of the epoch in the block stated with the epoch that the same command resumes from."""
    name = f" of {network.name}" if network.name else ""
    epoch = f"epoch {epochs_trained + 1} of {network.epochs}"
    sentence = f"tacpipe: interrupted; the same command resumes training{name} from {epoch}."
    with termination.reporting(sentence if epochs_trained else termination.SENTENCE):
        yield


class _HistoryFile:
    """The lines of all networks of a stage as JSON lines, for ``tail -f``; a failure to write it ends no training."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._handle: int | None = None
        self._labels: NetworkLabels = {}
        self._failed = False

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        self._labels = network.labels
        if self._handle is None and not self._failed:
            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
            with self._forgiven():
                self._handle = os.open(self._path, flags, 0o666)
        for line in history:
            self.line(line, 0.0)

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        pass

    def line(self, line: Line, learning_rate: float) -> None:
        if self._handle is not None:
            with self._forgiven():
                os.write(self._handle, history_bytes([{**line, **self._labels}]))

    def end(self, *, trained: bool) -> None:
        pass

    def close(self) -> None:
        """Close the file, and remove one without a line: a workspace in which nothing was saved is removed."""
        if self._handle is not None:
            with self._forgiven():
                if not os.fstat(self._handle).st_size:
                    self._path.unlink()
            os.close(self._handle)
            self._handle = None

    @contextlib.contextmanager
    def _forgiven(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if not self._failed:
                terminal.report_progress(
                    f"{self._path} cannot be written ({error.strerror}); training continues without it."
                )
            self._failed = True


BATCH_S = 0.5  # least time between two messages about batches: each reads the loss


class NetworkFields(TypedDict):
    """The fields of `TrainedNetwork`."""

    epochs: int
    number: int
    count: int
    labels: NetworkLabels


class TrainingMessage(TypedDict, total=False):
    """A call of a follower as JSON: ``begin`` and ``history``, ``batch`` and ``loss``, ``line`` and its rate, or ``end``."""

    begin: NetworkFields
    history: list[Line]
    batch: float
    loss: float
    line: Line
    learning_rate: float
    end: bool


class Sender:
    """A follower that sends what it is called with."""

    def __init__(self, send: Callable[[TrainingMessage], None]) -> None:
        self._send, self._sent_s = send, time.monotonic()

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Send which network is trained, and its epochs before an interruption."""
        fields = NetworkFields(epochs=network.epochs, number=network.number, count=network.count, labels=network.labels)
        self._send({"begin": fields, "history": list(history)})

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Send how far an epoch is, every half second at most."""
        now_s = time.monotonic()
        if now_s - self._sent_s >= BATCH_S:
            self._sent_s = now_s
            self._send({"batch": passed, "loss": loss()})

    def line(self, line: Line, learning_rate: float) -> None:
        """Send an epoch."""
        self._send({"line": line, "learning_rate": learning_rate})

    def end(self, *, trained: bool) -> None:
        """Send that the network is trained, or was ended."""
        self._send({"end": trained})


class Receiver:
    """Calls followers as messages come.

    Where a worker died, another one begins the network again: epochs that the followers have are not given twice.
    """

    def __init__(self, followers: Sequence[Follower]) -> None:
        self._followers = followers
        self._network: TrainedNetwork | None = None
        self._epochs = 0  # epochs of the network that the followers have received

    def take(self, message: TrainingMessage) -> None:
        """Call the followers with what a message holds."""
        if "begin" in message:
            self._begin(TrainedNetwork(**message["begin"]), message["history"])
        elif "batch" in message:
            for follower in self._followers:
                follower.batch(message["batch"], lambda: float(message["loss"]))
        elif "line" in message:
            self._line(message["line"], message["learning_rate"])
        elif message["end"]:  # else another process may continue the training
            self._end(trained=True)

    def close(self) -> None:
        """End a network that was not trained to its end."""
        if self._network is not None:
            self._end(trained=False)

    def _begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        if network == self._network:
            for line in history:
                self._line(line, 0.0)
            return
        self._network, self._epochs = network, len(history)
        for follower in self._followers:
            follower.begin(network, history)

    def _line(self, line: Line, learning_rate: float) -> None:
        if line["epoch"] <= self._epochs:
            return
        self._epochs = line["epoch"]
        for follower in self._followers:
            follower.line(line, learning_rate)

    def _end(self, *, trained: bool) -> None:
        self._network = None
        for follower in self._followers:
            follower.end(trained=trained)
