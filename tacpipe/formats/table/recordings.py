"""Find the recordings below a folder by the patterns of a layout, and read their streams and attributes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from tacpipe.datasets.paths import refuse_shared_names, valid_name
from tacpipe.errors import TacpipeError, UsageError, is_input_error
from tacpipe.formats.container import (
    EpisodeContents,
    container_names,
    find_containers,
    is_container,
    no_container_error,
    open_container,
    parts_by_name,
)
from tacpipe.formats.table import pattern, rows
from tacpipe.formats.table.columns import TIME
from tacpipe.formats.table.layout import FILE, ROW, STAMPS, Format, Layout, StreamLayout, extension
from tacpipe.formats.table.reading import (
    camera_batches,
    check_stamps,
    image_batches,
    read_contained_stream,
    stream_batches,
)
from tacpipe.io import files as file_system
from tacpipe.plugins import failures
from tacpipe.plugins.stage import Attribute, RecordingOutput, Shared
from tacpipe.printable import listed, plain
from tacpipe.video.files import IMAGE_CODECS

PART = "part-"  # start of the name of a stretch between two settings of the clock
CONTAINER = "container"  # key of the file that contains all streams of a source


@dataclass(frozen=True)
class RecordingFiles:
    """The files of one recording by stream, its placeholder values, and its name in a file of several recordings."""

    name: str
    files: Mapping[str, Path]
    values: Mapping[str, str]
    episode: str | None = None  # value of the column ``recording``, or a container's episode


def find_recordings(layout: Layout, folder: Path) -> list[RecordingFiles]:
    """Return the recordings below ``folder``, sorted by name.

    Raises `UsageError` if there is none, if a recording lacks a required stream or has two files for one stream, or if
    two recordings share a name.
    """
    if layout.found_by_format:
        raise UsageError("The layout has no stream with files.")
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder. Give the folder that the patterns of the layout start from.")
    candidates = _candidate_paths(layout, folder)
    image_folders = list(dict.fromkeys(path.parent for path in candidates if extension(path) in IMAGE_CODECS))
    by_path = replace(layout, streams=tuple(stream for stream in layout.streams if stream not in layout.row_streams))
    matched = {
        stream.name: _matching_paths(stream, image_folders if stream.camera == "images" else candidates)
        for stream in by_path.streams
    }
    _refuse_unmatched(by_path, matched, candidates, folder)
    shared = layout.placeholders
    groups: dict[tuple[str, ...], dict[str, list[Path]]] = {}
    stamps: dict[Path, Path] = {}  # timestamp file by file of rows
    for stream in by_path.streams:
        for path, values in matched[stream.name]:
            if not set(shared) <= set(values):
                raise UsageError(
                    f"[streams.{stream.name}] files has no {{{shared[0]}}}, by which files belong to a recording. Add it."
                )
            if stream.time.file:
                stamps[path] = Path(pattern.fill_pattern(stream.time.file, values))
            groups.setdefault(tuple(values[name] for name in shared), {}).setdefault(stream.name, []).append(path)
    sources = []
    for key, by_stream in sorted(groups.items()):
        for name, paths in by_stream.items():
            if len(paths) > 1:
                raise UsageError(
                    f"{listed(paths, 3)} are all the stream {name} of one recording ({_describe_values(shared, key)}). Add "
                    f"a placeholder to every files pattern that distinguishes them."
                )
        lacking = [stream.name for stream in by_path.streams if not stream.optional and stream.name not in by_stream]
        if lacking:
            present_path = next(iter(by_stream.values()))[0]
            raise UsageError(
                f"The recording of {present_path} ({_describe_values(shared, key)}) has no file of the stream "
                f"{listed(lacking, 3)}. Add it, or set optional = true in [streams.{lacking[0]}]."
            )
        files = {name: folder / paths[0] for name, paths in by_stream.items()}
        files |= {
            f"{name}{STAMPS}": folder / stamps[rows_path]
            for name, (rows_path,) in by_stream.items()
            if rows_path in stamps
        }
        values = dict(zip(shared, key, strict=True))
        if layout.per_row:
            sources += _recordings_of_rows(layout, files, values, folder)
        else:
            sources += _recordings_in_files(layout, files, values)
    refuse_shared_names((source.name, next(iter(source.files.values()))) for source in sources)
    return sorted(sources, key=lambda source: source.name)


def find_contained(layout: Layout, kind: Format, source: Path) -> list[RecordingFiles]:
    """Return the recordings in the containers of a format at or below ``source``, sorted by name.

    Names consist of the file's name, and of the episode's if a file contains several. Raises `UsageError` if there is
    no container, or if two recordings share a name.
    """
    paths = find_containers(kind, source)
    if not paths:
        raise no_container_error(kind, source)
    sources = []
    for path, container_name in container_names(paths, source).items():
        stem = os.fsencode(container_name).decode(errors="replace")
        files = {stream.name: path for stream in layout.streams} or {CONTAINER: path}
        episodes, names_are_complete = _episodes(kind, path)
        for episode in episodes:
            values = {FILE: stem, **({} if episode is None else {"recording": episode})}
            plain_name = stem
            if episode is not None:
                plain_name = episode if names_are_complete else f"{stem}-{episode}"
            name = valid_name(pattern.fill_pattern(layout.name, values) if layout.name else plain_name)
            if not name:
                raise UsageError(f"{path} gives no name for a recording. Set name in [recordings], or rename the file.")
            sources.append(RecordingFiles(name, files, {}, episode))
    refuse_shared_names((recording.name, next(iter(recording.files.values()))) for recording in sources)
    return sorted(sources, key=lambda recording: recording.name)


def _episodes(kind: str, path: Path) -> tuple[Sequence[str | None], bool]:
    """Return the recordings in a container, [None] for a single one, and whether their names need no prefix.

    An unreadable container counts as one recording: reading it later reports the error, and other containers are still
    read.
    """
    try:
        with failures.naming_source([path]):
            container = open_container(kind, path)
            return container.episodes() or [None], container.names_itself
    except TacpipeError as error:
        if not is_input_error(error):
            raise
        return [None], False


def _candidate_paths(layout: Layout, folder: Path) -> list[Path]:
    """Return the paths to match with patterns: all files below a folder, and folders that are containers of the layout."""
    containers = {str(stream.format) for stream in layout.streams if stream.contained}
    paths: list[Path] = []
    for directory, folders, names in file_system.walk(folder):
        if any(is_container(kind, Path(directory)) for kind in containers):
            paths.append(Path(directory))
            folders.clear()
            continue
        paths += [Path(directory, name) for name in names]
    return [path.relative_to(folder) for path in paths]


def _matching_paths(stream: StreamLayout, candidates: list[Path]) -> list[tuple[Path, Mapping[str, str]]]:
    """Return the paths that match the pattern of a stream, each with the values of its placeholders."""
    matches: list[tuple[Path, Mapping[str, str]]] = []
    for path in candidates:
        values = pattern.match(stream.files, path.as_posix())
        if values is not None:
            matches.append(
                (path, {name: os.fsencode(value).decode(errors="replace") for name, value in values.items()})
            )
    return matches


def _refuse_unmatched(layout: Layout, matched: Mapping[str, Sized], candidates: list[Path], folder: Path) -> None:
    """Raise `UsageError` if no file matches the pattern of a required stream."""
    for stream in layout.streams:
        if not matched[stream.name] and not stream.optional:
            images = f"; images are files of {', '.join(IMAGE_CODECS)}" if stream.camera == "images" else ""
            raise UsageError(
                f"No file below {folder} matches {plain(stream.files, 120)} of [streams.{stream.name}]. There are "
                f"{len(candidates)} files, as {listed(candidates, 3)}; patterns start from {folder}{images}."
            )


def _recordings_in_files(layout: Layout, files: Mapping[str, Path], values: Mapping[str, str]) -> list[RecordingFiles]:
    """Return the recording that consists of these files, or the recordings that they contain.

    ``values`` are those of the placeholders. Raises `UsageError` if the files contain different recordings.
    """
    shared_streams = [
        stream
        for stream in layout.streams
        if (stream.recording or stream.contained or stream.time.split_at_reset) and stream.name in files
    ]
    names_by_stream = {}
    for stream in shared_streams:
        if stream.time.split_at_reset:
            names = _parts_of_file(files[stream.name], stream, files.get(f"{stream.name}{STAMPS}"))
        else:
            names = _names_in_file(files[stream.name], stream)
        if names is not None:
            names_by_stream[stream.name] = names
    if not names_by_stream:
        return [RecordingFiles(_recording_name(layout, values, files), files, values)]
    first = next(iter(names_by_stream.values()))
    for stream_name, names in names_by_stream.items():
        if names != first:
            odd_names = sorted(names ^ first)
            raise UsageError(
                f"{files[stream_name]} and {files[next(iter(names_by_stream))]} hold different recordings: "
                f"{listed(odd_names, 3)} is "
                f"in only one of them."
            )
    if any(stream.time.split_at_reset for stream in shared_streams):
        name = _recording_name(layout, values, files)
        return [RecordingFiles(f"{name}-{part.removeprefix(PART)}", files, values, part) for part in sorted(first)]
    return [
        RecordingFiles(_recording_name(layout, {**values, "recording": name}, files), files, values, name)
        for name in sorted(first)
    ]


def _recordings_of_rows(
    layout: Layout, files: Mapping[str, Path], values: Mapping[str, str], folder: Path
) -> list[RecordingFiles]:
    """Return one recording per row of a table, named after the file and the number of the row.

    Cells that are labels join the ``values`` of the placeholders. Other streams have the files that the cells name.
    Raises `UsageError` for a missing file, and `TacpipeError` for a missing column.
    """
    table = next(stream for stream in layout.streams if stream.name == layout.per_row)
    cells = _cells(files[table.name], table, layout.row_columns)
    width = len(str(len(cells)))
    sources = []
    for number, row in enumerate(cells, 1):
        filled = {**values, **{name: cell for name, cell in row.items() if cell}}
        row_files = dict(files)
        for stream in layout.row_streams:
            if not set(pattern.placeholders(stream.files)) <= set(filled) and stream.optional:
                continue
            path = folder / pattern.fill_pattern(stream.files, filled)
            if not path.exists():
                raise UsageError(
                    f"{files[table.name]}, row {number}, names {path} of [streams.{stream.name}], which does not exist. "
                    f"Copy it again, or correct files."
                )
            row_files[stream.name] = path
        name = f"{number:0{width}}"
        if layout.name:
            name = _recording_name(layout, {**values, "recording": name}, files)
        else:
            name = f"{_recording_name(layout, values, {table.name: files[table.name]})}-{name}"
        labels = {name: filled[name] for name in (*values, *layout.row_labels) if name in filled}
        sources.append(RecordingFiles(name, row_files, labels, str(number)))
    return sources


def _cells(path: Path, table: StreamLayout, columns: Sequence[str]) -> list[dict[str, str]]:
    """Return the cells of ``columns`` in each row of a table. Raises `TacpipeError` if a column is missing."""
    with failures.naming_source([path]):
        file = rows.open_rows(path, table)
        names = file.names()
        missing = [name for name in columns if name not in names]
        if missing:
            raise TacpipeError(
                f"{path} has no column {listed(missing, 3)}, which [recordings] or a pattern of files names; it has "
                f"{listed(names, 6)}."
            )
        blocks = list(file.batches(dict.fromkeys((*columns, ROW), pa.string())))
        return (
            [row for block in blocks for row in block.select([*columns]).to_pylist()]
            if columns
            else ([{} for block in blocks for _ in range(block.num_rows)])
        )


def _parts_of_file(path: Path, stream: StreamLayout, stamps_path: Path | None) -> set[str] | None:
    """Return the names of the stretches between settings of a file's clock, or None if the clock was never set.

    A file with wrong stamps is one recording, whose reading reports them.
    """
    try:
        with failures.naming_source([path]):
            count = check_stamps(rows.open_rows(path, stream), stream, stamps_path).parts
    except TacpipeError as error:
        if not is_input_error(error):
            raise
        return None
    return None if count == 1 else {f"{PART}{part:0{len(str(count))}}" for part in range(1, count + 1)}


def _names_in_file(path: Path, stream: StreamLayout) -> set[str] | None:
    """Return the recordings in a file: values of the column ``recording``, or a container's episodes.

    Returns None for a container with a single recording. Raises `TacpipeError` if the column is missing or has an empty
    cell.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    if stream.contained:
        return {name for name in _episodes(str(stream.format), path)[0] if name is not None} or None
    names_in_file: set[str] = set()
    with failures.naming_source([path]):
        file = rows.open_rows(path, stream)
        if stream.recording not in file.names():
            raise TacpipeError(
                f"{path} has no column {plain(stream.recording)}, which [streams.{stream.name}] recording names."
            )
        for block in file.batches({stream.recording: pa.string()}):
            names = pc.unique(block.column(stream.recording).cast(pa.string())).to_pylist()
            if None in names or "" in names:
                raise TacpipeError(
                    f"{path}, column {plain(stream.recording)}: a row names no recording. Fill the cell, or remove the row."
                )
            names_in_file |= set(names)
    return names_in_file


def _recording_name(layout: Layout, values: Mapping[str, str], files: Mapping[str, Path]) -> str:
    """Return the name of a recording, by default of its folder, from its placeholders, or of its first file.

    Raises `UsageError` if it is not a valid name.
    """
    if layout.name:
        text = pattern.fill_pattern(layout.name, values)
    elif len(values) == 1 and (own_name := folder_name(layout, values)):
        text = own_name
    elif values:
        text = joined_values(values)
    else:
        text = next(iter(files.values())).name.partition(".")[0]
    name = valid_name(text)
    if not name:
        raise UsageError(f"{plain(text)} cannot be a recording's name. Set name in [recordings].")
    return name


def joined_values(values: Mapping[str, str]) -> str:
    """Return the values of placeholders joined by dashes, numbers after the name of their placeholder.

    >>> joined_values({"object": "cup", "trial": "3"})
    'cup-trial-3'
    """
    return "-".join(f"{name}-{value}" if value.isdigit() else value for name, value in values.items())


def folder_name(layout: Layout, values: Mapping[str, str]) -> str:
    """Return the name of the folder or file that contains the only placeholder, or "" if it differs between streams."""
    names = set()
    for stream in layout.streams:
        segments = [segment for segment in stream.files.split("/") if pattern.placeholders(segment)]
        if len(segments) != 1 or "*" in segments[0] or set(pattern.placeholders(segments[0])) != set(values):
            return ""
        name = pattern.fill_pattern(segments[0], values)
        names.add(name.partition(".")[0] if stream.files.endswith(segments[0]) and stream.format != "images" else name)
    return names.pop() if len(names) == 1 else ""


def _describe_values(names: tuple[str, ...], values: tuple[str, ...]) -> str:
    return ", ".join(f"{name} {plain(value)}" for name, value in zip(names, values, strict=True)) or "no placeholder"


LOWEST_HZ, HIGHEST_HZ = 0.2, 20_000.0  # rates outside this range are probably timestamps in another unit
MIN_ROWS = 10  # minimum number of rows for estimating a rate
SKIPPED = "skipped"  # attribute that lists the unreadable sources of a recording


def read_streams(
    streams: Sequence[StreamLayout], paths: Mapping[str, Path], episode: str | None, shared: Shared | None = None
) -> RecordingOutput:
    """Return the recording with the files ``paths`` by stream. ``episode`` is its name in a file of several recordings.

    Streams of a container are read in one pass. Notes on rates are added as streams are read. Raises the errors of
    `reading.stream_batches`, and one for a required stream that a container lacks.
    """
    tables: dict[str, pa.Table | pa.RecordBatchReader] = {}
    attributes: dict[str, Attribute] = {}
    notes: list[str] = []
    contained_streams: dict[tuple[str, Path], list[StreamLayout]] = {}
    for stream in streams:
        if stream.name not in paths:
            continue
        if stream.camera:
            tables[stream.name] = camera_batches(paths[stream.name], stream, paths.get(f"{stream.name}{STAMPS}"), notes)
        elif stream.array:
            tables[stream.name] = image_batches(paths[stream.name], stream, paths.get(f"{stream.name}{STAMPS}"))
        elif stream.contained:
            contained_streams.setdefault((str(stream.format), paths[stream.name]), []).append(stream)
        else:
            tables[stream.name] = stream_batches(
                rows.open_rows(paths[stream.name], stream),
                stream,
                episode,
                shared,
                paths.get(f"{stream.name}{STAMPS}"),
                notes,
            )
    for (kind, path), container_streams in contained_streams.items():
        contents = open_container(kind, path).read([stream.source for stream in container_streams], episode)
        stream_by_source = parts_by_name(((stream.source, stream) for stream in contents.streams), path, "stream")
        for stream in container_streams:
            if stream.source in stream_by_source:
                tables[stream.name] = read_contained_stream(path, stream_by_source[stream.source], stream, notes)
            elif not stream.optional:
                raise _missing_stream_error(path, stream, contents, open_container(kind, path).look(episode))
        attributes |= contents.attributes
        prefixes = tuple(f"{stream.source}/" for stream in container_streams)
        inner = {source: problem for source, problem in contents.skipped.items() if source.startswith(prefixes)}
        notes += [*contents.notes, *_skipped_notes(path, inner)]
    tables = {
        stream.name: _with_rate_note(tables[stream.name], stream.name, notes)
        for stream in streams
        if stream.name in tables
    }
    return RecordingOutput(tables, attributes, notes, rows={})


def _with_rate_note(
    rows: pa.Table | pa.RecordBatchReader, name: str, notes: list[str]
) -> pa.Table | pa.RecordBatchReader:
    """Return the rows of a stream. When the first rows are read, an implausible rate is added to ``notes``."""
    if isinstance(rows, pa.Table):
        if rows.num_rows:
            _note_rate(rows, name, notes)
        return rows

    def read_batches() -> Iterator[pa.RecordBatch]:
        for number, batch in enumerate(rows):
            if not number:
                _note_rate(batch, name, notes)
            yield batch

    return pa.RecordBatchReader.from_batches(rows.schema, read_batches())


def _note_rate(rows: pa.Table | pa.RecordBatch, name: str, notes: list[str]) -> None:
    """Add a note if the first rows of a stream suggest a rate that few sensors have."""
    channels = [field for field in rows.schema if field.name != TIME and not pa.types.is_string(field.type)]
    step_ns = float(np.median(np.diff(rows.column(TIME).to_numpy()))) if rows.num_rows >= MIN_ROWS else 0.0
    if channels and step_ns and not LOWEST_HZ <= 1e9 / step_ns <= HIGHEST_HZ:
        notes.append(
            f"The stamps of {name} are {step_ns / 1e9:g} s apart, {1e9 / step_ns:,.6g} Hz, which few sensors have. Check "
            f"the unit of its time."
        )


def read_container(kind: str, path: Path, episode: str | None) -> RecordingOutput:
    """Return all readable streams of a container or of its ``episode``; the notes list the others.

    The attribute ``skipped`` of the recording lists them too. Raises `TacpipeError` if nothing can be read.
    """
    contents = open_container(kind, path).read(None, episode)
    notes = [*contents.notes, *_skipped_notes(path, contents.skipped)]
    stream_by_name = parts_by_name(((stream.name, stream) for stream in contents.streams), path, "stream")
    tables = {
        name: _with_rate_note(
            read_contained_stream(path, stream, StreamLayout(name, source=stream.source), notes), name, notes
        )
        for name, stream in stream_by_name.items()
        if stream.rows is None or stream.rows
    }
    if not tables:
        raise TacpipeError(" ".join([f"{path} holds no stream that can be read.", *notes]))
    skipped = "; ".join(f"{plain(source)}: {reason}" for source, reason in contents.skipped.items())
    attributes = {**contents.attributes, **({SKIPPED: skipped} if skipped else {})}
    return RecordingOutput(tables, attributes, notes, rows={})


def _skipped_notes(path: Path, skipped: Mapping[str, str]) -> list[str]:
    return [f"{path}: {plain(source)} is left out: {problem}." for source, problem in skipped.items()]


def _missing_stream_error(
    path: Path, stream: StreamLayout, contents: EpisodeContents, look: EpisodeContents
) -> TacpipeError:
    """Return the error for a stream of a layout that is missing in its container."""
    reason = contents.skipped.get(stream.source) or look.skipped.get(stream.source)
    if reason:
        return TacpipeError(f"{path}: {plain(stream.source)} of [streams.{stream.name}] cannot be read: {reason}.")
    return TacpipeError(
        f"{path} has no {plain(stream.source)}, which [streams.{stream.name}] names; it has "
        f"{listed([source_stream.source for source_stream in look.streams], 6)}. Correct source, or set optional = true."
    )
