"""Methods next to each other and to their baselines: errors, gain over the best baseline, and how sure that is.

Runs of a method are pooled: its errors are summed by seed and recording, and intervals are over clusters of recordings, and
over seeds where there are several (`tacpipe.metrics.pairing`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.comparison.runs import MODEL, Method, Question, Run, Settings, grouped, separate
from tacpipe.comparison.specification import Kind, TaskReport, by_task, report_on
from tacpipe.comparison.spread import spread
from tacpipe.metrics import pairing
from tacpipe.metrics.headline import Headline
from tacpipe.metrics.intervals import Estimate
from tacpipe.metrics.pairing import Gain, Measure, Pair, Sums

if TYPE_CHECKING:
    import pandas as pd

    from tacpipe.datasets.dataset import Dataset


@dataclass(frozen=True, eq=False)
class Row:
    """How one predictor does on one question."""

    name: str
    kind: Kind
    family: str
    predictor: str
    method: Method  # whose runs report on it
    values: tuple[float, ...]  # by the comparison's columns
    score: Estimate  # what charts draw
    spread: float  # standard deviation of the score over runs; NaN for a single one
    baseline: str  # the best baseline on the same recordings; empty where none was evaluated, and for baselines
    gain: Gain  # over it
    p: float  # that both are alike (`pairing.swap_test`), not corrected for the number of methods
    n: int  # clusters
    recordings: int
    runs: int
    seeds: int

    @property
    def differing(self) -> Settings:
        """The settings in which its method differs from others."""
        return self.method.differing if self.predictor == MODEL else {}


@dataclass(frozen=True, eq=False)
class Comparison:
    """All predictors on one question, by kind, those of a kind the best first."""

    task: str
    question: Question
    measure: Measure
    rows: tuple[Row, ...]

    def of(self, *kinds: Kind) -> list[Row]:
        """Return the rows of some kinds, the best first."""
        return [one for one in self.rows if one.kind in kinds]

    @property
    def models(self) -> list[Row]:
        """The methods, the best first."""
        return self.of("model")

    @property
    def best(self) -> Row | None:
        """The best method."""
        return next(iter(self.models), None)

    @property
    def best_baseline(self) -> Row | None:
        """The baseline that the best method is compared with."""
        name = self.best.baseline if self.best else ""
        found = self.of("baseline")
        return next((one for one in found if one.name == name), next(iter(found), None))

    @property
    def headline(self) -> Headline | None:
        """The best method next to its baselines, as ``headline.json`` has a single one; None without a method."""
        return headline(self.best, self) if self.best else None

    def frame(self) -> pd.DataFrame:
        """Return a row a predictor: part, target, name, kind, differing settings, errors, baseline, gain, interval, p, n."""
        import pandas as pd

        names = list(dict.fromkeys(name for row in self.rows for name in row.differing))
        return pd.DataFrame(
            [
                {
                    "task": self.task,
                    "part": self.question.part,
                    "target": self.question.target,
                    "name": row.name,
                    "kind": row.kind,
                    **{name: row.differing.get(name, "") for name in names},
                    **dict(zip(self.measure.columns, row.values, strict=True)),
                    "baseline": row.baseline,
                    self.measure.name: row.gain.mean,
                    "low": row.gain.low,
                    "high": row.gain.high,
                    "p": row.p,
                    "n": row.n,
                    "recordings": row.recordings,
                    "runs": row.runs,
                    "seeds": row.seeds,
                }
                for row in self.rows
            ]
        )


def compare(results: Sequence[Dataset], *, pool: bool = True) -> list[Comparison]:
    """Return the comparisons of results of any tasks, a task and question each, tasks in the order in which they come.

    With ``pool``, runs that differ in seed or fold alone are one method; without, each run is a row of its own. Results
    that hold nothing to compare are left out.
    """
    found = []
    for name, same in by_task(results).items():
        task = report_on(name)
        runs = task.read(same)
        found += comparisons(task, grouped(runs, task.usual) if pool else separate(runs))
    return found


def comparisons(task: TaskReport, methods: Sequence[Method]) -> list[Comparison]:
    """Return one comparison per question and unit of its errors, questions in the order in which runs have them."""
    questions = questions_of([run for method in methods for run in method.runs])
    answers = [
        compare_on(task, alike, question) for question in questions for alike in _by_unit(methods, question).values()
    ]
    return [comparison for comparison in answers if comparison.rows]


def _by_unit(methods: Sequence[Method], question: Question) -> dict[str, list[Method]]:
    """Return the methods with a run on a question by the unit of its errors: errors in other units are not comparable."""
    methods_by_unit: dict[str, list[Method]] = {}
    for method in methods:
        for run in method.of(question)[:1]:
            methods_by_unit.setdefault(run.questions[question].measure.unit, []).append(method)
    return methods_by_unit


def questions_of(runs: Sequence[Run]) -> list[Question]:
    """Return the questions that any run was evaluated on by their places, those of one place as most runs order them."""
    most = sorted(runs, key=lambda run: -len(run.questions))
    return sorted(dict.fromkeys(question for run in most for question in run.questions), key=lambda one: one.place)


def compare_on(task: TaskReport, methods: Sequence[Method], question: Question) -> Comparison:
    """Return how methods compare on one question.

    Baselines, oracles and controls are those of one method's runs (`reference`), because a split has the same for all; a
    variant of the model is given for each method.
    """
    held = [one for one in methods if one.of(question)]
    measure = held[0].of(question)[0].questions[question].measure
    source = reference(task, held, question, measure)
    entries: list[tuple[str, Kind, str, Method]] = []
    sources: dict[str, Method] = {}
    for one in [source, *held]:
        for predictor in one.predictors(question):
            sources.setdefault(predictor, one)
    for one in held:
        for predictor in one.predictors(question):
            kind = task.kind(predictor)
            if kind == "model" and one.control:
                entries.append((one.name, "control", predictor, one))
            elif kind == "model" or kind == "variant":
                name = one.name if kind == "model" else f"{one.name} · {task.predictor_name(predictor)}"
                entries.append((name, kind, predictor, one))
            elif one is sources[predictor]:
                entries.append((task.predictor_name(predictor), kind, predictor, one))
    ranked = [_ranked(task, method, source, question, predictor) for _, _, predictor, method in entries]
    picked = [next(iter(pairs.values())) for (_, kind, *_), pairs in zip(entries, ranked, strict=True)
              if kind == "model" and pairs]  # fmt: skip
    rows = [_row(*entry, question, measure, pairs, picked) for entry, pairs in zip(entries, ranked, strict=True)]
    sign = -1 if measure.rises else 1

    def place(row: Row) -> tuple[bool, float, str]:
        return math.isnan(row.score.mean), sign * row.score.mean, row.name

    return Comparison(task.name, question, measure, tuple(sorted(rows, key=place)))


def reference(task: TaskReport, methods: Sequence[Method], question: Question, measure: Measure) -> Method:
    """Return the method whose runs report on baselines: with most baselines, then most runs, then the least error."""

    def place(one: Method) -> tuple[int, int, float]:
        counted = sum(task.kind(name) not in ("model", "variant") for name in one.predictors(question))
        error = float(measure.error(sum(one.sums(question).values())[None])[0])  # type: ignore[index]
        return counted, len(one.of(question)), -error

    return max(methods, key=place)


def headline(row: Row, comparison: Comparison) -> Headline | None:
    """Return a row of a method as a headline, with all baselines that it was compared with."""
    question, method = comparison.question, row.method
    source = next((one.method for one in comparison.rows if one.kind == "baseline"), method)
    task = report_on(comparison.task)
    rivals = (
        [row_of_model for row_of_model in comparison.models if row_of_model is not row] if row.kind == "model" else []
    )
    ranked = [_ranked(task, rival.method, source, question, rival.predictor) for rival in rivals]
    return pairing.headline(
        comparison.task,
        row.name,
        comparison.measure,
        method.sums(question, row.predictor),
        _baselines(task, method, source, question),
        part=question.part,
        target=question.target,
        clusters=_clusters(method, question),
        runs=row.runs,
        rivals=[next(iter(pairs.values())) for pairs in ranked if pairs],
    )


def difference(first: Method, second: Method, question: Question, predictors: tuple[str, str] = (MODEL, MODEL)) -> Gain:
    """Return what one method gains over another on the recordings of both."""
    measure = first.of(question)[0].questions[question].measure
    one, other = first.sums(question, predictors[0]), second.sums(question, predictors[1])
    return pairing.difference(measure, one, other, _clusters(first, question))


def _ranked(task: TaskReport, method: Method, source: Method, question: Question, predictor: str) -> dict[str, Pair]:
    """Return a method's own predictor next to each baseline, the best first; nothing for a predictor of another kind."""
    if task.kind(predictor) not in ("model", "variant"):
        return {}
    measure, sums = method.of(question)[0].questions[question].measure, method.sums(question, predictor)
    return pairing.rank(measure, sums, _baselines(task, method, source, question), _clusters(method, question))


def _row(
    name: str,
    kind: Kind,
    predictor: str,
    method: Method,
    question: Question,
    measure: Measure,
    pairs: Mapping[str, Pair],
    picked: Sequence[Pair],
) -> Row:
    """Return the row of a predictor; ``pairs`` are with its baselines, ``picked`` those of all methods with the best."""
    sums, clusters = method.sums(question, predictor), _clusters(method, question)
    runs = [one for one in method.of(question) if one.questions[question].sums.get(predictor)]
    each = [measure.score_of(one.questions[question].sums[predictor].values()) for one in runs]
    gain = pairing.gain(measure, list(pairs.values()), picked if kind == "model" else ())
    return Row(
        name,
        kind,
        method.family,
        predictor,
        method,
        measure.values(sum(sums.values())),  # type: ignore[arg-type]
        pairing.score(measure, sums, clusters),
        spread(each).sd,
        next(iter(pairs), ""),
        gain,
        next((compared.p(measure) for compared in pairs.values()), math.nan),
        gain.clusters or len({clusters[name] if clusters else name for _, name in sums}),
        len({recording for _, recording in sums}),
        len(runs),
        len({seed for seed, _ in sums}),
    )


def _baselines(task: TaskReport, method: Method, source: Method, question: Question) -> dict[str, Sums]:
    """Return the baselines of a method's own runs, or else of ``source``, by what tables call them."""
    found = {}
    for name in dict.fromkeys([*method.predictors(question), *source.predictors(question)]):
        if task.kind(name) == "baseline":
            found[task.predictor_name(name)] = method.sums(question, name) or source.sums(question, name)
    return found


def _clusters(method: Method, question: Question) -> dict[str, str] | None:
    held = [run.questions[question].clusters for run in method.of(question)]
    if any(one is None for one in held):
        return None
    return {name: cluster for one in held if one for name, cluster in one.items()}
