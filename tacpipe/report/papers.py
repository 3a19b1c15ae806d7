"""Show the numbers that a task's paper prints next to ours."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources

from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import MODEL
from tacpipe.io import Scalar
from tacpipe.report.blocks import NONE, Cell, Fold, fold, notes, number, table
from tacpipe.report.context import Context


@dataclass(frozen=True)
class PrintedNumber:
    """A number that a paper prints, and the method, question and column to which it corresponds."""

    name: str
    value: float
    unit: str
    source: str  # table or figure of the paper
    sd: float | None = None  # standard deviation over runs
    column: str = ""  # head of a column in the table of all methods; empty: shown without ours
    family: str = ""
    predictor: str = MODEL
    part: str = ""
    target: str = ""
    settings: Mapping[str, Scalar] = field(default_factory=dict)

    def is_of(self, row: ComparisonRow) -> bool:
        """Return whether a row is of the same method: a competing one, unless there are settings."""
        return (
            row.predictor == self.predictor
            and self.family in ("", row.method.family)
            and (bool(self.settings) or not row.method.control)
            and all(row.method.settings.get(name) == value for name, value in self.settings.items())
        )


@dataclass(frozen=True)
class Paper:
    """The numbers that the paper of a task prints."""

    paper: str  # authors, journal and year, or a description
    note: str
    numbers: tuple[PrintedNumber, ...]


@functools.cache
def read_papers() -> dict[str, Paper]:
    """Return the papers in ``papers.toml`` by task."""
    content = tomllib.loads((resources.files("tacpipe.report") / "papers.toml").read_text(encoding="utf-8"))
    papers = {}
    for task, described in content.items():
        numbers = []
        for printed in described["tables"]:
            common = {name: value for name, value in printed.items() if name != "numbers"}
            numbers += [PrintedNumber(**{**common, **fields}) for fields in printed["numbers"]]
        papers[task] = Paper(described["paper"], described["note"], tuple(numbers))
    return papers


def paper_folds(context: Context) -> list[Fold]:
    """Return a table of the paper's numbers next to ours; empty unless all recordings are those of the paper."""
    paper = read_papers().get(context.task.name)
    if paper is None or not context.published:
        return []
    rows: list[list[str | Cell]] = []
    for printed in paper.numbers:
        sd = "" if printed.sd is None else f" ± {printed.sd:g}"
        theirs = Cell(f"{printed.value:g}{sd}", value=printed.value)
        rows.append([printed.name, theirs, _our_cell(context, printed), printed.unit, printed.source])
    heads = ["", "paper", "ours", "unit", "printed in"]
    return fold("The paper's own numbers", table("", heads, rows), notes(paper.note), about=paper.paper)


def _our_cell(context: Context, printed: PrintedNumber) -> str | Cell:
    """Return our value of a number, above the name of the method; a dash if there is none."""
    for comparison in context.comparisons if printed.column else ():
        question = comparison.question
        if question.part.startswith(printed.part) and question.target == printed.target:
            for row in filter(printed.is_of, comparison.rows):
                cell = _cell_of_column(context, comparison, row, printed.column)
                return Cell(cell.text, row.name, cell.value)
    return NONE


def _cell_of_column(context: Context, comparison: Comparison, row: ComparisonRow, column: str) -> Cell:
    """Return the cell of a row in a column of the table of all methods."""
    if column in comparison.measure.columns:
        return number(row.values[comparison.measure.columns.index(column)])
    return dict(context.task.columns(context, comparison))[column](row)
