"""Show results on one self-contained HTML page.

Each task has a section: the best method and its gain, a chart and a table, then details in collapsible sections.
Results of the same task are compared, with seeds and folds of a method pooled. Frames of recordings with cameras are
shown next to results of a task that names them right or wrong.

Example: tacpipe report results/forward -o report.html
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.plugins.constraints import NonNegativeInt
from tacpipe.plugins.stage import Result, stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.datasets.lineage import CountedRows

    Datasets = tuple[Dataset, ...]
    Rows = Sequence[Sequence[CountedRows]]


@dataclass(frozen=True)
class Params:
    """Contents of the page."""

    title: str = ""  # heading of the page; empty: what its tasks predict
    traces: NonNegativeInt = 2  # number of recordings whose forecasts are drawn


@stage(version=14)
def report(params: Params, results: Datasets, rows: Rows) -> Result:
    """Return a page with the answer, charts, tables, and the source of every number."""
    from tacpipe.report import page

    for result, chain_rows in zip(results, rows, strict=True):
        result.chain_rows = chain_rows
    return Result(files={"report.html": page.render(results, title=params.title, traces=params.traces)})
