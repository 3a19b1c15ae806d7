"""Describe the results of a task, pool them as runs of methods, and name the methods."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tacpipe.io import Scalar
from tacpipe.metrics import pairing
from tacpipe.plugins import registry

if TYPE_CHECKING:
    from tacpipe.arrays import AnyFloats
    from tacpipe.comparison.engine import Comparison, ComparisonRow
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.metrics.pairing import Measure, Sums
    from tacpipe.report.blocks import Cell, Fold
    from tacpipe.report.context import Context


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over runs; the latter is NaN for a single one."""

    mean: float
    sd: float


def spread(values: Sequence[float]) -> Spread:
    """Return mean and standard deviation of one value a run.

    >>> spread([1.0, 3.0])
    Spread(mean=2.0, sd=1.4142135623730951)
    """
    return Spread(
        float(np.mean(values)) if values else float("nan"),
        float(np.std(values, ddof=1)) if len(values) > 1 else float("nan"),
    )


Settings = Mapping[str, Scalar]  # params and whatever else makes a method, by name


def distinct_names(
    methods: Sequence[tuple[str, Settings]], usual: Collection[str | tuple[str, Scalar]] = ()
) -> list[tuple[str, Settings]]:
    """Return a name for each method, given a first name and all its settings, and the settings that are part of it.

    Settings are given where methods of the same first name differ in them, but for empty ones and those in ``usual``:
    names, or names with values.

    >>> distinct_names([("net", {"deep": True, "width": 8}), ("net", {"deep": False, "width": 8}), ("tree", {"deep": True})])
    [('net · deep', {'deep': True}), ('net · no deep', {'deep': False}), ('tree', {})]
    """
    alike: dict[str, list[Settings]] = {}
    for name, settings in methods:
        alike.setdefault(name, []).append(settings)
    distinct: list[tuple[str, Settings]] = []
    for first, settings in methods:
        differing = {
            name: value
            for name, value in settings.items()
            if name not in usual and (name, value) not in usual and any(run.get(name) != value for run in alike[first])
        }
        distinct.append((" · ".join([first, *marks(differing)]), differing))
    return distinct


def marks(differing: Settings) -> list[str]:
    """Return settings as a name states them, those that are empty left out.

    >>> marks({"width": 8, "deep": True, "of": ""})
    ['deep', 'width 8']
    """
    return [
        f"{name} {value}" if not isinstance(value, bool) else name if value else f"no {name}"
        for name, value in sorted(differing.items())
        if value != ""
    ]


MODEL = "model"  # the predictor that a run is about


@dataclass(frozen=True)
class Question:
    """A comparison: its recordings ("unseen objects"), and which of several targets ("PDC thumb"), as text."""

    part: str = ""
    target: str = ""
    place: int = 0  # order of the questions of a task: 0 is the main one

    @property
    def where(self) -> str:
        """Part and target in words."""
        return ", ".join(filter(None, (self.target, self.part))) or "all recordings"


@dataclass(frozen=True)
class PredictorErrors:
    """Errors of the predictors of one run on one question."""

    measure: Measure
    sums: Mapping[str, Mapping[str, AnyFloats]]  # sums of `Measure` by predictor and recording, (part,)
    clusters: Mapping[str, str] | None = None  # cluster of each recording for resampling; None: itself


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """One result: a model trained once and evaluated once."""

    dataset: Dataset
    task: str
    method: str  # name of all runs that differ in settings only
    settings: Settings  # all that makes its method; neither seed nor fold
    questions: Mapping[Question, PredictorErrors]
    family: str = ""  # group of methods, such as an architecture
    seed: Hashable = None
    fold: Hashable = None
    simulated: bool = False
    control: bool = False  # True if it was trained to show the size of an effect, as with a wrong plan or fewer data
    published: bool = False  # True if it was evaluated on the recordings of the task's paper only
    details: Any = None  # whatever the task's own sections read


@dataclass(frozen=True, eq=False)
class Method:
    """Runs that differ in seed or fold alone."""

    name: str
    family: str
    settings: Settings
    differing: Settings  # those in which others of the same first name differ
    runs: tuple[ComparedRun, ...]

    @property
    def control(self) -> bool:
        """True if it was trained to show the size of an effect, and does not compete."""
        return self.runs[0].control

    @property
    def simulated(self) -> bool:
        """True if any of its runs was evaluated on simulated recordings."""
        return any(run.simulated for run in self.runs)

    @property
    def published(self) -> bool:
        """True if all its runs were evaluated on the recordings of the task's paper."""
        return all(run.published for run in self.runs)

    @property
    def details(self) -> list[Any]:
        """Details of its runs for the sections of the task."""
        return [run.details for run in self.runs]

    def key_without(self, *names: str) -> str:
        """Return what methods share that differ in these settings alone."""
        return json.dumps(
            [self.family, {name: value for name, value in self.settings.items() if name not in names}],
            sort_keys=True,
            default=str,
        )

    def of(self, question: Question) -> list[ComparedRun]:
        """Return its runs that were evaluated on a question."""
        return [run for run in self.runs if question in run.questions]

    def sums(self, question: Question, predictor: str = MODEL) -> Sums:
        """Return what a predictor of its runs errs, by seed and recording; of several runs with a seed, added up."""
        return pairing.add_by_key(
            ((run.seed, name), run_sums)
            for run in self.of(question)
            for name, run_sums in run.questions[question].sums.get(predictor, {}).items()
        )

    def predictors(self, question: Question) -> list[str]:
        """Return the predictors that any of its runs holds, in the order in which they come."""
        return list(dict.fromkeys(name for run in self.of(question) for name in run.questions[question].sums))


def grouped(runs: Sequence[ComparedRun], usual: Collection[str | tuple[str, Scalar]] = ()) -> list[Method]:
    """Return the methods of runs, sorted by name.

    Runs of one task whose method, settings and units of errors are alike are one method. Names state the settings in which
    methods of the same first name differ, but for empty ones and those in ``usual``: names, or names with values.
    """
    by_key: dict[str, list[ComparedRun]] = {}
    for run in runs:
        by_key.setdefault(_key(run), []).append(run)
    firsts = [same[0] for same in by_key.values()]
    names = distinct_names([(method.method, method.settings) for method in firsts], usual)
    methods = [
        Method(name, same[0].family or same[0].method, same[0].settings, differing, tuple(same))
        for (name, differing), same in zip(names, by_key.values(), strict=True)
    ]
    return sorted(methods, key=lambda method: method.name)


def separate(runs: Sequence[ComparedRun]) -> list[Method]:
    """Return a method a run, in the order given: nothing is pooled, and names state seed and fold too."""
    methods = []
    for method in grouped(runs):
        for run in method.runs:
            about = {name: getattr(run, name) for name in ("seed", "fold") if getattr(run, name) is not None}
            marks = [f"{name} {value}" for name, value in about.items()] if len(method.runs) > 1 else []
            name = " · ".join([method.name, *marks])
            methods.append(Method(name, method.family, run.settings, {**method.differing, **about}, (run,)))
    order = {id(run): place for place, run in enumerate(runs)}
    return sorted(methods, key=lambda candidate: order[id(candidate.runs[0])])


def _key(run: ComparedRun) -> str:
    units = sorted({errors.measure.unit for errors in run.questions.values()})
    return json.dumps([run.task, run.method, run.control, run.settings, units], sort_keys=True, default=str)


Kind = Literal["model", "variant", "baseline", "oracle", "control"]
CONFIG = "config.json"


class TaskReport:
    """How results of one task are read, compared and reported.

    A task's own report is a subclass that overrides `read`, so that its results are compared, and what it adds to the page.
    An instance of this class reports results by their headlines and the numbers of ``metrics.json``.
    """

    title: str = ""  # predicted quantity, in a few words; empty: the name of the task
    usual: Sequence[str | tuple[str, Any]] = ()  # settings that no method's name states, or these values of them

    def __init__(self, name: str) -> None:
        """Report on the task ``name``."""
        self.name = name
        self.title = self.title or name.replace("_", " ")

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return the runs of results that can be compared, in their order; others are left out."""
        return []

    def kind(self, predictor: str) -> Kind:
        """Return what a predictor is: ``variant`` is the model's own in another form, ``oracle`` knows the future."""
        return "model" if predictor == MODEL else "baseline"

    def predictor_name(self, predictor: str) -> str:
        """Return the name of a predictor in tables."""
        return predictor.replace("_", " ")

    def uses(self, dataset: Dataset) -> bool:
        """Return whether the page can use a dataset that is not a result."""
        return False

    def columns(
        self, context: Context, comparison: Comparison
    ) -> Sequence[tuple[str, Callable[[ComparisonRow], Cell]]]:
        """Return more columns of the table of all methods: pairs of a head and the function of a row to its cell."""
        return []

    def sentence(self, context: Context) -> tuple[str, str] | None:
        """Return the sentence that the section opens with, and its verdict; None: how the best method compares."""
        return None

    def folds(self, context: Context) -> Sequence[Fold]:
        """Return what the section of the task holds beyond the comparison."""
        return []

    def caveats(self, context: Context) -> Sequence[str]:
        """Return what must be known about the numbers."""
        return []

    def run_columns(self, run: ComparedRun) -> dict[str, str | Cell]:
        """Return more columns of the table of runs, by their heads."""
        return {}


def report_on(task: str) -> TaskReport:
    """Return the report of the task of this name, by headlines where no installed task has the name or it brings none."""
    task_report = registry.load_task(task).report if task in registry.tasks() else None
    return task_report or TaskReport(task)


def task_of(result: Dataset) -> str:
    """Return the name of the task that a result is of, or empty if it does not state."""
    return str(json.loads(result.files.get(CONFIG, b"{}")).get("task", ""))


def by_task(results: Sequence[Dataset]) -> dict[str, list[Dataset]]:
    """Return results by task, in the order in which tasks first come."""
    grouped: dict[str, list[Dataset]] = {}
    for result in results:
        grouped.setdefault(task_of(result), []).append(result)
    return grouped
