"""Write the section of a task: its first screen, all methods, its own folds, recordings, runs and provenance."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence

import numpy as np

from tacpipe.comparison import engine
from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import MODEL, grouped
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.selection import is_simulated
from tacpipe.printable import format_count
from tacpipe.report import blocks, charts, context, frames, screen
from tacpipe.report.blocks import (
    NONE,
    Cell,
    Chart,
    Fold,
    Group,
    Section,
    SmallPrint,
    Table,
    fold,
    number,
    p_value,
    table,
)
from tacpipe.report.blocks import Row as Line
from tacpipe.report.context import SIMULATED, Context, TaskReport, drop_duplicates, median_run, provenance_blocks
from tacpipe.report.differences import difference_folds
from tacpipe.report.papers import paper_folds
from tacpipe.report.training import history_of, training_folds
from tacpipe.scores import headline, pairing, words
from tacpipe.scores.pairing import Gain, Measure


def metrics_sentence(results: Sequence[Dataset]) -> str:
    """Return the first headline of results as a sentence, or why there is none."""
    for result in results:
        headlines = headline.read(result.files[headline.FILE]) if headline.FILE in result.files else []
        if headlines:
            return words.sentence(headlines[0])
    counts = [context.read_json(result, "metrics.json").get("counts") for result in results]
    if all(count is not None and not count.get("recordings", count.get("n", True)) for count in counts):
        return "All recordings were used for training or contain no window, so there is nothing to evaluate."
    return "These results contain no errors by recording, so methods cannot be compared. Their numbers are below."


def metric_folds(result: Dataset, number: int, count: int) -> list[Fold]:
    """Return the fold of result ``number`` of ``count``: its headlines, metrics and provenance."""
    config = context.read_json(result, "config.json")
    name = ": ".join(str(config[key]) for key in ("task", "architecture") if key in config) or "result"
    rows = [[name, value] for name, value in blocks.leaves(context.read_json(result, "metrics.json")).items()]
    headlines = headline.read(result.files[headline.FILE]) if headline.FILE in result.files else []
    headline_blocks = [table("Model and best baseline", *words.table(headlines))] if headlines else []
    title = f"{f'{number}. ' if count > 1 else ''}{name.replace('_', ' ')}"
    return [
        Fold(
            title,
            [*headline_blocks, table("Metrics", ["", "value"], rows), *context.provenance_blocks(result)],
        )
    ]


RECORDINGS = 60  # maximum number of rows in a table of recordings
DOTS = 400  # maximum number of recordings in a chart
KINDS = {
    "baseline": "Baselines",
    "variant": "Variants of the methods",
    "oracle": "Oracles, which use the true future",
    "control": "Controls",
}
PICKED = (
    "The best of several methods was selected on these recordings, which biases it slightly upwards. The "
    "interval of its gain accounts for this."
)


def section(task: TaskReport, results: Sequence[Dataset], extra_datasets: Sequence[Dataset], traces: int) -> Section:
    """Return the section for the results of one task.

    ``extra_datasets`` are related datasets that are not results; ``traces`` is the number of recordings that are drawn
    completely.
    """
    runs = task.read(results)
    methods = grouped(runs, task.usual)
    evaluated = {id(run.dataset) for run in runs}
    bare = [result for result in drop_duplicates(results) if id(result) not in evaluated]  # they only have metrics
    context = Context(task, methods, engine.comparisons(task, methods), bare, traces, runs)
    sentence, verdict = task.sentence(context) or screen.sentence(context)
    bare_folds = [fold for number, result in enumerate(bare, 1) for fold in metric_folds(result, number, len(bare))]
    folds = [
        *method_folds(context),
        *difference_folds(context),
        *paper_folds(context),
        *task.folds(context),
        *training_folds(context),
        *frames.frame_folds([outcome for run in runs[:1] for outcome in task.outcomes(run)], extra_datasets),
        *recording_folds(context),
        *run_folds(context),
        *bare_folds,
        *basis_folds(context),
        *source_folds(context),
    ]
    simulated = context.simulated or any(is_simulated(result) for result in bare)
    if not runs and bare:
        sentence = metrics_sentence(bare)
    return Section(
        task.name or "results",
        f"{task.title[:1].upper()}{task.title[1:]}" or "Results",
        sentence,
        verdict,
        screen.first_chart(context),
        screen.first_table(context),
        folds,
        simulated,
        _counts(context, results),
    )


def method_folds(context: Context) -> list[Fold]:
    """Return a fold with tables of all methods by family, then baselines, oracles and controls, one table per question."""
    tables = [_table(context, comparison) for comparison in context.comparisons]
    if not tables:
        return []
    measure = context.comparisons[0].measure
    note = blocks.notes(
        headline_caption(measure),
        (
            "p: p-value of the hypothesis that method and best baseline are equal (paired permutation test over the "
            "same clusters, with fixed seeds), not corrected for the number of methods."
        ),
        "Baselines come from the runs of one method, because they are the same for all methods of a split."
        if len(context.methods) > 1
        else "",
        "A number after a name is the number of other methods in its family.",
    )
    return fold("All methods and baselines", *tables, note, about=format_count(len(context.methods), "methods"))


def headline_caption(measure: Measure) -> str:
    """Return the meaning of a measure's columns, as notes below a table."""
    return (
        f"Units: {measure.unit}. {words.explain_gain(measure.name, measure.ranked_by)} Intervals are 95 % intervals "
        f"over {measure.cluster} (and seeds, if there are several), with method and baseline on the same "
        f"{measure.cluster}. They account for the choice of the best baseline; the sentence about the best method also "
        f"accounts for the choice of the method."
    )


def _table(context: Context, comparison: Comparison) -> Table:
    """Return the table of a comparison: methods by family, folded, then the other kinds of predictors."""
    task_columns = context.task.columns(context, comparison)
    families: dict[str, list[ComparisonRow]] = {}
    for row in comparison.models:
        families.setdefault(row.family, []).append(row)
    groups = [
        Group(
            [_line(comparison, row, task_columns, "best" if row is comparison.best else "") for row in rows],
            folded=len(rows) > 1,
        )
        for rows in families.values()
    ]
    for kind, title in KINDS.items():
        rows = comparison.of(kind)  # type: ignore[arg-type]
        if rows:
            groups.append(Group([_line(comparison, row, task_columns, "quiet") for row in rows], title))
    measure = comparison.measure
    scored = [] if _score_column(comparison) is not None else [measure.scored]
    gained = f"{words.GAINS[measure.name]} than the best baseline"
    heads = ["", *map(words.format_column, measure.columns), *scored, "sd over seeds", gained]
    heads += ["best baseline", "p", *(head for head, _ in task_columns), *_counts_of(comparison, comparison.rows[0])]
    return Table(comparison.question.where if len(context.comparisons) > 1 else "", heads, groups)


def _score_column(comparison: Comparison) -> int | None:
    """Return the index of the column that has the score, the last or the first, up to rounding; None if none has it."""
    scores = [row.score.mean for row in comparison.rows]
    for at in (len(comparison.measure.columns) - 1, 0):
        values = [row.values[at] for row in comparison.rows]
        if np.allclose(values, scores, rtol=1e-9, atol=1e-12, equal_nan=True):
            return at
    return None


def _line(
    comparison: Comparison,
    row: ComparisonRow,
    task_columns: Sequence[tuple[str, Callable[[ComparisonRow], Cell]]],
    kind: str,
) -> Line:
    """Return the line of a method or baseline in `_table`; ``extra`` are further columns, (head, function of the row)."""
    score, column = row.score, _score_column(comparison)
    name = "" if column is None else comparison.measure.columns[column]
    score_text, *ends = (words.format_value(name, value) for value in (score.mean, score.low, score.high))
    score_cell = Cell(score_text, "" if ends[0] == ends[1] else " to ".join(ends), number(score.mean).value)
    cells: list[str | Cell] = [row.name, *screen.error_cells(comparison.measure, row.values)]
    if column is None:
        cells.append(score_cell)
    else:
        cells[1 + column] = score_cell
    cells += [
        number(row.spread, 3),
        screen.gain_cell(comparison.measure, row.gain),
        row.baseline or NONE,
        p_value(row.p),
    ]
    cells += [make(row) for _, make in task_columns]
    cells += [Cell(f"{count:,}", value=count) for count in _counts_of(comparison, row).values()]
    return Line(cells, kind)


def _counts_of(comparison: Comparison, row: ComparisonRow) -> dict[str, int]:
    """Return the counts of a row by head: clusters, recordings if they are not the clusters of any row, and runs."""
    counts = {comparison.measure.cluster: row.n}
    if any(other.n != other.recordings for other in comparison.rows):
        counts["recordings"] = row.recordings
    return {**counts, "runs": row.runs}


def recording_folds(context: Context) -> list[Fold]:
    """Return a fold with the best method's errors on each recording, the worst first, with the command to view one."""
    recording_blocks: list[blocks.Block] = []
    for comparison in context.comparisons:
        row = context.row(comparison, context.winner(comparison.question.part))
        recording_blocks += _recording_table(comparison, row) if row else []
    if not recording_blocks:
        return []
    command = SmallPrint(
        "To view a recording with its predictions, run `tacpipe view DATASET RECORDING --predictions RESULT`, "
        "where DATASET was evaluated and RESULT is the output of `tacpipe evaluate`. Click a name to copy its "
        "command."
    )
    return [
        Fold(
            "Recordings",
            [command, *recording_blocks],
            "the worst recordings of the best method, with commands to view them",
        )
    ]


def _recording_table(comparison: Comparison, row: ComparisonRow) -> list[blocks.Block]:
    """Return a chart of a method's gain over the baseline by recording, and a table of the recordings with the worst errors.

    The chart is left out for three recordings or fewer.
    """
    measure, question = comparison.measure, comparison.question
    best = next((baseline for baseline in comparison.of("baseline") if baseline.name == row.baseline), None)
    model_sums = pairing.add_by_key((name, sums) for (_, name), sums in row.method.sums(question).items())
    sums_by_run = best.method.sums(question, best.predictor) if best else {}
    baseline_sums = pairing.add_by_key((name, sums) for (_, name), sums in sums_by_run.items())
    names = sorted(model_sums)
    errors, baseline_errors = (
        np.array([float(measure.error(sums[name][None])[0]) if name in sums else np.nan for name in names])
        for sums in (model_sums, baseline_sums)
    )
    gains = np.asarray(measure.gain(errors, baseline_errors), np.float64)
    worst_first = sorted(range(len(names)), key=lambda index: (np.isnan(errors[index]), -errors[index], names[index]))
    with_errors = [index for index in worst_first if errors[index] != 0]
    rows: list[Sequence[str | Cell]] = []
    for index in with_errors[:RECORDINGS]:
        name, gain = names[index], float(gains[index])
        values = screen.error_cells(measure, measure.values(model_sums[name]))
        baseline_cell = number(measure.values(baseline_sums[name])[0]) if name in baseline_sums else Cell(NONE)
        gain_cell = screen.gain_cell(measure, Gain(gain, math.nan, math.nan))
        rows.append(
            [Cell(name, copy=f"tacpipe view DATASET {name} --predictions RESULT"), *values, baseline_cell, gain_cell]
        )
    charts_of_gains: list[blocks.Block] = []
    defined = gains[~np.isnan(gains)]
    title = f"{question.where}: {row.name}"
    if len(defined) > 3 and measure.cluster == "recordings":
        best_first = [index for index in np.argsort(-gains, kind="stable") if not np.isnan(gains[index])]
        ranks = np.unique(np.linspace(0, len(best_first) - 1, min(len(best_first), DOTS)).astype(int))
        scale = 100.0 if measure.name == "skill" else 1.0
        dots = [
            {
                "x": float(x),
                "y": scale * float(gains[best_first[rank]]),
                "name": row.name,
                "tip": names[best_first[rank]],
            }
            for x, rank in enumerate(ranks, 1)
        ]
        quantity = screen.with_unit(f"{words.GAINS[measure.name]} than {row.baseline}{' (%)' if scale > 1 else ''}")
        spec = charts.scatter(
            dots, "rank of the recording (best first)", quantity, level=("", 0.0), legend=False, height=170
        )
        charts_of_gains.append(
            Chart(f"{title}, better than {row.baseline} on {int((defined > 0).sum())} of {len(defined)}", spec)
        )
    about = f"the {RECORDINGS} worst of {len(names):,}" if len(with_errors) > RECORDINGS else "the worst first"
    without_errors = (
        f"; {len(names) - len(with_errors):,} of {len(names):,} have no error" if len(with_errors) < len(names) else ""
    )
    baseline_head = f"{row.baseline}: {measure.columns[0]}" if row.baseline else ""
    heads = ["recording", *map(words.format_column, measure.columns), baseline_head, words.GAINS[measure.name]]
    if not rows:
        return [*charts_of_gains, SmallPrint(f"{title}: none of the {len(names):,} has an error.")]
    return [*charts_of_gains, blocks.table(f"{title}, {about}{without_errors}", heads, rows)]


def run_folds(context: Context) -> list[Fold]:
    """Return a fold with a table with one row per run."""
    rows: list[Sequence[str | Cell]] = []
    for method in context.methods:
        for run in sorted(method.runs, key=lambda run: (str(run.fold), str(run.seed))):
            cells: list[str | Cell] = [
                method.name,
                *(NONE if key is None else str(key) for key in (run.fold, run.seed)),
            ]
            for comparison in context.comparisons:
                errors = run.questions.get(comparison.question)
                sums = errors.sums.get(MODEL, {}) if errors else {}
                score = number(comparison.measure.score_of(sums.values())) if sums else NONE
                cells += [score, f"{len(sums):,}" if sums else NONE]
            epochs = max((line["epoch"] for line in history_of(run)), default=0)
            rows.append([*cells, str(epochs or NONE), *context.task.run_columns(run).values()])
    if not rows:
        return []
    heads: list[str] = ["", "fold", "seed"]
    for comparison in context.comparisons:
        heads += [f"{comparison.question.where}: {comparison.measure.scored}", "recordings"]
    heads += ["epochs", *context.task.run_columns(context.runs[0])]
    return fold("Every run", blocks.table("", heads, rows), about=format_count(len(rows), "runs"))


def basis_folds(context: Context) -> list[Fold]:
    """Return a fold with the basis and the limits of the numbers."""
    texts = list(context.task.caveats(context))
    texts += [PICKED] if len(context.methods) > 1 else []
    texts += [SIMULATED] if context.simulated else []
    texts += ["No evaluated recording was used to train its model."] if context.runs else []
    return [Fold("Basis and limits", [SmallPrint(text) for text in dict.fromkeys(texts) if text])] if texts else []


def source_folds(context: Context) -> list[Fold]:
    """Return a fold with the provenance of the best method's median run, or of the first result without comparisons."""
    if not context.comparisons:
        return [Fold("Where it comes from", provenance_blocks(result)) for result in context.bare[:1]]
    first = context.comparisons[0]
    method = context.winner(first.question.part) or context.methods[0]
    run = median_run(method, first)
    params = ", ".join(f"{name} = {json.dumps(value, default=str)}" for name, value in sorted(run.settings.items()))
    note = SmallPrint(f"A run of {method.name}{f', seed {run.seed}' if run.seed is not None else ''}, with {params}.")
    return [Fold("Where it comes from", [note, *provenance_blocks(run.dataset)])]


def _counts(context: Context, results: Sequence[Dataset]) -> list[str]:
    """Return the counts of methods, results (if there are several) and clusters, such as "40 recordings"."""
    counts = []
    if context.methods:
        counts.append(format_count(len(context.methods), "methods"))
    if len(results) > 1:
        counts.append(format_count(len(results), "results"))
    clusters: set[str] = set()
    for run in context.runs:
        for errors in run.questions.values():
            clusters.update((errors.clusters or {}).get(name, name) for name in errors.sums.get(MODEL, {}))
    if clusters:
        counts.append(format_count(len(clusters), context.comparisons[0].measure.cluster))
    return counts
