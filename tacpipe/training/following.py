"""Report the progress of a training to its followers: a history file, the terminal, trackers.

They do not affect the result.

A stage with a workspace runs inside `in_workspace`; the training loop calls `network` for each network that it trains.
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
from tacpipe.io.files import create

HISTORY = "history.jsonl"


def read_history(content: bytes) -> list[Line]:
    """Parse the lines of a history file."""
    return [json.loads(line) for line in content.splitlines() if line.strip()]


def history_bytes(history: Iterable[Line]) -> bytes:
    """Return the content of a history file: one JSON line per epoch."""
    return "".join(json.dumps(line) + "\n" for line in history).encode()


class NetworkLabels(TypedDict, total=False):
    """Labels of a network in its lines, if a stage trains several."""

    target: str
    network: int


class Validated(TypedDict):
    """Results of a validation: the loss and, for joint training, those of each sensor."""

    val_loss: float
    alignment: NotRequired[float | None]
    train: NotRequired[dict[str, dict[str, float | None]]]  # sensor -> mean of each part of the training loss
    val: NotRequired[dict[str, dict[str, float]]]  # sensor -> validation accuracy and the parts of its loss


class Line(Validated, NetworkLabels):
    """One line of the history file: the results of an epoch."""

    epoch: int  # from 1
    train_loss: float
    best: NotRequired[bool]  # true if a part of the model improved


@dataclass(frozen=True)
class TrainedNetwork:
    """One of the networks that a stage trains."""

    epochs: int  # maximum number of epochs
    number: int = 1
    count: int = 1
    # labels that are added to each line of the network's history
    labels: NetworkLabels = field(default_factory=NetworkLabels)

    @property
    def name(self) -> str:
        """Its number among several, or empty if it is the only one."""
        return f"network {self.number} of {self.count}" if self.count > 1 else ""


class Follower(Protocol):
    """Receive calls during a training."""

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Start following the training of a network; ``history`` contains its epochs before an interruption."""

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Receive a trained batch; ``passed`` is the fraction of the epoch, ``loss`` returns the mean loss so far."""

    def line(self, line: Line, learning_rate: float) -> None:
        """Receive the line of a completed epoch, after its checkpoint is written."""

    def end(self, *, trained: bool) -> None:
        """Stop following: the network is trained, or an error or a user ended the training."""


@dataclass(frozen=True)
class Followers:
    """Forward calls to several followers."""

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
_current: ContextVar[tuple[Follower, ...]] = ContextVar("followers", default=())  # followers of the running stage


@contextlib.contextmanager
def track_with(trackers: Sequence[Follower]) -> Iterator[None]:
    """Add ``trackers`` to the followers of each training in the block."""
    before = _trackers.set(tuple(trackers))
    try:
        yield
    finally:
        _trackers.reset(before)


@contextlib.contextmanager
def in_workspace(workspace: Path, *displays: Follower) -> Iterator[None]:
    """Let the history file in ``workspace``, ``displays`` and the command's trackers follow each training in the block."""
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
def follow_network(described: TrainedNetwork, history: Sequence[Line]) -> Iterator[Followers]:
    """Report to the followers that a network is trained in the block, yield them, and report whether it finished."""
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
def announce_resume(network: TrainedNetwork, epochs_trained: int) -> Iterator[None]:
    """If the block is interrupted, print the epoch from which the same command resumes."""
    name = f" of {network.name}" if network.name else ""
    epoch = f"epoch {epochs_trained + 1} of {network.epochs}"
    sentence = f"tacpipe: interrupted; the same command resumes training{name} from {epoch}."
    with termination.reporting(sentence if epochs_trained else termination.SENTENCE):
        yield


class _HistoryFile:
    """Write the lines of all networks of a stage to a JSON lines file, for ``tail -f``.

    A write error does not stop a training.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._handle: int | None = None
        self._labels: NetworkLabels = {}
        self._failed = False

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Open the history file, unless an earlier network did, and write the lines of a resumed training."""
        self._labels = network.labels
        if self._handle is None and not self._failed:
            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
            with self._tolerate_errors():
                self._handle = create(self._path, flags)
        for line in history:
            self.line(line, 0.0)

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        pass

    def line(self, line: Line, learning_rate: float) -> None:
        if self._handle is not None:
            with self._tolerate_errors():
                os.write(self._handle, history_bytes([{**line, **self._labels}]))

    def end(self, *, trained: bool) -> None:
        pass

    def close(self) -> None:
        """Close the file, and delete it if it is empty, so that an empty workspace can be removed."""
        if self._handle is not None:
            with self._tolerate_errors():
                if not os.fstat(self._handle).st_size:
                    self._path.unlink()
            os.close(self._handle)
            self._handle = None

    @contextlib.contextmanager
    def _tolerate_errors(self) -> Iterator[None]:
        """Report the first error of writing the file, and let the training continue without it."""
        try:
            yield
        except OSError as error:
            if not self._failed:
                terminal.report_progress(
                    f"{self._path} cannot be written ({error.strerror}); training continues without it."
                )
            self._failed = True


BATCH_S = 0.5  # minimum interval between messages about batches, because each reads the loss


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
    """Send the calls of a follower as messages."""

    def __init__(self, send: Callable[[TrainingMessage], None]) -> None:
        self._send, self._sent_s = send, time.monotonic()

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Send the network, and its epochs before an interruption."""
        fields = NetworkFields(
            epochs=network.epochs,
            number=network.number,
            count=network.count,
            labels=network.labels,
        )
        self._send({"begin": fields, "history": list(history)})

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Send the progress of an epoch, at most every half second."""
        now_s = time.monotonic()
        if now_s - self._sent_s >= BATCH_S:
            self._sent_s = now_s
            self._send({"batch": passed, "loss": loss()})

    def line(self, line: Line, learning_rate: float) -> None:
        """Send the line of an epoch."""
        self._send({"line": line, "learning_rate": learning_rate})

    def end(self, *, trained: bool) -> None:
        """Send whether the network was trained or the training was stopped."""
        self._send({"end": trained})


class Receiver:
    """Call followers when messages arrive.

    If a worker died, another one starts the network again: epochs that the followers already received are skipped.
    """

    def __init__(self, followers: Sequence[Follower]) -> None:
        self._followers = followers
        self._network: TrainedNetwork | None = None
        self._epochs = 0  # epochs of the network that the followers have received

    def take(self, message: TrainingMessage) -> None:
        """Call the followers for a message of `Sender`."""
        if "begin" in message:
            self._begin(TrainedNetwork(**message["begin"]), message["history"])
        elif "batch" in message:
            for follower in self._followers:
                follower.batch(message["batch"], lambda: float(message["loss"]))
        elif "line" in message:
            self._line(message["line"], message["learning_rate"])
        elif message["end"]:  # otherwise another process may continue the training
            self._end(trained=True)

    def close(self) -> None:
        """Report the end of a network whose training was not completed."""
        if self._network is not None:
            self._end(trained=False)

    def _begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Start a network; if it is already followed, only add the lines that are new."""
        if network == self._network:
            for line in history:
                self._line(line, 0.0)
            return
        self._network, self._epochs = network, len(history)
        for follower in self._followers:
            follower.begin(network, history)

    def _line(self, line: Line, learning_rate: float) -> None:
        """Pass a line to the followers, unless it has been passed before."""
        if line["epoch"] <= self._epochs:
            return
        self._epochs = line["epoch"]
        for follower in self._followers:
            follower.line(line, learning_rate)

    def _end(self, *, trained: bool) -> None:
        self._network = None
        for follower in self._followers:
            follower.end(trained=trained)
