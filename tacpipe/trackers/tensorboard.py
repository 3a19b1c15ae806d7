"""TensorBoard: event files in ``runs/NAME``, or below the folder behind ``--track tensorboard:``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter

    from tacpipe.trackers.tracker import Scalar

FOLDER = "runs"


class TensorBoard:
    """A run as scalars by epoch, with params as text and as the row of TensorBoard's table of hyperparameters."""

    def __init__(self, place: str) -> None:
        import tensorboardX  # noqa: F401  (a module that is missing is reported before anything is computed)

        self._folder = Path(place or FOLDER)
        self._writer: SummaryWriter | None = None
        self._params: Mapping[str, Scalar] = {}
        self._epoch = 0

    def start(self, name: str, params: Mapping[str, Scalar]) -> str:
        """Begin the run's event file; what older files of this run hold is superseded."""
        from tensorboardX import SummaryWriter

        folder, self._params = self._folder / name, params
        resumes = folder.is_dir() and any(folder.iterdir())
        self._writer = SummaryWriter(str(folder), purge_step=0 if resumes else None)
        rows = "\n".join(f"| {key} | {value} |" for key, value in params.items())
        self._writer.add_text("params", f"| param | value |\n|---|---|\n{rows}", 0)
        self._writer.flush()
        return f"{folder} (tensorboard --logdir {self._folder})"

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        """Add a scalar a metric, and flush them."""
        assert self._writer is not None
        self._epoch = epoch
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, epoch)
        self._writer.flush()

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        """Add the figures, the row of hyperparameters and the path."""
        from tensorboardX.summary import hparams

        assert self._writer is not None
        if path is not None:
            for name, value in figures.items():
                self._writer.add_scalar(name, value, self._epoch)
            self._writer.add_text("path", str(path), self._epoch)
            if figures:
                for summary in hparams(dict(self._params), dict(figures)):
                    self._writer.file_writer.add_summary(summary)
        self._writer.close()
