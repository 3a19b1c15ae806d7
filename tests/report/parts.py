"""Sections of a page as data: what tests read of them."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from tacpipe.comparison import engine
from tacpipe.comparison.runs import Method, grouped, report_on
from tacpipe.report import sections
from tacpipe.report.blocks import Block, Cell, Chart, Charts, Fold, Section, SmallPrint, Table
from tacpipe.report.context import Context, TaskReport


def section(task: str, *results: Any, others: Sequence[Any] = (), traces: int = 0) -> Section:
    """The section that a page has of results of one task."""
    return sections.section(report_on(task, TaskReport), results, others, traces)


def methods(task: str, *results: Any) -> list[Method]:
    """The methods that the page has of results of one task."""
    return context(task, *results).methods  # type: ignore[return-value]


def context(task: str, *results: Any) -> Context:
    """The results of one task, compared."""
    task_report = report_on(task, TaskReport)
    runs = task_report.read(results)
    method_list = grouped(runs, task_report.usual)
    return Context(task_report, method_list, engine.comparisons(task_report, method_list), runs=runs)


def blocks(page_part: Section | Iterable[Block]) -> Iterator[Block]:
    """All blocks, those of folds too."""
    if isinstance(page_part, Section):
        yield from (block for block in (page_part.chart, page_part.table) if block)
        page_part = page_part.folds
    for block in page_part:
        yield block
        if isinstance(block, Fold):
            yield from blocks(block.blocks)
        elif isinstance(block, Charts):
            yield from block.charts


def charts(page_part: Section | Iterable[Block]) -> list[Chart]:
    return [block for block in blocks(page_part) if isinstance(block, Chart)]


def tables(page_part: Section | Iterable[Block]) -> list[Table]:
    return [block for block in blocks(page_part) if isinstance(block, Table)]


def folds(task_section: Section) -> dict[str, Fold]:
    return {section_fold.title: section_fold for section_fold in task_section.folds}


def text(cell: str | Cell) -> str:
    """Return the text of a cell, with small print behind a bar."""
    return cell if isinstance(cell, str) else f"{cell.text} | {cell.below}" if cell.below else cell.text


def cells(page_tables: Table | Iterable[Table], name: str) -> list[str]:
    """The cells of the first row that begins with ``name``."""
    for table in [page_tables] if isinstance(page_tables, Table) else page_tables:
        for row in table.rows:
            if text(row.cells[0]) == name:
                return [text(row_cell) for row_cell in row.cells[1:]]
    raise AssertionError(name)


def cell(table: Table, name: str, head: str) -> str:
    return dict(zip(table.heads[1:], cells(table, name), strict=True))[head]


def words(page_part: Section | Iterable[Block]) -> str:
    """All that a section says, but for the data of charts."""
    texts = [page_part.title, page_part.sentence, *page_part.counts] if isinstance(page_part, Section) else []
    for block in blocks(page_part):
        if isinstance(block, Fold):
            texts += [block.title, block.about]
        elif isinstance(block, SmallPrint):
            texts.append(block.text)
        elif isinstance(block, Chart):
            texts += [block.title, block.caption]
        elif isinstance(block, Table):
            texts += [block.title, *block.heads, *(text(cell) for row in block.rows for cell in row.cells)]
            texts += [group.title for group in block.groups]
    return "\n".join(texts)


def values(chart: Chart) -> list[dict[str, Any]]:
    """The rows of a chart's own data."""
    rows: list[dict[str, Any]] = chart.spec["data"]["values"]
    return rows
