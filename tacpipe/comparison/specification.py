"""What a task states about its results, so that they can be compared and reported: a module, named by the entry point
group ``tacpipe.reports``.

Only `Specification.read` is needed; a task without a module is compared by the headlines of its results.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol

from tacpipe.comparison.runs import MODEL, Run
from tacpipe.plugins import registry

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Kind = Literal["model", "variant", "baseline", "oracle", "control"]
CONFIG = "config.json"


class Specification(Protocol):
    """How results of one task are read, compared and reported. All but `read` may be left out."""

    TITLE: str  # what the task predicts, in a few words
    USUAL: Sequence[str | tuple[str, Any]]  # settings that no name states, or these values of them

    def read(self, results: Sequence[Dataset]) -> list[Run]:
        """Return the runs of results that can be compared, in their order; others are left out."""
        ...

    def kind(self, predictor: str) -> Kind:
        """Return what a predictor is: ``variant`` is the model's own in another form, ``oracle`` knows the future.

        Without this, all but ``model`` are baselines.
        """
        ...

    def called(self, predictor: str) -> str:
        """Return what tables call a predictor; without this, its name with spaces."""
        ...

    def reads(self, dataset: Dataset) -> bool:
        """Return whether the page can use a dataset that is not a result; without this, none."""
        ...

    def columns(self, context: Any, comparison: Any) -> Any:
        """Return more columns of the table of all methods: pairs of a head and a function of a row to a `Cell`."""
        ...

    def sentence(self, context: Any) -> tuple[str, str]:
        """Return the sentence that the section opens with, and its verdict."""
        ...

    def folds(self, context: Any) -> Any:
        """Return what the section of the task holds beyond the comparison, `tacpipe.report.blocks.Fold` each."""
        ...

    def caveats(self, context: Any) -> Sequence[str]:
        """Return what must be known about the numbers."""
        ...

    def about_run(self, run: Run) -> Any:
        """Return more columns of the table of runs, by their heads."""
        ...


class Task:
    """A task by name with what its module states, or the defaults."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.module: Any = registry.load_report(name)

    @property
    def title(self) -> str:
        """What the task predicts, in a few words."""
        return str(getattr(self.module, "TITLE", self.name.replace("_", " ")))

    def read(self, results: Sequence[Dataset]) -> list[Run]:
        """Return the runs among results of this task."""
        reader = getattr(self.module, "read", None)
        return [] if reader is None else list(reader(results))

    def kind(self, predictor: str) -> Kind:
        """Return what a predictor is."""
        found: Any = getattr(self.module, "kind", None)
        default: Kind = "model" if predictor == MODEL else "baseline"
        return default if found is None else found(predictor)

    def called(self, predictor: str) -> str:
        """Return what tables call a predictor."""
        found: Any = getattr(self.module, "called", None)
        return predictor.replace("_", " ") if found is None else str(found(predictor))

    @property
    def usual(self) -> Sequence[str | tuple[str, Any]]:
        """The settings that no name states."""
        return tuple(getattr(self.module, "USUAL", ()))


def task_of(result: Dataset) -> str:
    """Return the name of the task that a result is of; empty where it does not state."""
    return str(json.loads(result.files.get(CONFIG, b"{}")).get("task", ""))


def by_task(results: Sequence[Dataset]) -> dict[str, list[Dataset]]:
    """Return results by task, in the order in which tasks first come."""
    found: dict[str, list[Dataset]] = {}
    for one in results:
        found.setdefault(task_of(one), []).append(one)
    return found
