"""The part of the page that reports on forecasts: how all compare, then single results in full."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tacpipe.report import markup, provenance
from tacpipe.report.forward import methods, overview, representations, section, sweep
from tacpipe.report.forward.overview import Overview
from tacpipe.report.forward.reading import called, kind, read

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

IN_FULL = 2  # results that are given in full where there are no more

__all__ = ["TITLE", "called", "kind", "read", "reads", "report"]

TITLE = "forecasts of tactile signals"


def reads(dataset: Dataset) -> bool:
    """Return whether a dataset that is not a result helps to report on forecasts: those of ``tacpipe compress`` do."""
    return sweep.FILE in dataset.files


def report(results: Sequence[Dataset], others: Sequence[Dataset], traces: int) -> str:
    """Return what ``results`` of this task state, with ``traces`` recordings of each drawn that is given in full.

    Several results that can be compared are, and of more than two only a few are given in full. ``others`` are datasets
    that `reads` takes: they report on their codecs.
    """
    every = [methods.Run.read(one) for one in results if methods.comparable(one)]
    runs = [run for run in every if run.errors.recordings]  # others have nothing to compare
    described, parts = list(results), []
    if len(runs) > 1:
        found = Overview(runs)
        simulated = any(provenance.simulated(run.dataset) for run in runs)
        parts.append(overview.render(found, sweep.read([*results, *others]), simulated))
        if len(runs) > IN_FULL:
            compared = {id(run.dataset) for run in runs}
            chosen = [run.dataset for run in found.representative_runs()]
            described = [*chosen, *(one for one in results if id(one) not in compared)]
            parts.append(markup.note(f"Below, {len(described)} of the {len(results)} results in full."))
    elif others:
        published = all(provenance.published(one, overview.PAPERS_SETS) for one in results)
        parts.append(representations.section(sweep.read([*results, *others]), published))
    parts += [section.render(one, number, len(described), traces) for number, one in enumerate(described, 1)]
    return "".join(parts)
