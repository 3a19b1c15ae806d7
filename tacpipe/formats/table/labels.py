"""Labels of recordings from a lab's own tables and YAML files, and from the names of files and folders."""

from __future__ import annotations

import datetime
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tacpipe.errors import TacpipeError
from tacpipe.formats import container
from tacpipe.formats.table import label_table, pattern
from tacpipe.formats.table.label_table import read_rows, read_text
from tacpipe.formats.table.layout import TREES, LabelSource, Layout
from tacpipe.formats.table.recordings import RecordingFiles, joined_values
from tacpipe.io import config_text
from tacpipe.io.config_text import plain_value
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, listed, plain

RECORDING = "recording"  # placeholder for a recording's name


def find_labels(layout: Layout, folder: Path, sources: Sequence[RecordingFiles]) -> dict[str, dict[str, Attribute]]:
    """Return the labels of each recording: from the layout, from its files' names, then from each label source.

    Numbers, true and false are parsed. Raises `TacpipeError` with file and row for a recording without a row or a file,
    two rows of one recording, a missing column, and a value that is not plain.
    """
    labels_by_name: dict[str, dict[str, Attribute]] = {
        source.name: {**layout.attributes, **{name: plain_value(value) for name, value in _placeholder_values(source)}}
        for source in sources
    }
    for labels in layout.labels:
        is_shared = not pattern.placeholders(labels.file)
        rows = _labels_by_key(folder / labels.file, labels) if is_shared else {}
        for source in sources:
            alternative_names = _alternative_names(layout, source)
            values = (
                _find_row(rows, source, alternative_names, folder / labels.file)
                if is_shared
                else _read_label_file(folder, labels, source)
            )
            labels_by_name[source.name] |= _select_columns(values, labels, source.name)
    return labels_by_name


def _placeholder_values(source: RecordingFiles) -> Iterator[tuple[str, str]]:
    """Yield the placeholders of a recording's files with their text; the recording's name itself is not a label."""
    for name, value in source.values.items():
        if (name, value) != (RECORDING, source.name):
            yield name, value


def _read_single_row(path: Path) -> dict[str, Attribute]:
    """Return the single row of a table that describes one recording. Raises `TacpipeError` for another number of rows."""
    rows = list(read_rows(path))
    if len(rows) != 2:
        raise TacpipeError(
            f"{path} has {max(len(rows) - 1, 0)} rows below its header; the labels of one recording are one row."
        )
    return {name: plain_value(cell) for name, cell in zip(rows[0][1], rows[1][1], strict=True)}


def _labels_by_key(path: Path, labels: LabelSource) -> dict[str, dict[str, Attribute]]:
    """Return the labels in a label table by the value of its key column, or by name for a YAML or JSON mapping.

    Raises `TacpipeError` for a missing key column and for repeated keys.
    """
    if path.suffix.lower() in TREES:
        label_rows = label_table.read_label_table(path, labels.key)
        repeated = [name for name, count in Counter(row.recording for row in label_rows.rows).items() if count > 1]
        if repeated:
            raise TacpipeError(f"{path}: {plain(repeated[0])} has an entry already. Keep one of them.")
        return {row.recording: dict(row.labels) for row in label_rows.rows}
    numbered = read_rows(path)
    header = next(numbered, (0, []))[1]
    if labels.key not in header:
        raise TacpipeError(f"{path} has no column {plain(labels.key)}; it has {listed(header, 6)}.")
    key_index = header.index(labels.key)
    rows: dict[str, dict[str, Attribute]] = {}
    for line, cells in numbered:
        key = cells[key_index]
        if key in rows:
            raise TacpipeError(f"{path}, line {line}: {plain(key)} has a row already. Keep one of them.")
        rows[key] = {name: plain_value(cell) for name, cell in zip(header, cells, strict=True) if name != labels.key}
    return rows


def _alternative_names(layout: Layout, source: RecordingFiles) -> list[str]:
    """Return other names that a table may use for a recording: those of folders and files that contain its placeholders.

    With the pattern ``run_{trial}/skin.csv``, the recording of ``run_07/skin.csv``, whose trial is 07, is also called
    run_07, and trial-07.
    """
    segments = {segment for stream in layout.streams for segment in stream.files.split("/")}
    alternatives = []
    for segment in segments:
        names = pattern.placeholders(segment)
        if names and "*" not in segment and set(names) <= set(source.values):
            alternatives.append(pattern.fill_pattern(segment, source.values).partition(".")[0])
    return [*sorted(alternatives), joined_values(source.values)]


def _find_row(
    rows: Mapping[str, dict[str, Attribute]], source: RecordingFiles, alternative_names: list[str], path: Path
) -> dict[str, Attribute]:
    """Return the row of a recording under any of its names. Raises `TacpipeError` if there is none."""
    candidates = (source.episode, source.name, *source.values.values(), *alternative_names)
    names = list(dict.fromkeys(name for name in candidates if name is not None))
    for name in names:
        if name in rows:
            return rows[name]
    raise TacpipeError(
        f"{path} has no row for the recording {plain(source.name)} (looked for {listed(names, 4)}); its rows are "
        f"{listed(rows, 4)}. Add the row, or set key to the column that holds these names."
    )


def _read_label_file(folder: Path, labels: LabelSource, source: RecordingFiles) -> dict[str, Attribute]:
    """Return the labels in the file of one recording. Raises `TacpipeError` if they cannot be read."""
    path = folder / pattern.fill_pattern(labels.file, {**source.values, "recording": source.episode or source.name})
    if path.suffix.lower() in (".csv", ".tsv"):
        return _read_single_row(path)
    text = read_text(path)
    try:
        values = container.json_value(text, path) if path.suffix.lower() == ".json" else config_text.load_labels(text)
    except (ValueError, RecursionError) as error:
        raise TacpipeError(f"{path} cannot be read: {plain(str(error), 200)}. Correct it.") from error
    if not isinstance(values, dict):
        raise TacpipeError(f"{path} holds {excerpt(values)}; labels are NAME: VALUE, one a line.")
    return {plain(str(name)): _label_value(value, name, path) for name, value in _flatten(values).items()}


def _flatten(values: Mapping[Any, Any], prefix: str = "") -> dict[str, Attribute | datetime.date]:
    """Return nested mappings as one mapping with dotted names."""
    flat: dict[str, Attribute | datetime.date] = {}
    for name, value in values.items():
        flat |= _flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _label_value(value: Any, name: Any, path: Path) -> Attribute:
    """Return a label's value; dates become text. Raises `TacpipeError` if it is not plain."""
    if isinstance(value, datetime.date | datetime.datetime):
        return value.isoformat()
    is_finite = not isinstance(value, float) or math.isfinite(value)
    if is_finite and (value is None or isinstance(value, str | int | float | bool)):
        return value
    raise TacpipeError(
        f"{path}: {plain(str(name))} is {excerpt(value)}; a label is text, a finite number, or true or false."
    )


def _select_columns(values: dict[str, Attribute], labels: LabelSource, recording: str) -> dict[str, Attribute]:
    """Return the labels that the layout selects, or all. Raises `TacpipeError` if one is missing."""
    if not labels.columns:
        return values
    missing = [name for name in labels.columns if name not in values]
    if missing:
        raise TacpipeError(
            f"The labels of {plain(recording)} in {plain(labels.file)} lack {listed(missing, 3)}; there are "
            f"{listed(values, 6)}."
        )
    return {name: values[name] for name in labels.columns}
