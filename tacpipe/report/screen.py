"""The first screen of a section: one sentence, one chart, and one table of at most seven rows."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tacpipe.comparison import engine
from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.printable import format_count
from tacpipe.report import charts
from tacpipe.report.blocks import NONE, Cell, Chart, Table, number
from tacpipe.report.blocks import table as table_of
from tacpipe.report.charts import Dot
from tacpipe.report.context import Context
from tacpipe.scores import headline, words
from tacpipe.scores.pairing import Gain, Measure

MAX_ROWS = 7  # maximum number of rows in the table
SHOWN = 4  # number of methods, and of baselines, in a chart


def sentence(context: Context) -> tuple[str, str]:
    """Return a sentence about the best method and its gain over the best baseline, and the verdict.

    Both are empty if there are no methods. The verdict is `headline.UNCLEAR` if parts or targets have different verdicts.
    """
    clauses: list[str] = []
    verdicts: list[str] = []
    last_name = ""
    for part, comparisons in context.parts.items():
        method = context.winner(part)
        compared = [
            found
            for comparison in comparisons
            if (row := context.row(comparison, method)) is not None and (found := engine.headline(row, comparison))
        ]
        if not compared or method is None:
            continue
        # "it" refers to the method of the previous clause
        name = "it" if method.name == last_name else method.name
        last_name = method.name
        verdicts += [found.verdict for found in compared]
        where = f"on {part}, " if part else ""
        clauses.append(f"{where}{name} {words.clause_of_targets(compared)}")
    if not clauses:
        return "", ""
    text = "; ".join(clauses[:2])
    verdict = verdicts[0] if len(set(verdicts)) == 1 else headline.UNCLEAR
    return f"{words.capitalize(text)}.", verdict


def first_chart(context: Context) -> Chart | None:
    """Return a chart of the best methods and baselines with their intervals, or None if there are no methods.

    It has one panel per question. With more than two questions, each panel has only the best method and baseline.
    """
    dots: list[Dot] = []
    levels: dict[str, float] = {}
    comparisons = _questions(context)
    has_panels = len(comparisons) > 2
    for comparison in comparisons:
        panel = ""
        if len(comparisons) > 1:
            panel = comparison.question.target if has_panels else comparison.question.where
        methods = comparison.models[: 1 if has_panels else SHOWN]
        if has_panels and (winner := context.row(comparison, context.winner(comparison.question.part))):
            methods = [winner]
        best = comparison.best_baseline
        baselines = [row for row in comparison.of("baseline") if row is not best][: 0 if has_panels else 2]
        shown_rows = [*methods, *([best] if best else []), *baselines]
        sign = -1 if comparison.measure.rises else 1
        for row in sorted(shown_rows, key=lambda row: (math.isnan(row.score.mean), sign * row.score.mean)):
            score = row.score
            dots += [Dot(row.name, score.mean, score.low, score.high, row.kind, panel)]
        if best:
            levels[panel] = best.score.mean
    if not any(dot.kind == "model" for dot in dots):
        return None
    measure = comparisons[0].measure
    better = "right" if measure.rises else "left"
    kinds = {dot.kind for dot in dots}
    drawn = ["Blue: methods", *(["grey: baselines"] if "baseline" in kinds else [])]
    drawn += ["dashed: the best baseline"] if levels else []
    drawn += ["bars: 95 % intervals"] if any(dot.low < dot.high for dot in dots) else []
    part = f", {comparisons[0].question.part}" if has_panels and comparisons[0].question.part else ""
    spec = charts.ranking(dots, with_unit(measure.scored), level=levels, row=20 if has_panels else 24)
    if any(row["off"] or row["on_left"] or row["on_right"] for row in spec["data"]["values"]):
        drawn.append("triangles: beyond the axis")
    caption = f"{'; '.join(drawn)}. Values further to the {better} are better."
    return Chart(words.capitalize(f"{measure.scored}{part}"), spec, caption)


def with_unit(quantity: str) -> str:
    """Return the title of an axis, which names a quantity and its unit.

    >>> with_unit("accuracy (%)"), with_unit("skill")
    ('accuracy (%)', 'skill (no unit)')
    """
    if quantity.endswith(")"):
        return quantity
    return f"{quantity} ({'percentage points' if quantity.startswith('points') else 'no unit'})"


def first_table(context: Context) -> Table | None:
    """Return a table with the best methods and baselines, or None if there are no methods.

    With several targets, the table has one row per target, for its best method.
    """
    parts = dict(list(context.parts.items())[:2])
    if not any(comparison.models for compared in parts.values() for comparison in compared):
        return None
    targets = list(dict.fromkeys(comparison.question.target for compared in parts.values() for comparison in compared))
    if len(targets) > 1:
        return _table_by_target(context, parts, targets)
    first_comparisons = [compared[0] for compared in parts.values()]
    leaders = [row.name for comparison in first_comparisons for row in _leaders(comparison)]
    names = list(dict.fromkeys(leaders))[: MAX_ROWS - 2]
    best_baselines = [first.best_baseline.name for first in first_comparisons if first.best_baseline]
    references = [
        row.name for first in first_comparisons for row in first.of("baseline") if row.name == first.measure.reference
    ]
    baselines = list(dict.fromkeys(best_baselines + references))[: MAX_ROWS - len(names)]
    single = len(first_comparisons) == 1
    heads, kinds = [""], dict[int, str]()
    rows: list[Sequence[str | Cell]] = []
    for comparison in first_comparisons:
        heads += _heads(comparison, single)
    for name in [*names, *baselines]:
        cells: list[str | Cell] = [name]
        for comparison in first_comparisons:
            row = next((row for row in comparison.rows if row.name == name), None)
            cells += _cells(comparison, row, single)
        if name in baselines:
            kinds[len(rows)] = "quiet"
        rows.append(cells)
    if names:
        kinds[0] = "best"
    remaining = len({row.name for comparison in first_comparisons for row in comparison.models}) - len(names)
    title = "Best methods and the best baseline" + (
        f"; {format_count(remaining, 'more methods')} below" if remaining > 0 else ""
    )
    return table_of(title, heads, rows, kinds)


def _table_by_target(context: Context, parts: dict[str, list[Comparison]], targets: Sequence[str]) -> Table:
    """Return a table with a row per target: the best method of each part, the best baseline, and the gain."""
    heads = [""]
    for part, compared in parts.items():
        method = context.winner(part)
        name = method.name if method else ""
        heads += [f"{part}: {name}" if part else name, "best baseline", words.GAINS[compared[0].measure.name]]
    rows: list[Sequence[str | Cell]] = []
    for target in targets[:MAX_ROWS]:
        cells: list[str | Cell] = [target]
        for part, compared in parts.items():
            comparison = next((comparison for comparison in compared if comparison.question.target == target), None)
            row = context.row(comparison, context.winner(part)) if comparison else None
            if comparison is None or row is None:
                cells += [NONE] * 3
                continue
            best = next((base for base in comparison.of("baseline") if base.name == row.baseline), None)
            cells += [
                number(row.values[0]),
                Cell(number(best.values[0]).text, best.name) if best else NONE,
                gain_cell(comparison.measure, row.gain),
            ]
        rows.append(cells)
    measure = next(iter(parts.values()))[0].measure
    return table_of(f"{words.capitalize(measure.columns[0])} by target, next to the best baseline", heads, rows)


def gain_cell(measure: Measure, gain: Gain) -> Cell:
    """Return the cell of a gain with its interval below."""
    if math.isnan(gain.mean):
        return Cell(NONE)
    below = words.format_interval(gain.low, gain.high, measure.name) if gain.low != gain.high else ""
    return Cell(words.format_gain(gain.mean, measure.name), below, gain.mean)


def error_cells(measure: Measure, values: Sequence[float]) -> list[Cell]:
    """Return the cells of the columns of a measure."""
    return [
        Cell(text, value=None if math.isnan(value) else value)
        for text, value in zip(words.cells(measure.columns, values), values, strict=True)
    ]


def _questions(context: Context) -> list[Comparison]:
    """Return the comparisons for the chart: the first two parts, or all targets of one part."""
    parts = list(context.parts.values())
    has_several_targets = any(len(part) > 1 for part in parts)
    return parts[0] if parts and has_several_targets else [compared[0] for compared in parts[:2]]


def _leaders(comparison: Comparison) -> list[ComparisonRow]:
    """Return the best method of each family, then the best of the others, in the order of the comparison."""
    best_by_family: dict[str, ComparisonRow] = {}
    for row in comparison.models:
        best_by_family.setdefault(row.family, row)
    best_rows = list(best_by_family.values())[: MAX_ROWS - 2]
    leading_names = {row.name for row in best_rows}
    leading_names |= {row.name for row in comparison.models[: MAX_ROWS - 2 - len(best_rows)]}
    next_rows = [row for row in comparison.models if row.name not in leading_names][
        : max(MAX_ROWS - 2 - len(leading_names), 0)
    ]
    return [row for row in comparison.models if row.name in leading_names or row in next_rows]


def _heads(comparison: Comparison, single: bool) -> list[str]:
    """Return the heads of a comparison's columns in the first table; ``single`` is whether it is the table's only one."""
    measure = comparison.measure
    columns = list(measure.columns[-2:]) if single else [measure.columns[-1]]
    prefix = "" if single or not comparison.question.part else f"{comparison.question.part}: "
    return [
        *(f"{prefix}{words.format_column(name)}" for name in columns),
        f"{prefix}{words.GAINS[measure.name]} than the best baseline",
        *(["n"] if single else []),
    ]


def _cells(comparison: Comparison, row: ComparisonRow | None, single: bool) -> list[str | Cell]:
    """Return the cells of a method or baseline below `_heads`; dashes if it has no ``row``."""
    if row is None:
        return [NONE] * len(_heads(comparison, single))
    errors = error_cells(comparison.measure, row.values)
    count = [Cell(f"{row.n:,}", value=row.n)] if single else []
    compared = gain_cell(comparison.measure, row.gain) if row.baseline else Cell("")
    return [*(errors[-2:] if single else errors[-1:]), compared, *count]
