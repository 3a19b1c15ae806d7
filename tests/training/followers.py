"""Followers of trainings: one remembers its calls, one interrupts the training."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from tacpipe.training import following
from tacpipe.training.following import Line, TrainedNetwork


class Seen:
    """A follower that keeps what it was called with."""

    def __init__(self, act: Callable[[], None] = lambda: None) -> None:
        self.networks: list[tuple[TrainedNetwork, list[Line]]] = []
        self.passed: list[float] = []
        self.losses: list[float] = []
        self.lines: list[tuple[Line, float]] = []
        self.ends: list[bool] = []
        self.act = act

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        self.networks.append((network, list(history)))

    def batch(self, passed: float, mean: Callable[[], float]) -> None:
        self.passed.append(passed)
        self.losses.append(mean())

    def line(self, line: Line, learning_rate: float) -> None:
        self.act()
        self.lines.append((line, learning_rate))

    def end(self, *, trained: bool) -> None:
        self.ends.append(trained)


class Interrupting(Seen):
    """A follower that interrupts the training once it has seen so many networks, batches or epochs."""

    def __init__(self, networks: int = 0, batches: int = 0, epochs: int = 0) -> None:
        super().__init__()
        self.limits = networks, batches, epochs

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        super().begin(network, history)
        self._interrupt()

    def batch(self, passed: float, mean: Callable[[], float]) -> None:
        super().batch(passed, mean)
        self._interrupt()

    def line(self, line: Line, learning_rate: float) -> None:
        super().line(line, learning_rate)
        self._interrupt()

    def _interrupt(self) -> None:
        counts = len(self.networks), len(self.passed), len(self.lines)
        if any(count >= limit > 0 for count, limit in zip(counts, self.limits, strict=True)):
            raise KeyboardInterrupt


@contextmanager
def interrupted(folder: Path, **limits: int) -> Iterator[None]:
    """Interrupt the trainings of the block, whose workspace is ``folder``, after so many networks, batches or epochs."""
    folder.mkdir(parents=True)
    with pytest.raises(KeyboardInterrupt), following.in_workspace(folder, Interrupting(**limits)):
        yield
