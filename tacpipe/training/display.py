"""Show a training on stderr: a progress bar on a terminal, one line per epoch otherwise."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tacpipe.io import terminal
from tacpipe.training.following import HISTORY, Follower, Line, TrainedNetwork

REDRAW_S = 0.1  # minimum interval between readings of the loss, because each waits for the device
_DIGEST = 64  # length of the name of a folder that is named by a key
_KEY_LENGTH = 8  # characters of a key to show, enough for a shell to complete


@contextlib.contextmanager
def followers_on_stderr(stage: str, workspace: Path | None) -> Iterator[list[Follower]]:
    """Yield the followers that show the trainings of a stage in ``workspace``; an empty list if output is suppressed.

    Without a workspace, which is then on another computer, no path is shown. On a terminal, a bar is animated during
    the whole block, also before the first epoch and after the last.
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


def format_duration(seconds: float) -> str:
    """Format a duration as hours, minutes and seconds."""
    minutes, remainder = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{remainder:02d}" if hours else f"{minutes}:{remainder:02d}"


class _EpochReport:
    """Count epochs, and report the start and the end of a training."""

    def __init__(self, workspace: Path | None) -> None:
        self._workspace = workspace
        self._announced = False
        self.network = TrainedNetwork(1)
        self.history: list[Line] = []
        self._resumed = 0  # epochs before an interruption
        self._start_s = 0.0

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Report the history file, once, and the epoch from which a training resumes."""
        self.network, self.history, self._resumed = network, list(history), len(history)
        self._start_s = time.monotonic()
        if not self._announced and self._workspace is not None:
            terminal.note(f"each epoch is appended to {_shorten_path(self._workspace / HISTORY)}")
            self._announced = True
        if history:
            terminal.note(f"{self._prefix}resumes from epoch {len(history) + 1} of {network.epochs}")

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Do nothing: only epochs have lines."""

    def line(self, line: Line, learning_rate: float) -> None:
        """Append a line to the history."""
        self.history.append(line)

    def end(self, *, trained: bool) -> None:
        """Report the number of epochs and the best one, if there are new epochs."""
        if trained and len(self.history) > self._resumed:
            epochs = f"{len(self.history)} of {self.network.epochs} epochs"
            elapsed = format_duration(time.monotonic() - self._start_s)
            terminal.note(f"{self._prefix}trained {epochs} in {elapsed}, best validation loss {self.best}")

    @property
    def best(self) -> str:
        """The validation loss of the best epoch so far, and its number; empty before the first."""
        best_line = next((line for line in reversed(self.history) if line.get("best")), None)
        return f"{best_line['val_loss']:#.4g} (epoch {best_line['epoch']})" if best_line else ""

    @property
    def _prefix(self) -> str:
        return f"{self.network.name}: " if self.network.name else ""

    def remaining_time(self, passed: float = 0.0) -> str:
        """Return the estimated time for all remaining epochs, or "" before the first batch.

        ``passed`` is the fraction of the current epoch. Early stopping may shorten the time.
        """
        trained_epochs = len(self.history) - self._resumed + passed
        if not trained_epochs:
            return ""
        epoch_s = (time.monotonic() - self._start_s) / trained_epochs
        return f"{format_duration(epoch_s * (self.network.epochs - len(self.history) - passed))} left"


class EpochLines(_EpochReport):
    """Print one line per epoch."""

    _last_line_s = 0.0

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Report as `_EpochReport` does, and start the clock of the first epoch."""
        super().begin(network, history)
        self._last_line_s = self._start_s

    def line(self, line: Line, learning_rate: float) -> None:
        """Print the line of an epoch: the losses, the best so far, the epoch's duration and the remaining time."""
        super().line(line, learning_rate)
        now_s = time.monotonic()
        epoch_s, self._last_line_s = now_s - self._last_line_s, now_s
        width = len(str(self.network.epochs))
        cells = [
            f"{self._prefix}epoch {line['epoch']:>{width}}/{self.network.epochs}",
            f"train {line['train_loss']:<#8.4g} val {line['val_loss']:<#8.4g} best {self.best}",
            f"{epoch_s:.1f} s",
            self.remaining_time(),
        ]
        terminal.note("  ".join(cells))


class Bar(_EpochReport):
    """Show a progress bar, which pulses while no network is trained."""

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
        """Set the bar to the epochs of this network."""
        super().begin(network, history)
        self._batches, self._drawn_s = 0, 0.0
        self.progress.update(self._task, total=network.epochs, completed=len(history), note="")

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Advance the bar, and show the loss, the best so far, batches per second and the remaining time."""
        self._batches += 1
        now_s = time.monotonic()
        if now_s - self._drawn_s < REDRAW_S:
            return
        self._drawn_s = now_s
        rate = self._batches / max(now_s - self._start_s, 1e-9)
        best = f"best {self.best}" if self.best else ""
        cells = [
            f"loss {loss():#.4g}",
            best,
            f"{rate:.{1 if rate < 100 else 0}f} batches/s",
            self.remaining_time(passed),
        ]
        epoch = f"{len(self.history) + 1}/{self.network.epochs}"
        self.progress.update(
            self._task,
            description=f"{self._prefix}epoch {epoch}",
            completed=len(self.history) + passed,
            note="  ".join(filter(None, cells)),
        )

    def end(self, *, trained: bool) -> None:
        """Report as `_EpochReport` does, and let the bar pulse again."""
        super().end(trained=trained)
        self.progress.remove_task(self._task)  # rich cannot unset the total of a task
        self._task = self.progress.add_task(self._stage, total=None, note="")

    def close(self) -> None:
        """Clear the bar."""
        self.progress.stop()


def _shorten_path(path: Path) -> str:
    """Return a path relative to the working directory if it is inside, with folders named by a key shortened to a glob."""
    shown = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
    parts = [f"{part[:_KEY_LENGTH]}*" if len(part) == _DIGEST else part for part in shown.parts]
    return str(Path(*parts))
