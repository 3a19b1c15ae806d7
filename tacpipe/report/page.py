"""One page of results, each task's part by the module that its plug-in brings for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from tacpipe.comparison.specification import TaskReport, by_task, report_on
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.report import html
from tacpipe.report.blocks import listed
from tacpipe.report.sections import section

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


def render(given: Sequence[Dataset], *, title: str = "", traces: int = 2) -> bytes:
    """Return the page for results of ``tacpipe evaluate``, as UTF-8; the same results give the same bytes.

    Without a ``title``, it is made of what the tasks on the page predict.
    Results are reported by task, in the order in which tasks first come, with datasets that are not results next to those
    whose task can use them. Raises `TacpipeError` where none can, and without any result.
    """
    with model_files.validated("the results"):
        return _rendered(given, title, traces)


def _rendered(given: Sequence[Dataset], title: str, traces: int) -> bytes:
    results = [one for one in given if "metrics.json" in one.files]
    others = [one for one in given if "metrics.json" not in one.files]
    tasks = {name: report_on(name) for name in by_task(results)}
    if not results or not all(_users(one, tasks) for one in others):
        raise TacpipeError("There is no metrics.json in this dataset. Give the output of `tacpipe evaluate`.")
    sections = []
    for name, found in by_task(results).items():
        beside = [one for one in others if name in _users(one, tasks)]
        sections.append(section(tasks[name], found, beside, traces))
    titles = [one.title for one in sections]
    return html.page(
        sections, title or listed([*titles[:1], *(one[:1].lower() + one[1:] for one in titles[1:])]), title
    )


def _users(dataset: Dataset, tasks: Mapping[str, TaskReport]) -> list[str]:
    """Return the tasks whose section can use a dataset that is not a result."""
    return [name for name, task in tasks.items() if task.uses(dataset)]
