"""A result of an evaluation as a run, and the runs of a method: what a task reads from its results for a comparison."""

from __future__ import annotations

import json
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tacpipe.comparison.naming import distinct_names
from tacpipe.metrics import pairing

if TYPE_CHECKING:
    from tacpipe.arrays import AnyFloats
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.metrics.pairing import Measure, Sums

Settings = Mapping[str, Any]
MODEL = "model"  # the predictor that a run is about


@dataclass(frozen=True)
class Question:
    """What is compared: which recordings ("unseen objects"), and which of several targets ("PDC thumb"), as text."""

    part: str = ""
    target: str = ""
    place: int = 0  # among the questions of a task: 0 is the main one

    @property
    def where(self) -> str:
        """Part and target in words."""
        return ", ".join(filter(None, (self.target, self.part))) or "all recordings"


@dataclass(frozen=True)
class Errors:
    """What the predictors of one run err on one question."""

    measure: Measure
    sums: Mapping[str, Mapping[str, AnyFloats]]  # by predictor and recording, what `Measure` adds up, (part,)
    clusters: Mapping[str, str] | None = None  # by recording, what it is resampled with; None: itself


@dataclass(frozen=True, eq=False)
class Run:
    """One result: a model trained once and evaluated once."""

    dataset: Dataset
    task: str
    method: str  # what runs that differ in settings alone are called
    settings: Settings  # all that makes its method; neither seed nor fold
    questions: Mapping[Question, Errors]
    family: str = ""  # of methods, such as an architecture
    seed: Hashable = None
    fold: Hashable = None
    simulated: bool = False
    control: bool = False  # whether it was trained to show what an effect is worth, as with a wrong plan or fewer data
    published: bool = False  # whether it was evaluated on the recordings of the task's paper alone
    details: Any = None  # whatever the task's own sections read


@dataclass(frozen=True, eq=False)
class Method:
    """Runs that differ in seed or fold alone."""

    name: str
    family: str
    settings: Settings
    differing: Settings  # those in which others of the same first name differ
    runs: tuple[Run, ...]

    @property
    def control(self) -> bool:
        """Whether it was trained to show what an effect is worth, and does not compete."""
        return self.runs[0].control

    @property
    def simulated(self) -> bool:
        """Whether any of its runs was evaluated on simulated recordings."""
        return any(run.simulated for run in self.runs)

    @property
    def published(self) -> bool:
        """Whether all its runs were evaluated on the recordings of the task's paper."""
        return all(run.published for run in self.runs)

    @property
    def details(self) -> list[Any]:
        """What the task's own sections read of its runs."""
        return [run.details for run in self.runs]

    def key_without(self, *names: str) -> str:
        """Return what methods share that differ in these settings alone."""
        return json.dumps(
            [self.family, {name: value for name, value in self.settings.items() if name not in names}],
            sort_keys=True,
            default=str,
        )

    def of(self, question: Question) -> list[Run]:
        """Return its runs that were evaluated on a question."""
        return [one for one in self.runs if question in one.questions]

    def sums(self, question: Question, predictor: str = MODEL) -> Sums:
        """Return what a predictor of its runs errs, by seed and recording; of several runs with a seed, added up."""
        return pairing.added(
            ((run.seed, name), one)
            for run in self.of(question)
            for name, one in run.questions[question].sums.get(predictor, {}).items()
        )

    def predictors(self, question: Question) -> list[str]:
        """Return the predictors that any of its runs holds, in the order in which they come."""
        return list(dict.fromkeys(name for run in self.of(question) for name in run.questions[question].sums))


def grouped(runs: Sequence[Run], usual: Collection[str | tuple[str, Any]] = ()) -> list[Method]:
    """Return the methods of runs, sorted by name.

    Runs of one task whose method, settings and units of errors are alike are one method. Names state the settings in which
    methods of the same first name differ, but for empty ones and those in ``usual``: names, or names with values.
    """
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(_key(run), []).append(run)
    firsts = [same[0] for same in found.values()]
    names = distinct_names([(one.method, one.settings) for one in firsts], usual)
    made = [
        Method(name, same[0].family or same[0].method, same[0].settings, differing, tuple(same))
        for (name, differing), same in zip(names, found.values(), strict=True)
    ]
    return sorted(made, key=lambda one: one.name)


def separate(runs: Sequence[Run]) -> list[Method]:
    """Return a method a run, in the order given: nothing is pooled, and names state seed and fold too."""
    found = []
    for method in grouped(runs):
        for run in method.runs:
            about = {name: getattr(run, name) for name in ("seed", "fold") if getattr(run, name) is not None}
            marks = [f"{name} {value}" for name, value in about.items()] if len(method.runs) > 1 else []
            name = " · ".join([method.name, *marks])
            found.append(Method(name, method.family, run.settings, {**method.differing, **about}, (run,)))
    order = {id(run): place for place, run in enumerate(runs)}
    return sorted(found, key=lambda one: order[id(one.runs[0])])


def _key(run: Run) -> str:
    units = sorted({errors.measure.unit for errors in run.questions.values()})
    return json.dumps([run.task, run.method, run.control, run.settings, units], sort_keys=True, default=str)
