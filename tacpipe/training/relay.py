"""A training in another process, followed here: what its followers are called with, as messages.

`Sender` is a follower there, `Receiver` calls the followers here. A message is what JSON holds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from tacpipe.training.following import Follower, Line, Network

BATCH_S = 0.5  # least time between two messages about batches: each reads the loss
Message = dict[str, Any]


class Sender:
    """A follower that sends what it is called with."""

    def __init__(self, send: Callable[[Message], None]) -> None:
        self._send, self._sent_s = send, time.monotonic()

    def begin(self, network: Network, history: Sequence[Line]) -> None:
        """Send which network is trained, and its epochs before an interruption."""
        self._send({"begin": {**asdict(network), "labels": dict(network.labels)}, "history": list(history)})

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
        self._network: Network | None = None
        self._epochs = 0  # epochs of the network that the followers have received

    def take(self, message: Message) -> None:
        """Call the followers with what a message holds."""
        if "begin" in message:
            self._begin(Network(**message["begin"]), message["history"])
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

    def _begin(self, network: Network, history: Sequence[Line]) -> None:
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
