"""Show results on one self-contained HTML page.

Results of the same task are compared, seeds and folds of a method pooled. Of more than two of the task ``forward``, only
the best method's and that of the paper are shown in full; with outputs of ``tacpipe compress``, the page shows the loss of
codecs of other widths. With slides next to results of the task ``material``, it shows their profiles.

Example: tacpipe report results/forward -o report.html
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.plugins.constraints import NonNegativeInt
from tacpipe.plugins.stage import stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.plugins.stage import Result

    Datasets = tuple[Dataset, ...]


@dataclass(frozen=True)
class Params:
    """What the page shows."""

    title: str = ""  # heading of the page; without one, what its tasks predict
    traces: NonNegativeInt = 2  # recordings of each forecast shown in full whose predictions are drawn


@stage(version=5)
def report(params: Params, results: Datasets) -> Result:
    """Return one page: headline, figures, tables, and where every number comes from."""
    from tacpipe.plugins.stage import Result
    from tacpipe.report import page

    return Result(files={"report.html": page.render(results, title=params.title, traces=params.traces)})
