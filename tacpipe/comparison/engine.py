"""Compare methods with each other and with their baselines: errors, gain over the best baseline, and intervals.

Runs of a method are pooled: its errors are summed by seed and recording. Intervals are over clusters of recordings, and over
seeds where there are several (`tacpipe.scores.pairing`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.comparison.runs import (
    MODEL,
    ComparedRun,
    Kind,
    Method,
    Question,
    Settings,
    TaskResults,
    by_task,
    grouped,
    report_on,
    separate,
    spread,
)
from tacpipe.scores import pairing
from tacpipe.scores.headline import Headline
from tacpipe.scores.intervals import Estimate
from tacpipe.scores.pairing import Gain, Measure, Pair, Sums

if TYPE_CHECKING:
    import pandas as pd

    from tacpipe.datasets.dataset import Dataset


@dataclass(frozen=True, eq=False)
class ComparisonRow:
    """The results of one predictor on one question."""

    name: str
    kind: Kind
    family: str
    predictor: str
    method: Method  # method whose runs include the question
    values: tuple[float, ...]  # one value per column of the comparison
    score: Estimate  # score drawn in charts
    spread: float  # standard deviation of the score over seeds; NaN for a single seed
    baseline: str  # best baseline on the same recordings; empty for baselines, and if none was evaluated
    gain: Gain  # gain over the baseline
    p: float  # p value for equality with the baseline (`pairing.swap_test`), not corrected for the number of methods
    n: int  # number of clusters
    recordings: int
    runs: int
    seeds: int

    @property
    def differing(self) -> Settings:
        """The settings in which its method differs from others."""
        return self.method.differing if self.predictor == MODEL else {}


@dataclass(frozen=True, eq=False)
class Comparison:
    """All predictors on one question by kind, the best of each kind first."""

    task: str
    question: Question
    measure: Measure
    rows: tuple[ComparisonRow, ...]

    def of(self, *kinds: Kind) -> list[ComparisonRow]:
        """Return the rows of these kinds, the best first."""
        return [row for row in self.rows if row.kind in kinds]

    @property
    def models(self) -> list[ComparisonRow]:
        """The methods, the best first."""
        return self.of("model")

    @property
    def best(self) -> ComparisonRow | None:
        """The best method; None without a method."""
        return next(iter(self.models), None)

    @property
    def best_baseline(self) -> ComparisonRow | None:
        """The baseline that the best method is compared with; None without a baseline."""
        name = self.best.baseline if self.best else ""
        baselines = self.of("baseline")
        return next((row for row in baselines if row.name == name), next(iter(baselines), None))

    @property
    def headline(self) -> Headline | None:
        """The best method with its baselines, like a single result's ``headline.json``; None without a method."""
        return headline(self.best, self) if self.best else None

    def frame(self) -> pd.DataFrame:
        """Return a table with one row per predictor: its settings, errors, best baseline, gain with interval, and counts."""
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
    """Return the comparisons of results, one per task and question, with tasks in the order of the results.

    With ``pool``, runs that differ only in seed or fold are one method; otherwise each run is a row. Results without
    anything to compare are skipped.
    """
    all_comparisons = []
    for name, same in by_task(results).items():
        task = report_on(name, TaskResults)
        runs = task.read(same)
        all_comparisons += comparisons(task, grouped(runs, task.usual) if pool else separate(runs))
    return all_comparisons


def comparisons(task: TaskResults, methods: Sequence[Method]) -> list[Comparison]:
    """Return one comparison per question and unit of its errors, with questions in the order of the runs."""
    all_comparisons = []
    for question in questions_of([run for method in methods for run in method.runs]):
        groups = _group_by_unit(methods, question).values()
        all_comparisons += [compare_on(task, same_unit, question) for same_unit in groups]
    return [comparison for comparison in all_comparisons if comparison.rows]


def _group_by_unit(methods: Sequence[Method], question: Question) -> dict[str, list[Method]]:
    """Return the methods with a run on a question by error unit, because errors in different units cannot be compared."""
    methods_by_unit: dict[str, list[Method]] = {}
    for method in methods:
        for run in method.of(question)[:1]:
            methods_by_unit.setdefault(run.questions[question].measure.unit, []).append(method)
    return methods_by_unit


def questions_of(runs: Sequence[ComparedRun]) -> list[Question]:
    """Return the questions of all runs ordered by their place, and questions of equal place as most runs order them."""
    ordered = sorted(runs, key=lambda run: -len(run.questions))
    return sorted(
        dict.fromkeys(question for run in ordered for question in run.questions), key=lambda candidate: candidate.place
    )


def compare_on(task: TaskResults, methods: Sequence[Method], question: Question) -> Comparison:
    """Return the comparison of methods on one question.

    Models and their variants are rows for each method. Other predictors, such as baselines and oracles, are the same for
    all methods of a split, so they are taken from one method (`reference`, if it has them).
    """
    evaluated = [method for method in methods if method.of(question)]
    measure = evaluated[0].of(question)[0].questions[question].measure
    source = reference(task, evaluated, question, measure)
    entries: list[tuple[str, Kind, str, Method]] = []
    sources: dict[str, Method] = {}
    for method in [source, *evaluated]:
        for predictor in method.predictors(question):
            sources.setdefault(predictor, method)
    for method in evaluated:
        for predictor in method.predictors(question):
            kind = task.kind(predictor)
            if kind == "model":
                entries.append((method.name, "control" if method.control else kind, predictor, method))
            elif kind == "variant":
                entries.append((f"{method.name} · {task.predictor_name(predictor)}", kind, predictor, method))
            elif method is sources[predictor]:
                entries.append((task.predictor_name(predictor), kind, predictor, method))
    ranked = [_rank_baselines(task, method, source, question, predictor) for _, _, predictor, method in entries]
    rows = [_row(*entry, question, measure, pairs) for entry, pairs in zip(entries, ranked, strict=True)]
    sign = -1 if measure.rises else 1

    def best_first(row: ComparisonRow) -> tuple[bool, float, str]:
        return math.isnan(row.score.mean), sign * row.score.mean, row.name

    return Comparison(task.name, question, measure, tuple(sorted(rows, key=best_first)))


def reference(task: TaskResults, methods: Sequence[Method], question: Question, measure: Measure) -> Method:
    """Return the method whose baselines are reported: the one with most baselines, then most runs, then the lowest error."""

    def rank(method: Method) -> tuple[int, int, float]:
        counted = sum(task.kind(name) not in ("model", "variant") for name in method.predictors(question))
        error = float(measure.error(sum(method.sums(question).values())[None])[0])  # type: ignore[index]
        return counted, len(method.of(question)), -error

    return max(methods, key=rank)


def headline(row: ComparisonRow, comparison: Comparison) -> Headline | None:
    """Return a method's row as a headline, with all baselines that it was compared with; None without recordings.

    For the best method, the interval accounts for its choice from all methods.
    """
    question, method = comparison.question, row.method
    source = next((row.method for row in comparison.rows if row.kind == "baseline"), method)
    task = report_on(comparison.task, TaskResults)
    rivals = (
        [row_of_model for row_of_model in comparison.models if row_of_model is not row]
        if row is comparison.best
        else []
    )
    ranked = [_rank_baselines(task, rival.method, source, question, rival.predictor) for rival in rivals]
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
    """Return the gain of one method over another on the recordings that both have."""
    measure = first.of(question)[0].questions[question].measure
    first_sums, second_sums = first.sums(question, predictors[0]), second.sums(question, predictors[1])
    return pairing.difference(measure, first_sums, second_sums, _clusters(first, question))


def _rank_baselines(
    task: TaskResults, method: Method, source: Method, question: Question, predictor: str
) -> dict[str, Pair]:
    """Return a predictor of a method paired with each baseline, the best baseline first.

    Empty for other kinds of predictors.
    """
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
) -> ComparisonRow:
    """Return the row of a predictor. ``pairs`` are its pairs with its baselines by name, the best baseline first.

    The gain is that of the method alone, as its own result states it; `headline` accounts for the choice of the best.
    """
    sums, clusters = method.sums(question, predictor), _clusters(method, question)
    runs = [run for run in method.of(question) if run.questions[question].sums.get(predictor)]
    seeds = {seed for seed, _ in sums}
    seed_scores = [measure.score_of(row for (run_seed, _), row in sums.items() if run_seed == seed) for seed in seeds]
    gain = pairing.gain(measure, list(pairs.values()))
    return ComparisonRow(
        name,
        kind,
        method.family,
        predictor,
        method,
        measure.values(sum(sums.values())),  # type: ignore[arg-type]
        pairing.score(measure, sums, clusters),
        spread(seed_scores).sd,
        next(iter(pairs), ""),
        gain,
        next((compared.p for compared in pairs.values()), math.nan),
        gain.clusters or len({clusters[name] if clusters else name for _, name in sums}),
        len({recording for _, recording in sums}),
        len(runs),
        len(seeds),
    )


def _baselines(task: TaskResults, method: Method, source: Method, question: Question) -> dict[str, Sums]:
    """Return the baselines of a method's own runs, or else of ``source``, by their names in tables."""
    baselines = {}
    for name in dict.fromkeys([*method.predictors(question), *source.predictors(question)]):
        if task.kind(name) == "baseline":
            baselines[task.predictor_name(name)] = method.sums(question, name) or source.sums(question, name)
    return baselines


def _clusters(method: Method, question: Question) -> dict[str, str] | None:
    clusters_by_run = [run.questions[question].clusters for run in method.of(question)]
    if any(clusters is None for clusters in clusters_by_run):
        return None
    return {name: cluster for clusters in clusters_by_run if clusters for name, cluster in clusters.items()}
