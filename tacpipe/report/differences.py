"""Compare methods that differ in one setting on the recordings of both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tacpipe.comparison import engine
from tacpipe.comparison.engine import Comparison
from tacpipe.comparison.runs import MODEL, Method
from tacpipe.io import Scalar
from tacpipe.report import screen
from tacpipe.report.blocks import Cell, Fold, SmallPrint, Table, fold, table
from tacpipe.report.context import Context
from tacpipe.scores import words

MAX_ROWS = 40  # maximum number of pairs in a table
NOTE = (
    "Gain of the first value over the second, as measured on the recordings of both methods, with the 95 % interval. If "
    "the interval contains 0, the results do not show an effect of the setting."
)


def difference_folds(context: Context) -> list[Fold]:
    """Return a table per question of the effects of single settings; empty if no two methods differ in only one."""
    tables = [effects for comparison in context.comparisons if (effects := _difference_table(comparison))]
    return fold("Effects of settings", *tables, SmallPrint(NOTE))


def pairs_by_setting(methods: Sequence[Method]) -> Iterator[tuple[str, Method, Method]]:
    """Yield each setting with the methods that differ only in it: the earliest method of each group, and another."""
    for setting in sorted({name for method in methods for name in method.settings}):
        remaining = list(methods)
        while remaining:
            first = remaining.pop(0)
            others = [method for method in remaining if _differ_only_in(setting, first, method)]
            remaining = [method for method in remaining if method not in others]
            yield from ((setting, first, other) for other in others)


def _differ_only_in(name: str, first: Method, second: Method) -> bool:
    """Return whether two methods of the same architecture agree on all settings that both have, except ``name``."""
    if first.settings.get("architecture", first.family) != second.settings.get("architecture", second.family):
        return False
    common = first.settings.keys() & second.settings.keys()
    return {setting for setting in common if first.settings[setting] != second.settings[setting]} == {name}


def _difference_table(comparison: Comparison) -> Table | None:
    """Return the table of a question; None if there are no pairs."""
    measure = comparison.measure
    rows: list[list[str | Cell]] = []
    for setting, first, second in pairs_by_setting([row.method for row in comparison.rows if row.predictor == MODEL]):
        gain = engine.difference(first, second, comparison.question)
        if gain.clusters:
            values = (_format_setting(method.settings[setting]) for method in (first, second))
            name = f"{setting.replace('_', ' ')}: {' instead of '.join(values)}"
            cells = [screen.gain_cell(measure, gain), Cell(f"{gain.clusters:,}", value=gain.clusters)]
            rows.append([name, first.name, *cells])
    heads = ["", "method", words.GAINS[measure.name], measure.cluster]
    return table(comparison.question.where, heads, rows[:MAX_ROWS]) if rows else None


def _format_setting(value: Scalar) -> str:
    """Return the value of a setting as text."""
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value) or "none"
