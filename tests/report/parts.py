"""Sections of a page as data: what tests read of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from tacpipe.comparison import engine
from tacpipe.comparison.runs import Method, grouped
from tacpipe.comparison.specification import report_on
from tacpipe.report import sections
from tacpipe.report.blocks import Block, Cell, Chart, Charts, Fold, Note, Section, Table
from tacpipe.report.context import Context


def section(task: str, *results: Any, others: Sequence[Any] = (), traces: int = 0) -> Section:
    """The section that a page has of results of one task."""
    return sections.section(report_on(task), results, others, traces)


def methods(task: str, *results: Any) -> list[Method]:
    """The methods that the page has of results of one task."""
    return context(task, *results).methods  # type: ignore[return-value]


def context(task: str, *results: Any) -> Context:
    """The results of one task, compared."""
    of = report_on(task)
    runs = of.read(results)
    found = grouped(runs, of.usual)
    return Context(of, found, engine.comparisons(of, found), runs=runs)


def blocks(given: Section | Iterable[Block]) -> Iterator[Block]:
    """All blocks, those of folds too."""
    if isinstance(given, Section):
        yield from (one for one in (given.chart, given.table) if one)
        given = given.folds
    for one in given:
        yield one
        if isinstance(one, Fold):
            yield from blocks(one.blocks)
        elif isinstance(one, Charts):
            yield from one.charts


def charts(given: Section | Iterable[Block]) -> list[Chart]:
    return [one for one in blocks(given) if isinstance(one, Chart)]


def tables(given: Section | Iterable[Block]) -> list[Table]:
    return [one for one in blocks(given) if isinstance(one, Table)]


def folds(given: Section) -> dict[str, Fold]:
    return {one.title: one for one in given.folds}


def text(cell: str | Cell) -> str:
    """What a cell shows, small print behind a bar."""
    return cell if isinstance(cell, str) else f"{cell.text} | {cell.below}" if cell.below else cell.text


def cells(given: Table | Iterable[Table], name: str) -> list[str]:
    """The cells of the first row that begins with ``name``."""
    for table in [given] if isinstance(given, Table) else given:
        for row in table.rows:
            if text(row.cells[0]) == name:
                return [text(one) for one in row.cells[1:]]
    raise AssertionError(name)


def cell(table: Table, name: str, head: str) -> str:
    return dict(zip(table.heads[1:], cells(table, name), strict=True))[head]


def words(given: Section | Iterable[Block]) -> str:
    """All that a section says, but for the data of charts."""
    found = [given.title, given.sentence, *given.counts] if isinstance(given, Section) else []
    for one in blocks(given):
        if isinstance(one, Fold):
            found += [one.title, one.about]
        elif isinstance(one, Note):
            found.append(one.text)
        elif isinstance(one, Chart):
            found += [one.title, one.caption]
        elif isinstance(one, Table):
            found += [one.title, *one.heads, *(text(cell) for row in one.rows for cell in row.cells)]
            found += [group.title for group in one.groups]
    return "\n".join(found)


def values(chart: Chart) -> list[dict[str, Any]]:
    """The rows of a chart's own data."""
    found: list[dict[str, Any]] = chart.spec["data"]["values"]
    return found
