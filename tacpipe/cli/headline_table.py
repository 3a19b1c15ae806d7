"""Read a result's headlines from the store and print them, in colour on a terminal and otherwise as plain text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tacpipe.datasets import manifest
from tacpipe.io import terminal
from tacpipe.io.terminal import RowGroup, TerminalRow, TerminalTable
from tacpipe.metrics import headline
from tacpipe.metrics.headline import Headline
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import ParamValue
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


def table(headlines: Sequence[Headline]) -> TerminalTable:
    """Return a table of headlines with a group of rows per headline: the model, its best baseline, and other baselines."""
    first = headlines[0]
    heads = ["", *first.columns, first.measure, "95 % interval", "n"]
    groups = []
    for entry in headlines:
        styles = {headline.BETTER: "green", headline.WORSE: "red"}
        gain = headline.format_gain(entry.gain, entry.measure) if entry.best else headline.NONE
        interval = headline.bounds(entry) or headline.NONE
        cells = [entry.method, *map(headline.number, entry.model.values), gain, interval]
        rows = [TerminalRow([*cells, f"{entry.clusters:,}"], styles.get(entry.verdict, ""))]
        if entry.best:
            values = map(headline.number, entry.best.values)
            rows.append(
                TerminalRow(
                    [f"vs {entry.best.name.replace('_', ' ')}", *values, "", _VERDICTS[entry.verdict], ""], "dim"
                )
            )
            baselines = [row for row in entry.table_baselines if row is not entry.best]
            rows += [TerminalRow([row.name, *map(headline.number, row.values), "", "", ""], "dim") for row in baselines]
        groups.append(RowGroup(entry.where, rows))
    errors = list(range(1, len(first.columns)))  # The last column ranks the results.
    return TerminalTable(
        heads, groups, caption(headlines), spare=[*errors[1:-1], *errors[-1:], *errors[:1]][: len(errors)]
    )


def caption(headlines: Sequence[Headline]) -> str:
    """Explain the columns, the unit of n, and the number of baselines from which the best was chosen."""
    counts = dict.fromkeys(len(entry.baselines) for entry in headlines if entry.baselines)
    best = f"vs: the best of {' or '.join(map(str, counts))} baselines. " if counts else ""
    return f"n: {', '.join(dict.fromkeys(entry.cluster for entry in headlines))}. {best}{headline.caption(headlines)}"


_VERDICTS = {
    headline.BETTER: "model is better",
    headline.WORSE: "baseline is better",
    headline.UNCLEAR: "no difference",
    headline.NO_VERDICT: "n is too small",
}


def text(headlines: Sequence[Headline], width: int = terminal.WIDTH) -> str:
    """Return headlines as lines of text: their table, or a sentence if there are none."""
    return table(headlines).text(width) if headlines else EMPTY


def show(headlines: Sequence[Headline]) -> None:
    """Print headlines to stderr, or that there are none."""
    if headlines:
        terminal.show(table(headlines), on_stdout=False)
    else:
        terminal.note(EMPTY)
