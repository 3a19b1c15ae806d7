"""Show results on one page that needs only a browser.

Results of the same task are compared, seeds and folds of a method pooled. Of more than two of the task ``forward``, only
the best method's and that of the paper are given in full; outputs of ``tacpipe compress`` may be given besides, which state
what codecs of other widths lose. With those of the task ``material``, slides may be given, which state how they went.
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


@stage(version=4)
def report(params: Params, results: Datasets) -> Result:
    """Show results on one page that needs only a browser.

    It has headline, figures, tables, and where every number comes from.
    """
    from tacpipe.plugins.stage import Result
    from tacpipe.report import page

    return Result(files={"report.html": page.render(results, title=params.title, traces=params.traces)})
