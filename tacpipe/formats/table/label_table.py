"""Read label files: the rows of a CSV file, and the values of its cells."""

from __future__ import annotations

import csv
import datetime
import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.datasets import intervals
from tacpipe.errors import DamagedError, TacpipeError, UsageError
from tacpipe.formats import container
from tacpipe.formats.faults import explaining
from tacpipe.formats.table.layout import TREES
from tacpipe.io import config_text, parquet, regular
from tacpipe.io.config_text import plain_value
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, listed, plain

MAX_LABEL_BYTES = 1 << 26  # maximum size of a label file


def read_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of each non-empty line, the header first.

    Raises `TacpipeError` if a line has another number of cells than the header.
    """
    text = _read_text(path)
    separator = ";" if ";" in text.partition("\n")[0] else ","
    separator = "\t" if path.suffix.lower() == ".tsv" else separator
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    header: list[str] = []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        header = header or cells
        if len(cells) != len(header):
            raise TacpipeError(
                f"{path}, line {reader.line_num} has {len(cells)} cells under a header of {len(header)}."
            )
        yield reader.line_num, [cell.strip() for cell in cells]


def _read_text(path: Path) -> str:
    """Return the text of a label file. Raises `TacpipeError` if it is too large or not UTF-8."""
    with regular.failing(path):
        content = regular.content(path, MAX_LABEL_BYTES)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TacpipeError(
            f"{path} is not UTF-8: byte {error.start} is {excerpt(content[error.start : error.end])}."
        ) from error


EXTENSIONS = (".csv", ".tsv", ".parquet", *TREES)
RECORDING = re.compile(r"(recording|trial|episode|run|session)(_?(id|name|nr|no|number))?", re.IGNORECASE)
NAME = "recording"  # column for the names of a YAML or JSON mapping


@dataclass(frozen=True)
class LabelRow:
    """A row: its position in the file, the name of its recording, and the labels of its non-empty cells."""

    place: str
    recording: str
    labels: Mapping[str, Attribute]


@dataclass(frozen=True)
class LabelTable:
    """The rows of a label table, and the column with the recordings' names."""

    path: Path
    key: str
    rows: tuple[LabelRow, ...]
    columns: tuple[str, ...] = ()  # labels of each row of a table of cells; those of empty cells are not in the rows

    def by_recording(
        self, attributes_by_name: Mapping[str, Mapping[str, Attribute]]
    ) -> dict[str, dict[str, Attribute]]:
        """Return the labels of each row by recording, given the attributes of the recordings by name.

        A row refers to a recording by name, or by the attribute named like the key column, such as ``trial``. Raises
        `UsageError` for rows of unknown recordings, and for two rows of one recording.
        """
        by_attribute: dict[str, list[str]] = {}
        for name, attributes in attributes_by_name.items():
            by_attribute.setdefault(cell_text(attributes.get(self.key)), []).append(name)
        labels_by_name: dict[str, dict[str, Attribute]] = {}
        unknown: list[str] = []
        for row in self.rows:
            names = [row.recording] if row.recording in attributes_by_name else by_attribute.get(row.recording, [])
            if not names or not row.recording:
                unknown.append(row.recording)
            for name in names:
                if name in labels_by_name:
                    raise UsageError(f"{self.path}, {row.place}: {plain(name)} has a row already. Keep one of them.")
                labels_by_name[name] = dict(row.labels)
        if unknown:
            raise UsageError(
                f"{self.path} names recordings that are not there: {listed(unknown, 10)} (column {plain(self.key)}); "
                f"there are {listed(attributes_by_name, 6)}. Correct these names, or choose the column with --key."
            )
        return labels_by_name


def cell_text(value: Any) -> str:
    """Return a recording's name as cell text, or "" for an empty cell.

    >>> cell_text("trial-01"), cell_text(7), cell_text(None)
    ('trial-01', '7', '')
    """
    return "" if value is None else str(value).strip()


def read_label_table(
    path: Path, key: str = "", attributes_by_name: Mapping[str, Mapping[str, Attribute]] | None = None
) -> LabelTable:
    """Return the label table in a file. ``key`` is the column with the recordings' names; if empty, it is inferred.

    Raises `UsageError` for another kind of file and for a file without rows, and the errors of `parse_label_table`.
    """
    if path.suffix.lower() not in EXTENSIONS:
        raise UsageError(f"{path} is not a table of labels by its name; give one of {', '.join(EXTENSIONS)}.")
    if not path.is_file():
        raise UsageError(f"There is no file {path}.")
    table = parse_label_table(path, key, attributes_by_name)
    if not table.rows:
        raise UsageError(f"{path} holds no row; nothing would change.")
    return table


def parse_label_table(
    path: Path, key: str = "", attributes_by_name: Mapping[str, Mapping[str, Attribute]] | None = None
) -> LabelTable:
    """Return the label table in a file; text that is neither Parquet, YAML nor JSON is a table of cells.

    The inferred column is the one whose values are all in ``attributes_by_name``, else the first named recording,
    trial, episode …. Numbers, true and false keep their types. Raises `UsageError` if no column can be the key, and
    `TacpipeError` with file and row for an invalid label.
    """
    readers = {".parquet": _read_parquet, **dict.fromkeys(TREES, _read_tree)}
    is_text = path.suffix.lower() not in readers
    rows = list(readers.get(path.suffix.lower(), read_text_rows)(path))
    columns = list(dict.fromkeys(name for _, row in rows for name in row))
    if key and rows and key not in columns:
        raise UsageError(f"{path} has no column {plain(key)}; it has {listed(columns)}.")
    key_column = key or (_find_key_column(path, columns, rows, set(attributes_by_name or ())) if rows else NAME)
    label_rows = tuple(_label_row(path, place, key_column, row, is_text) for place, row in rows)
    return LabelTable(path, key_column, label_rows, tuple(columns) if is_text else ())


Cell = Attribute | datetime.date  # a value of a table; others are refused


def _find_key_column(
    path: Path, columns: list[str], rows: list[tuple[str, dict[str, Cell]]], recording_names: set[str]
) -> str:
    """Return the column with the names of recordings. Raises `UsageError` if no column can be it."""
    matching_columns = [name for name in columns if {cell_text(row.get(name)) for _, row in rows} <= recording_names]
    named_like_key = [name for name in columns if RECORDING.fullmatch(name)]
    if not matching_columns + named_like_key:
        raise UsageError(
            f"No column of {path} is called recording or trial or holds names of recordings; name it with --key: "
            f"{listed(columns)}."
        )
    return (matching_columns + named_like_key)[0]


def _label_row(path: Path, place: str, key: str, row: Mapping[str, Cell], is_text: bool) -> LabelRow:
    """Return a row of labels; ``place`` describes it in errors, and cells of a text table (``is_text``) are parsed.

    Raises `TacpipeError` if the row has no name or an invalid label.
    """
    name = cell_text(row.get(key))
    if not name:
        raise TacpipeError(f"{path}, {place} has no {plain(key)}. Write the name of its recording, or remove the row.")
    values = {label: value for label, value in row.items() if label != key}
    if is_text:
        values = {label: plain_value(str(value)) for label, value in values.items() if value}
    return LabelRow(
        place, name, {label: label_value(f"{path}, {place}", label, value) for label, value in values.items()}
    )


def label_value(place: str, label: str, value: Any) -> Attribute:
    """Return a label's value; dates become text. Raises `TacpipeError` if it is not plain."""
    if isinstance(value, datetime.date | datetime.datetime):
        return value.isoformat()
    is_finite = not isinstance(value, float) or value - value == 0
    if is_finite and (value is None or isinstance(value, str | int | float | bool)):
        return value
    raise TacpipeError(
        f"{place}: {plain(label)} is {excerpt(value)}; a label is text, a finite number, or true or false."
    )


def read_text_rows(path: Path) -> Iterator[tuple[str, dict[str, Cell]]]:
    """Yield the place of each row of a text table, and its cells by the names of the header."""
    numbered = read_rows(path)
    header = next(numbered, (0, []))[1]
    for line, cells in numbered:
        yield f"line {line}", dict(zip(header, cells, strict=True))


def _read_parquet(path: Path) -> Iterator[tuple[str, dict[str, Cell]]]:
    """Yield the place of each row of a Parquet file, and its cells that are not null, by column.

    Raises `TacpipeError` if the file is damaged.
    """
    with regular.failing(path):
        content = regular.content(path, MAX_LABEL_BYTES)
    try:
        table = parquet.from_parquet(content)
    except DamagedError as error:
        raise TacpipeError(f"{path} cannot be read: {error}") from error
    for number, row in enumerate(table.to_pylist()):
        yield f"row {number}", {name: value for name, value in row.items() if value is not None}


def parse_tree(path: Path) -> Any:
    """Return the value in a JSON or YAML file of labels. Raises `TacpipeError` if it cannot be read."""
    text = _read_text(path)
    with explaining((ValueError, RecursionError), f"{path} cannot be read: ", ". Correct it."):
        return container.json_value(text, path) if path.suffix.lower() == ".json" else config_text.load_labels(text)


def _read_tree(path: Path) -> Iterator[tuple[str, dict[str, Cell]]]:
    """Yield the position and the labels of each entry of a JSON or YAML file.

    The file contains a mapping of names to labels, or a list of labels. Raises `TacpipeError` if it contains neither, or if
    an entry is not a mapping.
    """
    tree = parse_tree(path)
    entries: list[tuple[str, Any]] = []
    if isinstance(tree, dict):
        for name, labels in tree.items():
            named_labels = {NAME: str(name), **labels} if isinstance(labels, dict) else labels
            entries.append((plain(str(name)), named_labels))
    elif isinstance(tree, list):
        entries += [(f"entry {number}", labels) for number, labels in enumerate(tree)]
    for place, labels in entries:
        if not isinstance(labels, dict):
            raise TacpipeError(
                f"{path}, {place} is {excerpt(labels)}; write NAME: VALUE for each label of a recording."
            )
        yield place, {str(name): value for name, value in labels.items()}
    if not entries:
        raise TacpipeError(f"{path} holds {excerpt(tree)}; write labels by the name of their recording.")


INTERVAL_COLUMNS = ("recording", "interval", "from_s", "to_s")


def read_intervals(path: Path) -> dict[str, dict[str, Attribute]]:
    """Return the labels that keep the intervals of a CSV, by recording.

    Each row has the name of a recording and of an interval, and its start and end in seconds; a row without times states
    that there is none. Raises `UsageError` for other columns, and for an invalid interval.
    """
    rows = read_rows(path)
    header = next(rows, (1, []))[1]
    if sorted(header) != sorted(INTERVAL_COLUMNS):
        raise UsageError(f"{path} has the columns {listed(header)}; it must have {', '.join(INTERVAL_COLUMNS)}.")
    by_recording: dict[str, dict[str, list[intervals.Interval]]] = {}
    for line, cells in rows:
        row = dict(zip(header, cells, strict=True))
        times = by_recording.setdefault(row["recording"], {}).setdefault(intervals.attribute(row["interval"]), [])
        if not (row["from_s"] or row["to_s"]):
            continue
        try:
            times.append(intervals.checked_interval(float(row["from_s"]), float(row["to_s"])))
        except ValueError as error:
            raise UsageError(
                f"{path}, line {line}: {excerpt(row['from_s'])} to {excerpt(row['to_s'])} is not an interval. Give seconds "
                f"as numbers, or neither."
            ) from error
    return {
        recording: {name: intervals.to_text(times) for name, times in by_name.items()}
        for recording, by_name in by_recording.items()
    }
