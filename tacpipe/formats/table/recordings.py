"""Which files below a folder make which recording, by the patterns of a layout."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tacpipe.datasets import recording_names
from tacpipe.errors import TacpipeError, UsageError, is_input_error
from tacpipe.formats.containers import kinds
from tacpipe.formats.containers.container import Naming
from tacpipe.formats.table import pattern, rows
from tacpipe.formats.table.layout import FILE, STAMPS, Format, Layout, Stream
from tacpipe.io import files as file_system
from tacpipe.printable import listed, plain

CONTAINER = "container"  # among a source's files: the one that holds all streams


@dataclass(frozen=True)
class Source:
    """The files of one recording: a path a stream, what the placeholders are, and its name where a file holds many."""

    name: str
    files: Mapping[str, Path]
    values: Mapping[str, str]
    within: str | None = None  # what its rows hold in the column ``recording``


def found(layout: Layout, folder: Path) -> list[Source]:
    """Return the recordings below ``folder``, sorted by name.

    Raises `UsageError` where none is found, where one lacks a stream that is not optional, where two files of one stream
    belong to one recording, and where two recordings get one name.
    """
    if layout.found_by_format:
        raise UsageError("The layout has no stream with files.")
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder. Give the folder that the patterns of the layout start from.")
    every = _every(layout, folder)
    matched = {stream.name: _matched(stream, every) for stream in layout.streams}
    _refuse_idle(layout, matched, every, folder)
    shared = layout.placeholders
    groups: dict[tuple[str, ...], dict[str, list[Path]]] = {}
    stamps: dict[Path, Path] = {}  # the file of the rows to the file of their stamps
    for stream in layout.streams:
        for path, values in matched[stream.name]:
            if not set(shared) <= set(values):
                raise UsageError(
                    f"[streams.{stream.name}] files has no {{{shared[0]}}}, by which files belong to a recording. Add it."
                )
            if stream.time.file:
                stamps[path] = Path(pattern.filled(stream.time.file, values))
            groups.setdefault(tuple(values[one] for one in shared), {}).setdefault(stream.name, []).append(path)
    sources = []
    for key, by_stream in sorted(groups.items()):
        for name, paths in by_stream.items():
            if len(paths) > 1:
                raise UsageError(
                    f"{listed(paths, 3)} are all the stream {name} of one recording ({_described(shared, key)}). Add a "
                    f"placeholder to every files pattern that distinguishes them."
                )
        lacking = [one.name for one in layout.streams if not one.optional and one.name not in by_stream]
        if lacking:
            there = next(iter(by_stream.values()))[0]
            raise UsageError(
                f"The recording of {there} ({_described(shared, key)}) has no file of the stream {listed(lacking, 3)}. Add "
                f"it, or set optional = true in [streams.{lacking[0]}]."
            )
        files = {name: folder / paths[0] for name, paths in by_stream.items()}
        files |= {
            f"{name}{STAMPS}": folder / stamps[rows_path]
            for name, (rows_path,) in by_stream.items()
            if rows_path in stamps
        }
        sources += _named(layout, files, dict(zip(shared, key, strict=True)))
    recording_names.refuse_shared((one.name, next(iter(one.files.values()))) for one in sources)
    return sorted(sources, key=lambda one: one.name)


def contained(layout: Layout, kind: Format, source: Path) -> list[Source]:
    """Return the recordings in the containers of a format at or below ``source``, sorted by name.

    They are named after their file, and after the episode where it holds several. Raises `UsageError` where there is no
    container, and where two recordings get one name.
    """
    paths = kinds.found(kind, source)
    if not paths:
        raise kinds.none(kind, source)
    sources = []
    for path, stem in kinds.names(paths, source).items():
        stem = os.fsencode(stem).decode(errors="replace")
        files = {one.name: path for one in layout.streams} or {CONTAINER: path}
        episodes, whole = _episodes(kind, path)
        for episode in episodes:
            values = {FILE: stem, **({} if episode is None else {"recording": episode})}
            plain_name = stem if episode is None else episode if whole else f"{stem}-{episode}"
            name = recording_names.valid(pattern.filled(layout.name, values) if layout.name else plain_name)
            if not name:
                raise UsageError(f"{path} gives no name for a recording. Set name in [recordings], or rename the file.")
            sources.append(Source(name, files, {}, episode))
    recording_names.refuse_shared((one.name, next(iter(one.files.values()))) for one in sources)
    return sorted(sources, key=lambda one: one.name)


def _episodes(kind: str, path: Path) -> tuple[Sequence[str | None], bool]:
    """Return the recordings in a container, [None] where it is one, and whether these names need no container's before them.

    A container that cannot be read is one: reading it shows what is wrong, and others are not kept from being read.
    """
    try:
        container = kinds.opened(kind, path)
        return container.episodes() or [None], isinstance(container, Naming) and container.names_itself
    except TacpipeError as error:
        if not is_input_error(error):
            raise
        return [None], False


def _every(layout: Layout, folder: Path) -> list[Path]:
    """Return what patterns are matched with: all files below a folder, and folders that are containers of the layout."""
    containers = {str(one.format) for one in layout.streams if one.contained}
    found: list[Path] = []
    for place, folders, names in file_system.walk(folder):
        if any(kinds.is_one(kind, Path(place)) for kind in containers):
            found.append(Path(place))
            folders.clear()
            continue
        found += [Path(place, name) for name in names]
    return [path.relative_to(folder) for path in found]


def _matched(stream: Stream, every: list[Path]) -> list[tuple[Path, Mapping[str, str]]]:
    found: list[tuple[Path, Mapping[str, str]]] = []
    for path in every:
        values = pattern.match(stream.files, path.as_posix())
        if values is not None:
            found.append((path, {name: os.fsencode(value).decode(errors="replace") for name, value in values.items()}))
    return found


def _refuse_idle(layout: Layout, matched: Mapping[str, object], every: list[Path], folder: Path) -> None:
    for stream in layout.streams:
        if not matched[stream.name] and not stream.optional:
            raise UsageError(
                f"No file below {folder} matches {plain(stream.files, 120)} of [streams.{stream.name}]. There are "
                f"{len(every)} files, as {listed(every, 3)}; patterns start from {folder}."
            )


def _named(layout: Layout, files: Mapping[str, Path], values: Mapping[str, str]) -> list[Source]:
    """Return the recording of these files, or those that they hold."""
    several = [one for one in layout.streams if (one.recording or one.contained) and one.name in files]
    within = {one.name: found for one in several if (found := _within(files[one.name], one)) is not None}
    if not within:
        return [Source(_name(layout, values, files), files, values)]
    first = next(iter(within.values()))
    for stream, names in within.items():
        if names != first:
            odd = sorted(names ^ first)
            raise UsageError(
                f"{files[stream]} and {files[next(iter(within))]} hold different recordings: {listed(odd, 3)} is in one "
                f"of them alone."
            )
    return [Source(_name(layout, {**values, "recording": one}, files), files, values, one) for one in sorted(first)]


def _within(path: Path, stream: Stream) -> set[str] | None:
    """Return the recordings that a file holds: what is in its column ``recording``, or a container's episodes.

    None of a container that is one recording.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    if stream.contained:
        return {one for one in _episodes(str(stream.format), path)[0] if one is not None} or None
    file = rows.opened(path, stream)
    if stream.recording not in file.names():
        raise TacpipeError(
            f"{path} has no column {plain(stream.recording)}, which [streams.{stream.name}] recording names."
        )
    found: set[str] = set()
    for block in file.batches({stream.recording: pa.string()}):
        names = pc.unique(block.column(stream.recording).cast(pa.string())).to_pylist()
        if None in names or "" in names:
            raise TacpipeError(
                f"{path}, column {plain(stream.recording)}: a row names no recording. Fill the cell, or take the row away."
            )
        found |= set(names)
    return found


def _name(layout: Layout, values: Mapping[str, str], files: Mapping[str, Path]) -> str:
    if layout.name:
        text = pattern.filled(layout.name, values)
    elif values:
        text = "-".join(f"{name}-{value}" if value.isdigit() else value for name, value in values.items())
    else:
        text = next(iter(files.values())).name.partition(".")[0]
    name = recording_names.valid(text)
    if not name:
        raise UsageError(f"{plain(text)} cannot be a recording's name. Set name in [recordings].")
    return name


def _described(names: tuple[str, ...], values: tuple[str, ...]) -> str:
    return ", ".join(f"{name} {plain(value)}" for name, value in zip(names, values, strict=True)) or "no placeholder"
