"""Weights & Biases: offline in ``wandb/``, or below the folder behind ``--track wandb:``; ``wandb sync`` sends a run.

``WANDB_MODE=online`` sends it while it runs; ``WANDB_PROJECT`` is ``tacpipe`` unless it is set.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tacpipe.trackers.tracker import Scalar

PROJECT = "tacpipe"
STEP = "epoch"


class Wandb:
    """A run of Weights & Biases, named by its result, so that one which was interrupted is the same run."""

    def __init__(self, place: str) -> None:
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        import wandb  # noqa: F401  (a module that is missing is reported before anything is computed)

        self._place = place
        self._run: Any = None

    def start(self, name: str, params: Mapping[str, Scalar]) -> str:
        """Begin the run, or add to that of this name."""
        import wandb

        mode: Any = os.environ.get("WANDB_MODE") or "offline"
        if self._place:
            Path(self._place).mkdir(parents=True, exist_ok=True)
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT") or PROJECT,
            id=re.sub(r"[^\w.-]", "-", name)[-128:],
            name=name,
            config=dict(params),
            resume="allow" if mode == "online" else None,
            mode=mode,
            dir=self._place or None,
            settings=wandb.Settings(silent=True, console="off"),
        )
        self._run.define_metric("*", step_metric=STEP)
        return str(self._run.url if mode == "online" else Path(self._run.dir).parent)

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        """Add the metrics with their epoch."""
        self._run.log({STEP: epoch, **metrics})

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        """Put the figures and the path into the run's summary, and end it."""
        if path is not None:
            self._run.summary.update({**figures, "path": str(path)})
        self._run.finish(exit_code=0 if path is not None else 1)
