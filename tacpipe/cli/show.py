"""Describe a dataset: streams of recordings, roles of a split, a model's training data, or a result's headline.

What is shown depends on the contents of the dataset, not on the stage that created it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypedDict

from tacpipe import printable
from tacpipe.channels import streams
from tacpipe.channels.schema import TRUTH
from tacpipe.cli import model_overview, show_recording
from tacpipe.cli.description import files_text, flat, further
from tacpipe.cli.show_recording import RATES, StreamFigures, stream_figures, streams_table
from tacpipe.datasets import directory as directory_of
from tacpipe.datasets import lineage
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.lineage import CountedRows
from tacpipe.datasets.selection import RecordingAttributes
from tacpipe.engine import execution
from tacpipe.io.terminal import RowGroup, TerminalRow, TerminalTable
from tacpipe.plugins import params as params_of
from tacpipe.plugins.rows import TABLE_HEADS, table_of_rows
from tacpipe.plugins.stage import ROLES, Attribute, StoredParams
from tacpipe.printable import format_count
from tacpipe.recording import spool_folders
from tacpipe.store.location import locate
from tacpipe.store.store import Store

SHOWN = 20  # maximum number of recordings that are listed; further ones are counted
# maximum number of stored bytes to read; further streams are listed with only their number of rows
READ_BYTES = 1 << 28
_SPLIT = ("recording", "fold", "role")  # columns of a split


class DatasetOverview(TypedDict):
    """Entries for every dataset: stage, files and sizes."""

    stage: str
    digest: str
    skipped: dict[str, str]  # reasons by recording
    files: dict[str, int]  # sizes in bytes
    bytes: int
    rows: int
    counted: CountedRows  # rows that were read to produce the dataset


class ShownModel(DatasetOverview, model_overview.ModelOverview):
    """Overview of a model."""

    kind: Literal["model"]


class ShownResult(DatasetOverview, model_overview.ResultOverview):
    """Overview of an evaluation result."""

    kind: Literal["result"]


class ShownExport(DatasetOverview):
    """Overview of files for other tools."""

    kind: Literal["export"]


class ShownSplit(DatasetOverview):
    """Overview of a split."""

    kind: Literal["split"]
    params: StoredParams
    folds: dict[str, dict[str, int]]  # number of recordings by fold and role


class ShownRecordings(DatasetOverview):
    """Overview of recordings with figures and labels."""

    kind: Literal["recordings"]
    recordings: dict[str, dict[str, StreamFigures]]  # figures by recording and stream
    attributes: Mapping[str, Mapping[str, Attribute]]
    excluded: dict[str, str]  # reasons by recording


Shown = ShownModel | ShownResult | ShownExport | ShownSplit | ShownRecordings | show_recording.RecordingOverview


def of(path: Path, *, most: int | None = None) -> Shown:
    """Return an overview of the dataset at ``path``: its ``kind``, files, and entries that depend on the kind.

    The kind is recordings, split, model, result or export. The overview of recordings contains labels and each stream's
    figures, for the first ``most`` recordings by name (None: all); only their shards are read, and labels are read on
    access if ``most`` is not None. The overview of a split contains the recordings by fold and role, and that of a
    model or result the output of `tacpipe.cli.model_overview`. Raises `UsageError` if there is no dataset.
    """
    stored = manifest_of.find(path)
    store = locate(stored.directory)
    opened = Dataset(stored.manifest, execution.reader(store, (str(stored.directory.absolute()),), stored.manifest))
    about = _common_overview(opened, directory_of.stored_key(store, stored.directory.absolute()), store)
    if model_overview.is_result(opened):
        return {"kind": "result", **about, **model_overview.of_result(opened, stored, store)}
    if model_overview.is_model(opened):
        return {"kind": "model", **about, **model_overview.of_model(opened, store)}
    if opened.source.exported:
        return {"kind": "export", **about}
    folds = _folds(opened)
    if folds:
        return {
            "kind": "split",
            **about,
            "params": params_of.with_current_names(opened.source.stage, opened.source.params),
            "folds": folds,
        }
    attributes: Mapping[str, Mapping[str, Attribute]] = RecordingAttributes(opened)
    if most is None:
        attributes = {name: dict(labels) for name, labels in attributes.items()}
    return {
        "kind": "recordings",
        **about,
        "recordings": _figures(opened, list(islice(opened.recordings, most)), None if most is None else READ_BYTES),
        "attributes": attributes,
        "excluded": {name: str(reason) for name, reason in opened.source.excluded.items()},
    }


def _common_overview(opened: Dataset, key: str, store: Store) -> DatasetOverview:
    """Return the entries of an overview that every kind of dataset has; ``key`` names its run in ``store``."""
    manifest = opened.source
    return {
        "stage": manifest.stage,
        "digest": manifest.digest,
        "skipped": dict(manifest.skipped),
        "files": {name: file["bytes"] for name, file in manifest.files.items()},
        "bytes": manifest.shard_bytes,
        "rows": manifest.rows,
        "counted": lineage.counted_rows(store, manifest, key),
    }


def _folds(opened: Dataset) -> dict[str, dict[str, int]]:
    """Return the number of recordings with each role by fold, or an empty mapping if the dataset is not a split."""
    if len(opened) != 1 or (shard := next(iter(opened))).streams != ("",):
        return {}
    table = shard.table()
    if not set(_SPLIT) <= set(table.column_names):
        return {}
    folds: dict[str, dict[str, int]] = {}
    for fold, role in zip(table["fold"].to_pylist(), table["role"].to_pylist(), strict=True):
        counts = folds.setdefault(str(fold), {})
        counts[str(role)] = counts.get(str(role), 0) + 1
    return folds


def _figures(opened: Dataset, names: Sequence[str], most_bytes: int | None) -> dict[str, dict[str, StreamFigures]]:
    """Return each stream's figures by recording; only its rows once ``most_bytes`` bytes were read (None: no limit)."""
    figures: dict[str, dict[str, StreamFigures]] = {}
    left_bytes = most_bytes or 0
    for name in names:
        recording = opened.recordings[name]
        figures[name] = {}
        for stream in recording.streams:
            figures[name][stream] = {"rows": recording.rows[stream]}
            if most_bytes is not None:
                if recording.sizes[stream] > left_bytes:
                    continue
                left_bytes -= recording.sizes[stream]
            columns = recording.columns(stream)
            figures[name][stream] = stream_figures(columns, streams.read_clocks(columns))
    return figures


def to_text(value: Shown, *, full: bool = False) -> str:
    """Return the overview as lines, with limited lists unless ``full``: streams of recordings, labels, files and totals."""
    if value["kind"] == "recording":
        return show_recording.to_text(value, full=full)
    if value["kind"] == "recordings":
        return printable.lines(_recordings_text(value, full))
    lines: list[str] = []
    if value["kind"] == "model" or value["kind"] == "result":
        lines = model_overview.to_text(value)
    elif value["kind"] == "split":
        lines = _split_text(value)
    origin = f"{value['kind']}, made by {value['stage']} [{value['digest'][:12]}]"
    lines += [*_rows_lines(value["counted"]), *files_text(value["files"], full=full), origin]
    return printable.lines(lines)


def _rows_lines(counted: CountedRows) -> list[str]:
    """Return the table of the rows that were read, by stage and stream, and the number of results without counts."""
    lines: list[str] = []
    if rows := [TerminalRow(row) for row in table_of_rows(counted["stages"])]:
        lines = ["", *TerminalTable(TABLE_HEADS, [RowGroup("", rows)], left=(0, 1, 4)).text().splitlines(), ""]
    uncounted = counted["uncounted"]
    return [*lines, *([f"rows read: not counted for {format_count(uncounted, 'results')}"] if uncounted else [])]


def _recordings_text(value: ShownRecordings, full: bool) -> list[str]:
    """Return the lines of an overview of recordings: a table of streams, the labels, excluded recordings, files, totals."""
    listed_names, count = sorted(value["recordings"]), len(value["attributes"])
    lines = streams_table({name: value["recordings"][name] for name in listed_names}).text().splitlines()
    if count > len(listed_names):
        lines.append(further(count - len(listed_names)))
    every_stream = [figures for name in listed_names for figures in value["recordings"][name].values()]
    if any("rate_hz" in figures for figures in every_stream):
        lines.append(RATES)
    if unread := sum("columns" not in figures for figures in every_stream):
        lines.append(
            f"{format_count(unread, 'streams')} too long to read here: `tacpipe show DATASET RECORDING`, or --full"
        )
    labels = _Labels()
    incomplete = spool_folders.describe_incomplete(labels.counting(value["attributes"].items()), value["recordings"])
    lines += [*_rows_lines(value["counted"]), "", *labels.lines(full)]
    lines += [f"excluded: {line}" for line in printable.grouped_failures(value["excluded"])]
    lines += incomplete
    lines += [f"left out: {line}" for line in printable.grouped_failures(value["skipped"])]
    lines += files_text(value["files"], full=full) if value["files"] else []
    lines.append(
        f"{format_count(count, 'recordings')}, {value['rows']} rows, {value['bytes'] / 1e6:.1f} MB, "
        f"made by {value['stage']} [{value['digest'][:12]}]"
    )
    return lines


def _split_text(value: ShownSplit) -> list[str]:
    """Return lines with the number of recordings per role, one line per fold, and the split's params."""
    existing = {role for counts in value["folds"].values() for role in counts}
    roles = [*(role for role in ROLES if role in existing), *sorted(existing.difference(ROLES))]
    rows = [
        TerminalRow((fold, *(str(counts.get(role, 0)) for role in roles))) for fold, counts in value["folds"].items()
    ]
    table = TerminalTable(("fold", *roles), [RowGroup("", rows)])
    return [*table.text().splitlines(), f"params: {flat(value['params'])}"]


class _Values:
    """Summary of a label's values: the count of each value, or the range if all are numbers with fractions."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()  # values without a fraction
        self._floats: Counter[str] = Counter()  # fractional numbers, the first few
        self._is_numeric = True
        self._least, self._most = float("inf"), float("-inf")

    def add(self, value: Any) -> None:
        """Add the label's value in another recording."""
        if isinstance(value, int | float):
            self._least, self._most = min(self._least, value), max(self._most, value)
        if not isinstance(value, float):
            self._counts[str(value)] += 1
            self._is_numeric &= isinstance(value, int) and not isinstance(value, bool)
        elif len(self._floats) <= SHOWN:
            self._floats[str(value)] += 1

    def __str__(self) -> str:
        """Return the range, or each value with its count, or the number of values if there are many."""
        if self._floats and self._is_numeric:
            return f"{self._least:g} to {self._most:g}"
        counts = self._counts + self._floats
        if len(counts) > SHOWN:
            return f"{'over ' if len(self._floats) > SHOWN else ''}{len(counts)} values"
        return ", ".join(f"{value} ({count})" for value, count in sorted(counts.items()))


class _Labels:
    """Summary of the labels of recordings."""

    def __init__(self) -> None:
        self._values: dict[str, _Values] = {}  # values of all recordings, by label

    def counting(
        self, recordings: Iterable[tuple[str, Mapping[str, Attribute]]]
    ) -> Iterator[tuple[str, Mapping[str, Attribute]]]:
        """Yield names and labels of recordings as they are, and add the labels to the summary."""
        for name, labels in recordings:
            for label, value in labels.items():
                if label not in self._values:
                    self._values[label] = _Values()
                self._values[label].add(value)
            yield name, labels

    def lines(self, full: bool) -> list[str]:
        """Return one line per label with its values; unless ``full``, a single line for all ground-truth labels."""
        lines = []
        names = sorted(self._values)
        truth = [name for name in names if name.startswith(TRUTH)]
        if truth and not full:
            names = [name for name in names if name not in truth]
            lines.append(
                f"{TRUTH}*: {format_count(len(truth), 'labels')} with the simulator's ground truth (--full lists them)"
            )
        lines += [f"{label}: {self._values[label]}" for label in names]
        return lines
