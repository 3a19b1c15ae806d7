"""The part of the page that reports on touch: how well a cloud and a grasp predict what fingers measure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tacpipe.report import plain
from tacpipe.report.touch import clouds, overview
from tacpipe.report.touch.methods import Run, grouped
from tacpipe.report.touch.reading import called, read
from tacpipe.tasks.touch.result_names import PREDICTIONS

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

__all__ = ["TITLE", "called", "read", "reads", "report"]

TITLE = "prediction of fingertip readings from point clouds"


def reads(dataset: Dataset) -> bool:
    """Return whether a dataset that is not a result helps to report on touch: one of clouds and grasps does."""
    return clouds.reads(dataset)


def report(results: Sequence[Dataset], others: Sequence[Dataset], traces: int) -> str:
    """Return what ``results`` of this task state, pooled by method; ``others`` are datasets that `reads` takes.

    A result without predictions of unseen grasps has nothing to compare and is given as its metrics name it. Nothing is
    drawn over time, so ``traces`` is of no effect.
    """
    runs = [Run.read(one) for one in results if PREDICTIONS in one.recordings]
    runs = [run for run in runs if len(run.predictions.recordings)]
    compared = {id(run.dataset) for run in runs}
    bare = [one for one in results if id(one) not in compared]
    parts = [overview.render(grouped(runs), others)] if runs else []
    parts += [plain.render(one, number, len(bare)) for number, one in enumerate(bare, 1)]
    return "".join(parts)
