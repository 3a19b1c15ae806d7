"""Labels of recordings from a lab's own tables and YAML files, and from the names of files and folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.formats import container
from tacpipe.formats.table import label_table, pattern
from tacpipe.formats.table.layout import LabelSource, Layout
from tacpipe.formats.table.recordings import RecordingFiles, joined_values
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
        source.name: {
            **layout.attributes,
            # the name of the recording itself is no label
            **{
                key: plain_value(text) for key, text in source.values.items() if (key, text) != (RECORDING, source.name)
            },
        }
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


def _labels_by_key(path: Path, labels: LabelSource) -> dict[str, dict[str, Attribute]]:
    """Return the labels in a label table by the name of their recording; an empty cell is the label None.

    Raises `TacpipeError` for a missing key column and for repeated names.
    """
    table = label_table.parse_label_table(path, labels.key)
    empty_cells: dict[str, Attribute] = {name: None for name in table.columns if name != table.key}
    rows: dict[str, dict[str, Attribute]] = {}
    for row in table.rows:
        if row.recording in rows:
            raise TacpipeError(f"{path}, {row.place}: {plain(row.recording)} has a row already. Keep one of them.")
        rows[row.recording] = {**empty_cells, **row.labels}
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
        rows = list(label_table.read_text_rows(path))
        if len(rows) != 1:
            raise TacpipeError(
                f"{path} has {len(rows)} rows below its header; the labels of one recording are one row."
            )
        return {name: plain_value(str(cell)) for name, cell in rows[0][1].items()}
    values = label_table.parse_tree(path)
    if not isinstance(values, dict):
        raise TacpipeError(f"{path} holds {excerpt(values)}; labels are NAME: VALUE, one a line.")
    flat = container.flatten(values).items()
    return {plain(str(name)): label_table.label_value(str(path), str(name), value) for name, value in flat}


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
