"""The part of the page that reports on materials: which method names them, and what joint learning is worth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tacpipe.report import plain
from tacpipe.report.material import grouping, overview, profiles
from tacpipe.report.material.methods import Run
from tacpipe.report.material.reading import USUAL, called, kind, read

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

__all__ = ["TITLE", "USUAL", "called", "kind", "read", "reads", "report"]

TITLE = "recognition of materials by touch"


def reads(dataset: Dataset) -> bool:
    """Return whether a dataset that is not a result helps to report on materials: one of slides does."""
    return profiles.reads(dataset)


def report(results: Sequence[Dataset], others: Sequence[Dataset], traces: int) -> str:
    """Return what ``results`` of this task state, pooled by method; ``others`` are datasets that `reads` takes.

    A result without predictions of unseen slides has nothing to compare and is given as its metrics name it. Nothing is
    drawn by recording, so ``traces`` is of no effect.
    """
    runs = [Run.read(one) for one in results if "predictions" in one.recordings]
    runs = [run for run in runs if run.sensors]
    compared = {id(run.dataset) for run in runs}
    bare = [one for one in results if id(one) not in compared]
    parts = [overview.render(grouping.grouped(runs), others)] if runs else []
    parts += [plain.render(one, number, len(bare)) for number, one in enumerate(bare, 1)]
    return "".join(parts)
