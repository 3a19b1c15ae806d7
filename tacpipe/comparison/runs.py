"""Read the results of a task, pool runs as methods, and name the methods."""

from __future__ import annotations

import json
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Literal

import numpy as np

from tacpipe.datasets.selection import is_simulated
from tacpipe.io import Scalar
from tacpipe.plugins import registry
from tacpipe.scores import pairing
from tacpipe.scores.pairing import Sums
from tacpipe.scores.table import MODEL as MODEL
from tacpipe.scores.table import Question as Question
from tacpipe.scores.table import ScoreTable as ScoreTable

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    from tacpipe.datasets.dataset import Dataset

    Details = TypeVar("Details", default=Any)  # data for the task's own sections
else:
    from typing import TypeVar

    Details = TypeVar("Details")

Reading = TypeVar("Reading", bound="TaskResults")


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation, of one value per seed; the latter is NaN for a single one."""

    mean: float
    sd: float


def spread(values: Sequence[float]) -> Spread:
    """Return mean and standard deviation of one value per run.

    >>> spread([1.0, 3.0])
    Spread(mean=2.0, sd=1.4142135623730951)
    """
    return Spread(
        float(np.mean(values)) if values else float("nan"),
        float(np.std(values, ddof=1)) if len(values) > 1 else float("nan"),
    )


Settings = Mapping[str, Scalar]  # params and other settings of a method, by name


def distinct_names(
    methods: Sequence[tuple[str, Settings]],
    usual: Collection[str | tuple[str, Scalar]] = (),
    runs: Sequence[int] = (),
) -> list[tuple[str, Settings]]:
    """Return a unique name for each method, which is given as first name and settings, and the differing settings.

    A name includes the settings in which methods with the same first name differ, except empty ones, values that more
    than half of these methods' ``runs`` (1 per method by default) have, and those in ``usual``, which contains names of
    settings, or pairs of name and value.

    >>> distinct_names([("net", {"deep": True, "width": 8}), ("net", {"deep": False, "width": 8}), ("tree", {"deep": True})])
    [('net · deep', {'deep': True}), ('net · no deep', {'deep': False}), ('tree', {})]
    >>> [name for name, _ in distinct_names([("net", {"width": 8}), ("net", {"width": 9})], runs=[3, 1])]
    ['net', 'net · width 9']
    """
    weighted: dict[str, list[tuple[Settings, int]]] = {}
    for (name, settings), count in zip(methods, runs or [1] * len(methods), strict=True):
        weighted.setdefault(name, []).append((settings, count))
    distinct: list[tuple[str, Settings]] = []
    for first_name, settings in methods:
        others = weighted[first_name]
        differing = {
            name: value
            for name, value in settings.items()
            if name not in usual and (name, value) not in usual and any(run.get(name) != value for run, _ in others)
        }
        total = sum(count for _, count in others)
        uncommon = {
            name: value
            for name, value in differing.items()
            if 2 * sum(count for run, count in others if run.get(name) == value) <= total
        }
        distinct.append((" · ".join([first_name, *marks(uncommon)]), differing))
    return distinct


def marks(differing: Settings) -> list[str]:
    """Return settings in the form used in names, without empty ones.

    >>> marks({"width": 8, "deep": True, "of": ""})
    ['deep', 'width 8']
    """
    texts = []
    for name, value in sorted(differing.items()):
        if isinstance(value, bool):
            texts.append(name if value else f"no {name}")
        elif value != "":
            texts.append(f"{name} {value}")
    return texts


@dataclass(frozen=True, eq=False)
class ComparedRun(Generic[Details]):
    """One result: a model trained once and evaluated once."""

    dataset: Dataset
    task: str
    method: str  # name of all runs that differ only in settings
    settings: Settings  # settings that define the method; neither seed nor fold
    questions: Mapping[Question, ScoreTable]
    family: str = ""  # group of methods, such as an architecture
    seed: Hashable = None
    fold: Hashable = None
    # whether the run is a control that shows the size of an effect, such as a wrong plan or fewer data
    control: bool = False
    published: bool = False  # whether the run was evaluated only on recordings of the task's paper
    details: Details = None  # type: ignore[assignment]  # data for the task's own sections, if it has any

    @property
    def simulated(self) -> bool:
        """Return whether any of the recordings was simulated."""
        return is_simulated(self.dataset)


@dataclass(frozen=True, eq=False)
class Method(Generic[Details]):
    """Runs that differ only in seed or fold."""

    name: str
    family: str
    settings: Settings
    differing: Settings  # settings in which methods of the same first name differ
    runs: tuple[ComparedRun[Details], ...]

    @property
    def control(self) -> bool:
        """Return whether it was trained to show the size of an effect and does not compete."""
        return self.runs[0].control

    @property
    def simulated(self) -> bool:
        """Return whether any of its runs was evaluated on simulated recordings."""
        return any(run.simulated for run in self.runs)

    @property
    def published(self) -> bool:
        """Return whether all its runs were evaluated on the recordings of the task's paper."""
        return all(run.published for run in self.runs)

    @property
    def details(self) -> list[Details]:
        """Details of its runs for the sections of the task."""
        return [run.details for run in self.runs]

    def of(self, question: Question) -> list[ComparedRun[Details]]:
        """Return its runs that include a question."""
        return [run for run in self.runs if question in run.questions]

    def sums(self, question: Question, predictor: str = MODEL) -> Sums:
        """Return the error sums of a predictor by seed and recording; runs with the same seed are added."""
        parts = []
        for run in self.of(question):
            sums_by_recording = run.questions[question].sums.get(predictor, {})
            parts += [((run.seed, name), sums) for name, sums in sums_by_recording.items()]
        return pairing.add_by_key(parts)

    def predictors(self, question: Question) -> list[str]:
        """Return the predictors of all of its runs, in order of appearance."""
        return list(dict.fromkeys(name for run in self.of(question) for name in run.questions[question].sums))


def grouped(runs: Sequence[ComparedRun], usual: Collection[str | tuple[str, Scalar]] = ()) -> list[Method]:
    """Return the methods of runs, sorted by name.

    Runs of a task with equal method, settings and error units form one method. Names are those of `distinct_names`.
    """
    by_key: dict[str, list[ComparedRun]] = {}
    for run in runs:
        by_key.setdefault(_key(run), []).append(run)
    first_runs = [method_runs[0] for method_runs in by_key.values()]
    counts = [len(method_runs) for method_runs in by_key.values()]
    names = distinct_names([(run.method, run.settings) for run in first_runs], usual, counts)
    methods = [
        Method(name, first.family or first.method, first.settings, differing, tuple(method_runs))
        for (name, differing), first, method_runs in zip(names, first_runs, by_key.values(), strict=True)
    ]
    return sorted(methods, key=lambda method: method.name)


def separate(runs: Sequence[ComparedRun]) -> list[Method]:
    """Return one method per run, in order, with seed and fold in its name; nothing is pooled."""
    methods = []
    for method in grouped(runs):
        for run in method.runs:
            about = {name: getattr(run, name) for name in ("seed", "fold") if getattr(run, name) is not None}
            marks = [f"{name} {value}" for name, value in about.items()] if len(method.runs) > 1 else []
            name = " · ".join([method.name, *marks])
            methods.append(Method(name, method.family, run.settings, {**method.differing, **about}, (run,)))
    order = {id(run): index for index, run in enumerate(runs)}
    return sorted(methods, key=lambda candidate: order[id(candidate.runs[0])])


def _key(run: ComparedRun) -> str:
    units = sorted({errors.measure.unit for errors in run.questions.values()})
    return json.dumps([run.task, run.method, run.control, run.settings, units], sort_keys=True, default=str)


Kind = Literal["model", "variant", "baseline", "oracle", "control"]
CONFIG = "config.json"


@dataclass(frozen=True)
class RecordingOutcome:
    """The prediction of a model for a recording."""

    recording: str
    expected: str  # the recording's label
    predicted: str
    is_right: bool


class TaskResults:
    """How results of one task are read and compared; `tacpipe.report.context.TaskReport` adds how a page reports them."""

    title: str = ""  # predicted quantity in a few words; empty for the name of the task
    predictor_names: Mapping[str, str] = {}  # names in tables; others are written with spaces
    usual: Sequence[str | tuple[str, Any]] = ()  # settings, or settings with values, that are omitted from names

    def __init__(self, name: str) -> None:
        """Read results of the task ``name``."""
        self.name = name
        self.title = self.title or name.replace("_", " ")

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return the runs of results that can be compared, in order; others are skipped."""
        return []

    def kind(self, predictor: str) -> Kind:
        """Return the kind of a predictor: a ``variant`` is another form of the model, an ``oracle`` knows the future."""
        return "model" if predictor == MODEL else "baseline"

    def predictor_name(self, predictor: str) -> str:
        """Return the name of a predictor in tables."""
        return self.predictor_names.get(predictor, predictor.replace("_", " "))

    def outcomes(self, run: ComparedRun) -> Sequence[RecordingOutcome]:
        """Return the predictions of a run's model that are right or wrong for a recording, for frames of cameras."""
        return []


def report_on(task: str, default: type[Reading]) -> Reading:
    """Return the report of a task, or the ``default``, which uses headlines, if it is not installed or has none."""
    report: Reading | None = registry.load_task(task).report if task in registry.tasks() else None
    return report or default(task)


def task_of(result: Dataset) -> str:
    """Return the name of a result's task, or "" if it is not recorded."""
    return str(json.loads(result.files.get(CONFIG, b"{}")).get("task", ""))


def by_task(results: Sequence[Dataset]) -> dict[str, list[Dataset]]:
    """Return results by task, in order of appearance."""
    grouped: dict[str, list[Dataset]] = {}
    for result in results:
        grouped.setdefault(task_of(result), []).append(result)
    return grouped
