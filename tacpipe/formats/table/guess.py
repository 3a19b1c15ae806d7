"""Guess a first layout for a folder of files.

Entries that files do not contain, above all the quantity of a column, are written as ``"?"``. A layout is rejected
until a person has replaced them.
"""

from __future__ import annotations

import itertools
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from tacpipe.errors import MissingModuleError, TacpipeError, UsageError
from tacpipe.formats import container, image_files
from tacpipe.formats.table import column_names, file_sample, pattern, reading, repairs, rows
from tacpipe.formats.table import layout as layouts
from tacpipe.formats.table.file_sample import SAMPLE_LINES, FileSample
from tacpipe.formats.table.label_table import RECORDING, read_label_table
from tacpipe.formats.table.layout import (
    CAMERA_EXTENSIONS,
    EXTENSIONS,
    IMAGE_NAME,
    TREES,
    UNKNOWN,
    extension,
    quoted,
    why_unreadable,
)
from tacpipe.io import config_text
from tacpipe.io import files as file_system
from tacpipe.plugins import failures
from tacpipe.printable import shown
from tacpipe.video.files import DEMUXERS, IMAGE_CODECS, scan, scan_images

VOCABULARY = (  # help for replacing a "?"
    "quantity: what a column measures, as tactile, position, orientation (a quaternion), joint_position, force, torque,",
    "  static_pressure, vibration, temperature, proximity; `tacpipe train TASK --requirements` lists what a task reads",
    "unit: as count, m, mm, 1 (of a quaternion), rad, N, kPa, V; of time s, ms, us, ns",
    '{taxel} and {axis} in match state where a tactile column lies; component = "x" which part of a vector it is',
)


Sampled = TypeVar("Sampled")  # the beginning of a file


@dataclass(frozen=True)
class _FileGroup:
    stream: str
    pattern: str
    paths: tuple[Path, ...]
    first: FileSample  # sample of the first file
    stamps: str = ""  # pattern of the files with the timestamps
    clock: FileSample | None = None  # sample of the first file with timestamps
    skipped: tuple[str, ...] = ()  # arrays that belong to other streams
    camera: tuple[str, ...] = ()  # entries of a stream of frames
    members: tuple[Path, ...] = ()  # images in the folders ``paths``


def guess_layout(folder: Path) -> str:
    """Return the text of a guessed layout for the files below ``folder``. Raises `UsageError` if no file can be a stream."""
    all_paths = [
        Path(directory, name).relative_to(folder) for directory, _, names in file_system.walk(folder) for name in names
    ]
    table_paths = [path for path in all_paths if extension(path) in EXTENSIONS]
    video_paths = [path for path in all_paths if extension(path) in DEMUXERS]
    image_paths = [path for path in all_paths if extension(path) in IMAGE_CODECS and path.parent.parts]
    if not (table_paths or video_paths or image_paths):
        kinds = ", ".join((*EXTENSIONS, *CAMERA_EXTENSIONS))
        raise UsageError(f"{folder} holds no file of {kinds}; there is nothing to guess from.")
    groups, labels, damaged = _group_files(folder, table_paths)
    groups += _camera_groups(folder, video_paths, image_paths, {group.stream for group in groups}, damaged)
    groups, stamps = _match_stamp_files(groups)
    if not groups:
        raise UsageError(f"{folder} holds no table with rows and stamps. {' '.join(damaged.values())}".rstrip())
    trees = _label_files(folder, [path for path in all_paths if path.suffix.lower() in TREES], groups)
    grouped_paths = [*(group.paths for group in [*groups, *stamps, *labels]), *trees.values()]
    read_files = [folder / path for paths in [*grouped_paths, *(group.members for group in groups)] for path in paths]

    def explain(path: str) -> str:
        return damaged.get(path) or why_unreadable(
            path, "it is no stream, and no file of labels that each recording has"
        )

    sections = [_with_repairs(_stream_text(group), group, folder) for group in groups]
    sections += [_labels_text(group) for group in labels]
    sections += [f"[[labels]]\nfile = {quoted(text)}" for text in trees]
    sections.append('[attributes]\nsensor = "?"  # the product, as xela-uskin or the lab\'s own name for it')
    header = [
        '# A first layout, guessed from the files. Replace each "?", check the rest, then look at what it reads:',
        "#   tacpipe ingest table FOLDER --layout THIS --dry-run",
        *(f"# {line}" for line in VOCABULARY),
        *(f"# {shown(line)}" for line in container.describe_unread(folder, read_files, explain)),
    ]
    return "\n\n".join(["\n".join(header), *sections]) + "\n"


def _group_files(folder: Path, data: Sequence[Path]) -> tuple[list[_FileGroup], list[_FileGroup], dict[str, str]]:
    """Return the groups of stream files, the groups of label files, and for each unusable path, the reason."""
    by_template: dict[str, list[Path]] = {}
    for path in sorted(data):
        by_template.setdefault(_template(path), []).append(path)
    streams: list[_FileGroup] = []
    labels: list[_FileGroup] = []
    damaged: dict[str, str] = {}
    used: set[str] = set()
    for paths in itertools.chain.from_iterable(map(_group_by_file_name, by_template.values())):
        sample = _read_first(file_sample.read_sample, folder, paths, damaged)
        if sample is None:
            continue
        if sample.text is not None and not (sample.text.header or sample.text.rows):
            damaged |= {path.as_posix(): "it has no row" for path in paths}
            continue
        sample = _with_columns_of(sample, [folder / path for path in paths[1:]])
        is_shared_table = len(paths) == 1 < len(data) and _is_labels(sample)
        group = _FileGroup(
            _stream_name(paths, used), pattern.generalize(paths), tuple(paths), sample, skipped=sample.wide_arrays
        )
        has_one_row_per_file = (
            sample.text is not None and sample.text.header and len(sample.text.rows) == 1 and len(paths) > 1
        )
        if is_shared_table or has_one_row_per_file:
            labels.append(group)
        else:
            streams += _group_by_length(group)
    return streams, labels, damaged


def _read_first(
    read: Callable[[Path], Sampled], folder: Path, paths: Sequence[Path], damaged: dict[str, str]
) -> Sampled | None:
    """Return what ``read`` returns for the first file of a stream.

    If it is damaged, returns None, and adds the reason for each of the ``paths`` to ``damaged``.
    """
    try:
        with failures.naming_source([folder / paths[0]]):
            return read(folder / paths[0])
    except MissingModuleError:
        raise
    except TacpipeError as error:
        damaged |= {path.as_posix(): str(error).rstrip(".") for path in paths}
        return None


def _with_columns_of(sample: FileSample, paths: Sequence[Path]) -> FileSample:
    """Return the sample of a text file with the columns that only other files of the stream have."""
    for path in paths if sample.text is not None and sample.text.header else ():
        try:
            with failures.naming_source([path]):
                other = file_sample.read_sample(path)
        except TacpipeError:
            continue
        names = [name for name in other.names if name not in sample.values] if other.text and other.text.header else []
        values = {name: other.values[name] for name in names}
        sample = replace(sample, names=(*sample.names, *names), values={**sample.values, **values})
    return sample


def _camera_groups(
    folder: Path, videos: Sequence[Path], images: Sequence[Path], used: set[str], damaged: dict[str, str]
) -> list[_FileGroup]:
    """Return the streams of video files and image folders. Adds the reason for each unreadable path to ``damaged``."""
    by_template: dict[tuple[str, bool], list[Path]] = {}
    folders = dict.fromkeys(path.parent for path in images)
    for path in sorted([*videos, *folders]):
        by_template.setdefault((_template(path), path in folders), []).append(path)
    groups = []
    for (_, are_folders), paths in by_template.items():
        for same_stream in _group_by_file_name(paths):
            described = _read_first(_image_entries if are_folders else _video_entries, folder, same_stream, damaged)
            if described is None:
                continue
            entries, count = described
            sample = FileSample((), {}, frames=count)
            members = tuple(path for path in images if path.parent in same_stream) if are_folders else ()
            name = _stream_name(same_stream, used)
            groups.append(
                _FileGroup(
                    name, pattern.generalize(same_stream), tuple(same_stream), sample, camera=entries, members=members
                )
            )
    return groups


def _video_entries(path: Path) -> tuple[tuple[str, ...], int]:
    """Return the layout entries and the number of frames of a video file."""
    frames = scan(path)
    return (f"# {frames.video_format.describe()}; without an entry time, stamps are those of the file",), len(frames)


def _image_entries(folder: Path) -> tuple[tuple[str, ...], int]:
    """Return the layout entries and the number of images of a folder. Large numbers in file names are timestamps."""
    paths = image_files.image_paths(folder)
    numbers = [image_files.last_number(path) for path in paths]
    values = tuple(float(number) if "." in number else int(number) for number in numbers if number is not None)
    is_stamp = len(values) == len(paths) and min(values) >= 1e8
    time = f'{{ rate_hz = "{UNKNOWN}" }}  # the names hold no stamps'
    if is_stamp:
        time = file_sample.time_entry(FileSample((IMAGE_NAME,), {IMAGE_NAME: values}), IMAGE_NAME)
    return ('format = "images"', f"# {scan_images(paths[:1]).describe()}", f"time = {time}"), len(paths)


def _group_by_length(group: _FileGroup) -> list[_FileGroup]:
    """Return the streams of the arrays in a file: one per array of images, and one per length of the other arrays.

    A file without arrays is one stream.
    """
    pictures = [name for name, array in group.first.arrays.items() if array.is_pictures]
    if pictures:
        others = [name for name in group.first.arrays if name not in pictures]
        clock = file_sample.time_column(group.first.only(others)) if others else None
        streams = [_picture_group(group, name, clock) for name in pictures]
        if set(others) - {clock}:
            without_pictures = replace(group, first=group.first.only(others), skipped=(*group.skipped, *pictures))
            streams += _group_by_length(without_pictures)
        return streams
    by_length: dict[int, list[str]] = {}
    for name, array in group.first.arrays.items():
        by_length.setdefault(array.rows, []).append(name)
    if len(by_length) < 2:
        return [group]
    groups = []
    for names in by_length.values():
        widest = max(names, key=lambda name: group.first.arrays[name].width or 1)
        skipped = (*group.skipped, *(name for name in group.first.arrays if name not in names))
        stream = re.sub(r"\W", "_", widest) if widest.isascii() and not widest[0].isdigit() else group.stream
        groups.append(replace(group, stream=stream, first=group.first.only(names), skipped=skipped))
    return groups


def _picture_group(group: _FileGroup, array: str, clock: str | None) -> _FileGroup:
    """Return the stream of an array of decoded images, with the timestamps of the array ``clock`` in the same file."""
    video_format = group.first.arrays[array].video_format
    assert video_format is not None
    time = f'{{ rate_hz = "{UNKNOWN}" }}' if clock is None else file_sample.time_entry(group.first, clock)
    entries = (f"array = {quoted(array)}  # {video_format.describe()}", f"time = {time}")
    stream = re.sub(r"\W", "_", array) if array.isascii() and not array[0].isdigit() else group.stream
    sample = FileSample((), {}, frames=group.first.arrays[array].rows)
    return replace(group, stream=stream, first=sample, camera=entries)


def _match_stamp_files(groups: Sequence[_FileGroup]) -> tuple[list[_FileGroup], list[_FileGroup]]:
    """Return the streams, and the groups of timestamp files that they use.

    A stream without timestamps gets a file of one column and equal length in its folder.
    """
    clocks = [group for group in groups if len(group.first.names) == 1 and _is_clock(group)]
    used: list[_FileGroup] = []
    streams: list[_FileGroup] = []
    for group in groups:
        if group in clocks:
            continue
        candidates = [
            clock
            for clock in clocks
            if clock.pattern.rpartition("/")[0] == group.pattern.rpartition("/")[0]
            and (group.first.row_count is None or clock.first.row_count in (None, group.first.row_count))
        ]
        if file_sample.time_column(group.first) is None and candidates:
            clock = max(candidates, key=lambda clock: group.stream in clock.stream)
            used.append(clock)
            streams.append(replace(group, stamps=clock.pattern, clock=clock.first))
        else:
            streams.append(group)
    return [*streams, *(clock for clock in clocks if clock not in used)], used


def _is_clock(group: _FileGroup) -> bool:
    """Return whether a one-column file is named like timestamps and its values increase or are text."""
    stem = group.paths[0].name.partition(".")[0]
    match = column_names.TIME_NAME.fullmatch(stem) or column_names.TIME_ENDING.fullmatch(stem)
    (values,) = group.first.values.values()
    return bool(match) and (file_sample.increases(values) or any(isinstance(value, str) for value in values))


def _stream_name(paths: Sequence[Path], used: set[str]) -> str:
    """Return an unused name for the stream of these files and add it to ``used``."""
    stem = re.sub(r"\{\w+\}", "", pattern.generalize([Path(path.name) for path in paths])).partition(".")[0].lower()
    name = re.sub(r"[^a-z0-9]+", "_", stem).replace("trial", "").strip("_")
    name = name if name.isidentifier() else "table"
    candidates = itertools.chain([name], (f"{name}{number}" for number in itertools.count(2)))
    unused = next(candidate for candidate in candidates if candidate not in used)
    used.add(unused)
    return unused


def _label_files(folder: Path, paths: Sequence[Path], streams: Sequence[_FileGroup]) -> dict[str, list[Path]]:
    """Return YAML and JSON label files by pattern, for patterns with one file per recording or one file for all."""
    by_template: dict[str, list[Path]] = {}
    for path in paths:
        by_template.setdefault(_template(path), []).append(path)
    shared = set.intersection(*(set(pattern.placeholders(group.pattern)) for group in streams))
    recordings = [pattern.match(streams[0].pattern, path.as_posix()) or {} for path in streams[0].paths]
    labels = {}
    for same_template in by_template.values():
        text, names = pattern.generalize(same_template), {path.as_posix() for path in same_template}
        placeholders = set(pattern.placeholders(text))
        if not placeholders:
            is_labels = _is_table_of_labels(folder / same_template[0])
        else:
            is_labels = (
                placeholders <= shared and {pattern.fill_pattern(text, values) for values in recordings} <= names
            )
        if is_labels:
            labels[text] = same_template
    return labels


def _is_table_of_labels(path: Path) -> bool:
    """Return whether a YAML or JSON file contains labels by recording name."""
    try:
        return bool(read_label_table(path).rows)
    except TacpipeError:
        return False


def _group_by_file_name(paths: Sequence[Path]) -> list[list[Path]]:
    """Return the files of each stream: split by name if several folders contain the same names, otherwise all files."""
    by_folder: dict[Path, set[str]] = {}
    for path in paths:
        by_folder.setdefault(path.parent, set()).add(path.name)
    names = set.union(*by_folder.values())
    if len(by_folder) > 1 and len(names) > 1 and all(file_names == names for file_names in by_folder.values()):
        return [[path for path in paths if path.name == name] for name in sorted(names)]
    return [list(paths)]


def _template(path: Path) -> str:
    """Return a path's depth and its file name without numbers, which are equal for all files of a stream."""
    return "/".join(["{}"] * (len(path.parts) - 1) + [re.sub(r"\d+", "{}", path.name)])


def _is_labels(sample: FileSample) -> bool:
    """Return whether a table contains labels: it is short, has text, and has no time column."""
    if sample.text is None:
        return False
    has_text = any(isinstance(value, str) for values in sample.values.values() for value in values)
    return has_text and file_sample.time_column(sample) is None and 0 < len(sample.text.rows) < SAMPLE_LINES - 1


def _labels_text(group: _FileGroup) -> str:
    """Return the text of a ``[[labels]]`` entry."""
    lines = ["[[labels]]", f"file = {quoted(group.pattern if len(group.paths) > 1 else group.paths[0].as_posix())}"]
    if len(group.paths) == 1:
        sample = group.first
        keys = [name for name, values in sample.values.items() if len(set(values)) == len(values)]
        key = next((name for name in keys if RECORDING.fullmatch(name)), keys[0] if keys else UNKNOWN)
        lines.append(f"key = {quoted(key)}  # the column that names recordings")
    return "\n".join(lines)


def _stream_text(group: _FileGroup) -> str:
    """Return the text of a ``[streams.NAME]`` entry."""
    sample = group.first
    time = None if group.stamps else file_sample.time_column(sample)
    reserved = {time} if time else set()
    lines = [
        f"[streams.{group.stream}]",
        f"files = {quoted(group.pattern)}  # {len(group.paths)} file{'s' * (len(group.paths) != 1)}",
    ]
    if group.camera:
        lines += [line for line in group.camera if not (group.stamps and line.startswith("time"))]
        if group.clock is not None:
            file = f"file = {quoted(group.stamps)}"
            lines.append(f"time = {file_sample.time_entry(group.clock, group.clock.names[0], file)}")
        return "\n".join(lines)
    if sample.text is not None:
        lines += _text_entries(sample, group.paths[0])
    axis = next((array.time_axis for array in sample.arrays.values()), 0)
    if axis:
        lines.append(f"time_axis = {axis}  # of the shape {next(iter(sample.arrays.values())).shape}, the longest")
    recording_column = next((name for name in sample.names if RECORDING.fullmatch(name)), None)
    if recording_column is not None and len(group.paths) == 1:
        lines.append(f"recording = {quoted(recording_column)}  # the column that names the recording of a row")
        reserved.add(recording_column)
    if group.clock is not None:
        file = f"file = {quoted(group.stamps)}"
        lines.append(f"time = {file_sample.time_entry(group.clock, group.clock.names[0], file)}")
    else:
        lines.append(f"time = {file_sample.time_entry(sample, time)}")
    rules = file_sample.column_entries(sample, reserved)
    rules += [f"{{ match = {quoted(f'{name}*')}, skip = true }}," for name in group.skipped]
    lines += ["columns = [", *(f"    {rule}" for rule in rules), "]"]
    return "\n".join(lines)


def _with_repairs(text: str, group: _FileGroup, folder: Path) -> str:
    """Return the text of a stream with the entries of its time that the stamps of all files need."""
    tables = tomllib.loads(text)["streams"][group.stream]
    if group.camera or "recording" in tables or not {"column", "file"} & set(tables["time"]):
        return text
    time = {name: value for name, value in tables["time"].items() if value != UNKNOWN}
    values = {**tables, "time": time, "columns": [{"match": "*"}]}
    (stream,) = layouts.layout_from_tables({"streams": {group.stream: values}}).streams
    changes: dict[str, Any] = {}
    first_rows = []
    for path in group.paths:
        placeholders = pattern.match(group.pattern, path.as_posix()) or {}
        stamps = folder / pattern.fill_pattern(group.stamps, placeholders) if group.stamps else None
        for _ in layouts.REPAIRS:
            repaired = replace(stream, time=replace(stream.time, **{k: v for k, v in changes.items() if v != UNKNOWN}))
            try:
                with failures.naming_source([folder / path]):
                    clock = reading.check_stamps(rows.open_rows(folder / path, repaired), repaired, stamps)
                first_rows.append(clock.drop_first)
            except repairs.ClockError as error:
                if error.changes.items() <= changes.items():
                    break
                changes |= error.changes
                continue
            except TacpipeError:
                pass  # reading the file reports the error
            break
    if first_rows and all(first_rows):
        changes["drop_first"] = max(first_rows)
    added = "".join(f", {name} = {config_text.toml_value(value)}" for name, value in changes.items())
    return re.sub(r"^(time = \{.*?)( \})", lambda entry: entry[1] + added + entry[2], text, count=1, flags=re.MULTILINE)


def _text_entries(sample: FileSample, path: Path) -> list[str]:
    """Return the entries for encoding, separator and header of a text file that differ from the defaults."""
    text = sample.text
    assert text is not None
    default_separator = "\t" if ".tsv" in [suffix.lower() for suffix in path.suffixes] else ","
    entries = [
        ("encoding", sample.encoding, "utf-8"),
        ("separator", text.separator, default_separator),
        ("decimal", text.decimal, "."),
        ("comment", text.comment, ""),
    ]
    lines = [f"{name} = {quoted(value)}" for name, value, default in entries if value != default]
    if text.skip_lines:
        lines.append(f"skip_lines = {text.skip_lines}")
    if text.units:
        lines.append(f"header = [{', '.join(map(quoted, text.names))}]  # below them the file has a row of units")
    elif not text.header:
        lines.append("header = false  # or a list of the columns' names")
    if text.missing:
        lines.append(f"missing = [{', '.join(map(quoted, text.missing))}]")
    return lines
