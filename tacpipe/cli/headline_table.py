"""Read a result's headlines from the store and print them, in colour on a terminal and otherwise as plain text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tacpipe.datasets import manifest
from tacpipe.io import terminal
from tacpipe.io.terminal import RowGroup, TerminalRow, TerminalTable
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import ParamValue
from tacpipe.scores import headline, words
from tacpipe.scores.headline import Headline
from tacpipe.store.location import locate

EMPTY = "All recordings were used for training or contain no window, so there is nothing to evaluate."


def of_output(output: Path, file: str) -> list[Headline] | None:
    """Return the headlines in ``file`` of the dataset at ``output`` after verification, or None if there is no such file."""
    entry = manifest.find(output).manifest.files.get(file)
    return read(locate(output).read(entry["digest"])) if entry else None


def read(content: bytes) -> list[Headline]:
    """Return the headlines in a file, with current method names, which may have changed since they were stored."""
    return [replace(entry, method=method(entry.task, entry.method)) for entry in headline.read(content)]


def method(task: object, stored: ParamValue) -> str:
    """Return the current name of a task's method, whose architecture may have been renamed since it was stored."""
    return str(params_of.with_current_names(f"train.{task}", {"architecture": stored})["architecture"])


def table(headlines: Sequence[Headline], *, legend: bool = True) -> TerminalTable:
    """Return a table of headlines with a group of rows per headline: the model, its best baseline, and other baselines.

    The legend explains the columns, the unit of n, and the number of baselines from which the best was chosen.
    """
    first = headlines[0]
    heads = ["", *words.heads(first.columns, first.measure), "95 % interval", "n"]
    groups = []
    for entry in headlines:
        styles = {headline.BETTER: "green", headline.WORSE: "red"}
        gain = words.format_gain(entry.gain, entry.measure) if entry.best else words.NONE
        cells = [entry.method, *words.cells(first.columns, entry.model.values), gain, words.bounds(entry) or words.NONE]
        rows = [TerminalRow([*cells, f"{entry.clusters:,}"], styles.get(entry.verdict, ""))]
        if entry.best:
            values, name = words.cells(first.columns, entry.best.values), entry.best.name.replace("_", " ")
            rows.append(TerminalRow([f"than {name}", *values, "", words.CELLS[entry.verdict], ""], "dim"))
            baselines = [row for row in entry.table_baselines if row is not entry.best]
            cells_of_baselines = [[row.name, *words.cells(first.columns, row.values), "", "", ""] for row in baselines]
            rows += [TerminalRow(cells, "dim") for cells in cells_of_baselines]
        groups.append(RowGroup(entry.where, rows))
    errors = list(range(1, len(first.columns)))  # The last column ranks the results.
    spare = [*errors[1:-1], *errors[-1:], *errors[:1]][: len(errors)]
    return TerminalTable(heads, groups, explain(headlines) if legend else "", spare=spare)


def explain(headlines: Sequence[Headline]) -> str:
    """Return the legend of a table of headlines."""
    counts = dict.fromkeys(len(entry.baselines) for entry in headlines if entry.baselines)
    best = f"Than: the best of {' or '.join(map(str, counts))} baselines. " if counts else ""
    return f"n: {', '.join(dict.fromkeys(entry.cluster for entry in headlines))}. {best}{words.legend(headlines)}"


def text(headlines: Sequence[Headline], width: int = terminal.WIDTH) -> str:
    """Return headlines as lines of text: their sentences and their table, or a sentence if there are none."""
    return "\n".join([*words.summary(headlines), "", table(headlines).text(width)]) if headlines else EMPTY


def show(headlines: Sequence[Headline], output: Path) -> None:
    """Print the sentences and the table of the headlines of a result to stderr, or that there are none."""
    if not headlines:
        terminal.note(EMPTY)
        return
    for line in words.summary(headlines):
        terminal.note(line)
    terminal.show(table(headlines, legend=False), on_stdout=False)
    terminal.note(f"tacpipe show {output} explains the columns.")
