"""How results of forecasts are read, compared and reported."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tacpipe.tasks.forward.report import sweep
from tacpipe.tasks.forward.report.parts import about_run, caveats, columns, folds
from tacpipe.tasks.forward.report.reading import called, kind, read

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

__all__ = ["TITLE", "about_run", "called", "caveats", "columns", "folds", "kind", "read", "reads"]

TITLE = "forecasts of tactile signals"


def reads(dataset: Dataset) -> bool:
    """Return whether a dataset that is not a result helps to report on forecasts: those of ``tacpipe compress`` do."""
    return sweep.FILE in dataset.files
