"""Find, describe and read the recordings of containers and tables, with or without a layout."""

from __future__ import annotations

import contextlib
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol

from tacpipe.errors import TacpipeError, is_input_error
from tacpipe.formats.container import (
    Container,
    Share,
    container_files,
    describe_unread,
    find_containers,
    open_container,
)
from tacpipe.formats.table import layout as layouts
from tacpipe.formats.table import pattern
from tacpipe.plugins import failures
from tacpipe.plugins.constraints import TomlFile
from tacpipe.plugins.stage import Discovery, Files, RecordingOutput, Shared, Source, Values
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    from tacpipe.formats.table import recordings

EPISODE = "recording"  # key of a source's values for the recording's name in its files
LABELS = "labels"
CONTAINER_VALUES = "stated"  # key of a source's values for metadata of a shared container


@dataclass(frozen=True)
class Params(StreamSelection):
    """Settings that the files do not state."""

    layout: Annotated[str, TomlFile()] = ""  # layout file, for what the files do not declare; --guess prints one

    def reading(self) -> AbstractContextManager[None]:
        """Return a context in which files are read with these settings."""
        return contextlib.nullcontext()


class LayoutParams(Protocol):
    """Settings of a command that reads files as a layout describes them."""

    @property
    def layout(self) -> str:
        """The layout as JSON, or empty text for none."""

    def reading(self) -> AbstractContextManager[None]:
        """Return a context in which files are read with these settings."""


@dataclass(frozen=True)
class LayoutCommand:
    """The functions of a stage that ingests a format of containers, or tables if ``kind`` is None.

    ::

        COMMAND = LayoutCommand("xdf")

        @stage(version=1, source=COMMAND.discovery)
        def xdf(params: Params, files: Files, values: Values) -> RecordingOutput:
            \"\"\"Read recordings of LSL's LabRecorder (XDF).\"\"\"
            return COMMAND.read(params, files, values)
    """

    kind: layouts.Format | None

    @property
    def discovery(self) -> Discovery:
        """How a stage of this format finds recordings."""
        return Discovery(self.discover, self.why_unread, self.preview, self.guess)

    def parsed(self, params: LayoutParams) -> layouts.Layout:
        """Return the parsed layout, or an empty one if none was given."""
        return _parsed(params.layout or "{}", self.kind)

    def discover(self, params: LayoutParams, source: Path) -> dict[str, Source]:
        """Return the files, labels and episode of each recording at or below ``source``."""
        from tacpipe.formats.table import labels

        layout = self.parsed(params)
        recordings = self._find_recordings(layout, source)
        labelled = labels.find_labels(layout, source if source.is_dir() else source.parent, recordings)
        shares = _ContainerShares(layout, self.kind)
        sources_by_name = {}
        for recording in recordings:
            files, container_values = shares.files_and_values(recording)
            optional_values = {EPISODE: recording.episode, CONTAINER_VALUES: container_values or None}
            stated_values = {key: value for key, value in optional_values.items() if value is not None}
            sources_by_name[recording.name] = Source(files, {LABELS: labelled[recording.name], **stated_values})
        return sources_by_name

    def preview(self, params: LayoutParams, source: Path) -> str:
        """Return a description of what would be read from a source, and what would not."""
        from tacpipe.formats.table import preview

        layout = self.parsed(params)
        recordings = self._find_recordings(layout, source)
        paths = [path for recording in recordings for path in member_files(recording.files).values()]
        left_out = describe_unread(source, paths, self.why_unread(params, source))
        with params.reading():
            return "\n".join([preview.describe_sources(layout, source, recordings, self.kind), *left_out])

    def guess(self, source: Path) -> str:
        """Return the text of a layout with everything that the first file declares, or that is guessed for tables."""
        from tacpipe.formats.table import guess, preview

        return guess.guess_layout(source) if self.kind is None else preview.declared_layout(self.kind, source)

    def why_unread(self, params: LayoutParams, source: Path) -> Callable[[str], str]:
        """Return a function from a file's path below ``source`` to the reason why the layout does not read it.

        The reason is "" for label files and for files in a container.
        """
        layout = self.parsed(params)
        formats = {str(stream.format) for stream in layout.streams if stream.contained} or {self.kind} - {None}
        folders = [path for name in formats for path in find_containers(str(name), source) if path.is_dir()]

        def explain(path: str) -> str:
            if any(pattern.match(labels.file, path) is not None for labels in layout.labels):
                return ""
            if any((source / path).is_relative_to(folder) for folder in folders):
                return ""
            return layouts.why_unreadable(path, "no `files` of the layout matches" if layout.streams else "", self.kind)

        return explain

    def read(self, params: LayoutParams, files: Files, values: Values, shared: Shared | None = None) -> RecordingOutput:
        """Return one recording of ``files`` from `discover`; without a layout, everything in the container.

        With ``shared``, a table of several recordings is split only once.
        """
        from tacpipe.formats.table import recordings

        layout, paths = self.parsed(params), container_paths(files)
        with params.reading():
            if layout.streams:
                output = recordings.read_streams(layout.streams, paths, values.get(EPISODE), shared)
            else:
                output = recordings.read_container(str(self.kind), paths[recordings.CONTAINER], values.get(EPISODE))
        return replace(output, attributes={**output.attributes, **values[LABELS]})

    def _find_recordings(self, layout: layouts.Layout, source: Path) -> list[recordings.RecordingFiles]:
        """Return the recordings of a source: its containers, or those that the patterns of the layout match."""
        from tacpipe.formats.table import recordings

        if self.kind is not None and layout.found_by_format:
            return recordings.find_contained(layout, self.kind, source)
        return recordings.find_recordings(layout, source)


@functools.lru_cache(maxsize=1)  # a process reads many recordings with one layout
def _parsed(text: str, kind: layouts.Format | None) -> layouts.Layout:
    """Return the parsed layout in a JSON text."""
    return layouts.layout_from_tables(json.loads(text), "The layout", kind)


class _ContainerShares:
    """The files and container metadata of each recording; opens each container once."""

    def __init__(self, layout: layouts.Layout, kind: layouts.Format | None) -> None:
        self._layout, self._kind = layout, kind
        self._opened: dict[Path, Container] = {}

    def files_and_values(self, recording: recordings.RecordingFiles) -> tuple[dict[str, Path], Values]:
        """Return the files of a recording by name, and the values it depends on in containers shared by recordings."""
        files: dict[str, Path] = {}
        values: dict[str, Values] = {}  # values by name of a file
        names_by_path: dict[Path, list[str]] = {}
        for name, path in recording.files.items():
            names_by_path.setdefault(path, []).append(name)
        for path, names in names_by_path.items():
            share = self._share(path, names, recording.episode) if path.is_dir() else None
            if share is None:
                files |= member_files(dict.fromkeys(names, path))
                continue
            for name in names:
                files |= {f"{name}/{inner_path}": inner_file for inner_path, inner_file in share.files.items()}
            if share.values:
                values[names[0]] = dict(share.values)
        return files, values

    def _share(self, path: Path, names: Sequence[str], episode: str | None) -> Share | None:
        """Return the files that streams of a container are read from, or None for all of its files."""
        streams = {stream.name: stream for stream in self._layout.streams if stream.name in names}
        kind = next((str(stream.format) for stream in streams.values()), self._kind)
        if kind in layouts.CAMERA:
            return None
        requested = [stream.source for stream in streams.values()] or None
        try:
            with failures.naming_source([path]):
                if path not in self._opened:
                    self._opened[path] = open_container(str(kind), path)
                return self._opened[path].share(requested, episode)
        except TacpipeError as error:
            if not is_input_error(error):
                raise
            return None  # reading reports the error for this recording only


def member_files(paths: Mapping[str, Path]) -> dict[str, Path]:
    """Return all files of a recording by name; the files of a folder are named ``name/relative path``."""
    return {
        f"{name}/{inner_path}" if inner_path else name: path
        for name, path in paths.items()
        for inner_path, path in container_files(path).items()
    }


def container_paths(files: Files) -> dict[str, Path]:
    """Return the paths whose `member_files` these files are.

    >>> container_paths({"skin": Path("a.csv"), "container/meta/info.json": Path("lab/run/meta/info.json")})
    {'skin': PosixPath('a.csv'), 'container': PosixPath('lab/run')}
    """
    paths: dict[str, Path] = {}
    for key, path in files.items():
        name, _, inner_path = key.partition("/")
        paths.setdefault(name, path.parents[inner_path.count("/")] if inner_path else path)
    return paths
