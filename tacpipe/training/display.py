"""A training on stderr: a bar that moves with every batch on a terminal, a line an epoch elsewhere."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tacpipe.io import terminal
from tacpipe.training.following import HISTORY, Follower, Line, TrainedNetwork

REDRAW_S = 0.1  # least time between two readings of the loss: each waits for the device
_DIGEST = 64  # letters of a folder that is named by a key
_SHOWN = 8  # characters of a key, enough for a shell to complete


@contextlib.contextmanager
def on_stderr(stage: str, workspace: Path | None) -> Iterator[list[Follower]]:
    """Yield what shows trainings of a stage in ``workspace`` to whoever looks: nobody if quiet was asked for.

    Without a workspace none is named: it is on another computer.

    On a terminal a bar moves from here to the end of the block, also before the first epoch and after the last.
    """
    if terminal.is_quiet():
        yield []
    elif not terminal.is_visible():
        yield [EpochLines(workspace)]
    else:
        bar = Bar(stage, workspace)
        try:
            yield [bar]
        finally:
            bar.close()


def duration(seconds: float) -> str:
    """Return a duration as a clock shows it.

    >>> duration(7.4), duration(65), duration(3725), duration(100 * 3600)
    ('0:07', '1:05', '1:02:05', '100:00:00')
    """
    minutes, remainder = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{remainder:02d}" if hours else f"{minutes}:{remainder:02d}"


class _Shown:
    """Count epochs, and report the beginning and the end of a training."""

    def __init__(self, workspace: Path | None) -> None:
        self._workspace = workspace
        self._announced = False
        self.network = TrainedNetwork(1)
        self.history: list[Line] = []
        self._resumed = 0  # epochs before an interruption
        self._begun_s = 0.0

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Report which file grows, once, and from which epoch a training resumes."""
        self.network, self.history, self._resumed = network, list(history), len(history)
        self._begun_s = time.monotonic()
        if not self._announced and self._workspace is not None:
            terminal.note(f"each epoch is appended to {_shorten_path(self._workspace / HISTORY)}")
            self._announced = True
        if history:
            terminal.note(f"{self._prefix}resumes from epoch {len(history) + 1} of {network.epochs}")

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Nothing: lines are of epochs."""

    def line(self, line: Line, learning_rate: float) -> None:
        """Add a line to what is known."""
        self.history.append(line)

    def end(self, *, trained: bool) -> None:
        """Report how many epochs there were and which was the best, if any is new."""
        if trained and len(self.history) > self._resumed:
            epochs = f"{len(self.history)} of {self.network.epochs} epochs"
            took = duration(time.monotonic() - self._begun_s)
            terminal.note(f"{self._prefix}trained {epochs} in {took}, best validation loss {self.best}")

    @property
    def best(self) -> str:
        """The validation loss of the last epoch that was the best so far, and its number; empty before any."""
        best_line = next((line for line in reversed(self.history) if line.get("best")), None)
        return f"{best_line['val_loss']:#.4g} (epoch {best_line['epoch']})" if best_line else ""

    @property
    def _prefix(self) -> str:
        return f"{self.network.name}: " if self.network.name else ""

    def left(self, passed: float = 0.0) -> str:
        """Return the time that all epochs take from here, at most: patience may end them before."""
        trained_epochs = len(self.history) - self._resumed + passed
        if not trained_epochs:
            return ""
        epoch_s = (time.monotonic() - self._begun_s) / trained_epochs
        return f"{duration(epoch_s * (self.network.epochs - len(self.history) - passed))} left"


class EpochLines(_Shown):
    """A line an epoch."""

    _before_s = 0.0

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Report as `_Shown` does, and measure the first epoch from here."""
        super().begin(network, history)
        self._before_s = self._begun_s

    def line(self, line: Line, learning_rate: float) -> None:
        """Print losses, the best so far, the epoch's seconds and the time that is left."""
        super().line(line, learning_rate)
        now_s = time.monotonic()
        took_s, self._before_s = now_s - self._before_s, now_s
        width = len(str(self.network.epochs))
        cells = [
            f"{self._prefix}epoch {line['epoch']:>{width}}/{self.network.epochs}",
            f"train {line['train_loss']:<#8.4g} val {line['val_loss']:<#8.4g} best {self.best}",
            f"{took_s:.1f} s",
            self.left(),
        ]
        terminal.note("  ".join(cells))


class Bar(_Shown):
    """A bar that is drawn over itself; it pulses while no network is trained."""

    def __init__(self, stage: str, workspace: Path | None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        super().__init__(workspace)
        columns = (TextColumn("{task.description}"), BarColumn(None), TextColumn("{task.fields[note]}", markup=False))
        self._stage = stage
        self.progress = Progress(*columns, console=Console(stderr=True), transient=True, expand=True)
        self._task = self.progress.add_task(stage, total=None, note="")
        self.progress.start()
        self._drawn_s = 0.0
        self._batches = 0

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Have the bar count the epochs of this network."""
        super().begin(network, history)
        self._batches, self._drawn_s = 0, 0.0
        self.progress.update(self._task, total=network.epochs, completed=len(history), note="")

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Move the bar, and show the loss, the best so far, batches a second and the time that is left."""
        self._batches += 1
        now_s = time.monotonic()
        if now_s - self._drawn_s < REDRAW_S:
            return
        self._drawn_s = now_s
        rate = self._batches / max(now_s - self._begun_s, 1e-9)
        best = f"best {self.best}" if self.best else ""
        cells = [f"loss {loss():#.4g}", best, f"{rate:.{1 if rate < 100 else 0}f} batches/s", self.left(passed)]
        epoch = f"{len(self.history) + 1}/{self.network.epochs}"
        self.progress.update(
            self._task,
            description=f"{self._prefix}epoch {epoch}",
            completed=len(self.history) + passed,
            note="  ".join(filter(None, cells)),
        )

    def end(self, *, trained: bool) -> None:
        """Have the bar pulse again."""
        super().end(trained=trained)
        self.progress.remove_task(self._task)  # rich cannot take the total of a task away
        self._task = self.progress.add_task(self._stage, total=None, note="")

    def close(self) -> None:
        """Clear the bar."""
        self.progress.stop()


def _shorten_path(path: Path) -> str:
    """Return a path as a shell takes it, seen from the working directory; a folder named by a key is cut to its start."""
    with contextlib.suppress(ValueError):
        path = path.relative_to(Path.cwd())
    parts = [f"{part[:_SHOWN]}*" if len(part) == _DIGEST else part for part in path.parts]
    return str(Path(*parts))
