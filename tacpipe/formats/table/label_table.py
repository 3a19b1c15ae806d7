"""A table of labels with a row a recording, as `tacpipe label --from` reads it: CSV, TSV, Parquet, JSON or YAML."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.errors import DamagedError, TacpipeError, UsageError
from tacpipe.formats import unique_names
from tacpipe.formats.table import label_texts
from tacpipe.formats.table.layout import TREES
from tacpipe.io import yaml_text
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, listed, plain

EXTENSIONS = (".csv", ".tsv", ".parquet", *TREES)
RECORDING = re.compile(r"(recording|trial|episode|run|session)(_?(id|name|nr|no|number))?", re.IGNORECASE)
NAME = "recording"  # what the names of a YAML or JSON mapping are


@dataclass(frozen=True)
class Row:
    """What a row holds: where it stands, the name of its recording, and its labels; an empty cell is not among them."""

    place: str
    recording: str
    labels: Mapping[str, Attribute]


@dataclass(frozen=True)
class LabelTable:
    """The rows of a table of labels, and the column that names their recordings."""

    path: Path
    key: str
    rows: tuple[Row, ...]

    def by_recording(self, known: Mapping[str, Mapping[str, Attribute]]) -> dict[str, dict[str, Attribute]]:
        """Return the labels of each row by the name of its recording; ``known`` maps names to attributes.

        A row names its recording, or else the attribute called as the key column, as ``trial``. Raises `UsageError` for
        rows of unknown recordings, and for two rows of one.
        """
        by_attribute: dict[str, list[str]] = {}
        for name, attributes in known.items():
            by_attribute.setdefault(written(attributes.get(self.key)), []).append(name)
        found: dict[str, dict[str, Attribute]] = {}
        unknown: list[str] = []
        for row in self.rows:
            names = [row.recording] if row.recording in known else by_attribute.get(row.recording, [])
            if not names or not row.recording:
                unknown.append(row.recording)
            for name in names:
                if name in found:
                    raise UsageError(f"{self.path}, {row.place}: {plain(name)} has a row already. Keep one of them.")
                found[name] = dict(row.labels)
        if unknown:
            raise UsageError(
                f"{self.path} names recordings that are not there: {listed(unknown, 10)} (column "
                f"{plain(self.key)}); there are {listed(known, 6)}. Correct these names, or choose the column with --key."
            )
        return found


def written(value: Any) -> str:
    """Return the name of a recording as a cell has it: text, '' where the cell is empty.

    >>> written("trial-01"), written(7), written(None)
    ('trial-01', '7', '')
    """
    return "" if value is None else str(value).strip()


def read(path: Path, key: str = "", known: Mapping[str, Mapping[str, Attribute]] | None = None) -> LabelTable:
    """Return the table of labels in a file; ``key`` names the column of the recordings' names, found where it is empty.

    It is the column whose values are all names of ``known`` recordings, else the first called recording, trial, episode …
    Numbers, true and false keep their types. Raises `UsageError` for another kind of file and where no column can be the
    key, `TacpipeError` naming file and row for what cannot be a label.
    """
    suffix = path.suffix.lower()
    if suffix not in EXTENSIONS:
        raise UsageError(f"{path} is not a table of labels by its name; give one of {', '.join(EXTENSIONS)}.")
    if not path.is_file():
        raise UsageError(f"There is no file {path}.")
    texts = suffix in (".csv", ".tsv")
    rows = list(_cells(path) if texts else _parquet(path) if suffix == ".parquet" else _tree(path))
    if not rows:
        raise UsageError(f"{path} holds no row; nothing would change.")
    columns = list(dict.fromkeys(name for _, row in rows for name in row))
    if key and key not in columns:
        raise UsageError(f"{path} has no column {plain(key)}; it has {listed(columns)}.")
    key = key or _key(path, columns, rows, set(known or ()))
    return LabelTable(path, key, tuple(_row(path, place, key, row, texts) for place, row in rows))


def _key(path: Path, columns: list[str], rows: list[tuple[str, dict[str, Any]]], known: set[str]) -> str:
    named = [name for name in columns if {written(row.get(name)) for _, row in rows} <= known]
    called = [name for name in columns if RECORDING.fullmatch(name)]
    if not named + called:
        raise UsageError(
            f"No column of {path} is called recording or trial or holds names of recordings; name it with --key: "
            f"{listed(columns)}."
        )
    return (named + called)[0]


def _row(path: Path, place: str, key: str, row: Mapping[str, Any], texts: bool) -> Row:
    name = written(row.get(key))
    if not name:
        raise TacpipeError(f"{path}, {place} has no {plain(key)}. Write the name of its recording, or remove the row.")
    values = {label: value for label, value in row.items() if label != key}
    if texts:
        values = {label: label_texts.plain_value(value) for label, value in values.items() if value}
    return Row(place, name, {label: _value(path, place, label, value) for label, value in values.items()})


def _value(path: Path, place: str, label: str, value: Any) -> Attribute:
    if isinstance(value, datetime.date | datetime.datetime):
        return value.isoformat()
    finite = not isinstance(value, float) or value - value == 0
    if finite and (value is None or isinstance(value, str | int | float | bool)):
        return value
    raise TacpipeError(
        f"{path}, {place}: {plain(label)} is {excerpt(value)}; a label is text, a finite number, or true or false."
    )


def _cells(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the cells of each row of a text table by the names of its header."""
    numbered = label_texts.read_rows(path)
    header = next(numbered, (0, []))[1]
    for line, cells in numbered:
        yield f"line {line}", dict(zip(header, cells, strict=True))


def _parquet(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    from tacpipe.io import parquet, regular

    with regular.failing(path):
        content = regular.content(path, label_texts.MOST_BYTES)
    try:
        table = parquet.from_parquet(content)
    except DamagedError as error:
        raise TacpipeError(f"{path} cannot be read: {error}") from error
    for number, row in enumerate(table.to_pylist()):
        yield f"row {number}", {name: value for name, value in row.items() if value is not None}


def _tree(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the entries of a mapping of names to labels, or of a list of labels."""
    text = label_texts.read_text(path)
    try:
        tree = unique_names.json_value(text, path) if path.suffix.lower() == ".json" else yaml_text.load(text)
    except (ValueError, RecursionError) as error:
        raise TacpipeError(f"{path} cannot be read: {plain(str(error), 200)}. Correct it.") from error
    entries = (
        [(plain(str(name)), {NAME: str(name), **one} if isinstance(one, dict) else one) for name, one in tree.items()]
        if isinstance(tree, dict)
        else [(f"entry {number}", one) for number, one in enumerate(tree)]
        if isinstance(tree, list)
        else []
    )
    for place, one in entries:
        if not isinstance(one, dict):
            raise TacpipeError(f"{path}, {place} is {excerpt(one)}; write NAME: VALUE for each label of a recording.")
        yield place, {str(name): value for name, value in one.items()}
    if not entries:
        raise TacpipeError(f"{path} holds {excerpt(tree)}; write labels by the name of their recording.")
