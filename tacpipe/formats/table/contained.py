"""What the commands of containers share: finding recordings, describing and reading them, with or without a layout."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tacpipe.formats.table import layout as layouts
from tacpipe.plugins.constraints import TomlFile
from tacpipe.plugins.stage import Files, RecordingOutput, Source, Values

if TYPE_CHECKING:
    from tacpipe.formats.table import recordings

WITHIN = "recording"  # among a source's values: which of the recordings that its files hold
LABELS = "labels"


@dataclass(frozen=True)
class Params:
    """What the files do not state of themselves."""

    layout: Annotated[str, TomlFile()] = ""  # layout file, for what the files do not state; --guess prints one


@dataclass(frozen=True)
class Command:
    """The four functions of a stage that ingests a format of containers.

    ::

        COMMAND = Command("xdf")

        @stage(version=1, discover=COMMAND.discover, preview=COMMAND.preview, guess=COMMAND.guess)
        def xdf(params: Params, files: Files, values: Values) -> RecordingOutput:
            \"\"\"Read recordings of LSL's LabRecorder (XDF).\"\"\"
            return COMMAND.read(params, files, values)
    """

    kind: layouts.Format

    def parsed(self, params: Params) -> layouts.Layout:
        """Return the layout, one that leaves everything to the files where none is given."""
        return layouts.of(json.loads(params.layout or "{}"), "The layout", self.kind)

    def discover(self, params: Params, source: Path) -> dict[str, Source]:
        """Return the files and labels of each recording at or below ``source``."""
        layout = self.parsed(params)
        return sources(layout, source, self._found(layout, source))

    def preview(self, params: Params, source: Path) -> str:
        """Return what would be read, in words."""
        from tacpipe.formats.table import preview

        layout = self.parsed(params)
        return preview.text(layout, source, self._found(layout, source), self.kind)

    def guess(self, source: Path) -> str:
        """Return the text of the layout that states what the first file itself declares."""
        from tacpipe.formats.table import declared

        return declared.layout(self.kind, source)

    def read(self, params: Params, files: Files, values: Values) -> RecordingOutput:
        """Return one recording."""
        return recording(self.parsed(params), self.kind, files, values)

    def _found(self, layout: layouts.Layout, source: Path) -> list[recordings.Source]:
        from tacpipe.formats.table import recordings

        if layout.found_by_format:
            return recordings.contained(layout, self.kind, source)
        return recordings.found(layout, source)


def sources(layout: layouts.Layout, source: Path, found: Sequence[recordings.Source]) -> dict[str, Source]:
    """Return recordings as a stage's ``discover`` does: their files, labels, and which one of a file each is."""
    from tacpipe.formats.table import labels

    labelled = labels.found(layout, source if source.is_dir() else source.parent, found)
    return {
        one.name: Source(
            members(one.files), {LABELS: labelled[one.name], **({} if one.within is None else {WITHIN: one.within})}
        )
        for one in found
    }


def recording(layout: layouts.Layout, kind: layouts.Format | None, files: Files, values: Values) -> RecordingOutput:
    """Return one recording of ``files``, as `sources` found it; without streams in the layout all of a container."""
    from tacpipe.formats.table import reading
    from tacpipe.formats.table.recordings import CONTAINER

    paths = containers(files)
    if layout.streams:
        made = reading.recorded(layout.streams, paths, values.get(WITHIN))
    else:
        made = reading.all_of(str(kind), paths[CONTAINER], values.get(WITHIN))
    return RecordingOutput(made.streams, {**made.attributes, **values[LABELS]}, made.notes)


def members(paths: Mapping[str, Path]) -> dict[str, Path]:
    """Return all files of a recording by name: of a path that is a folder each file in it, by ``name/path within``."""
    from tacpipe.formats.containers import kinds

    return {
        f"{name}/{within}" if within else name: path
        for name, place in paths.items()
        for within, path in kinds.members(place).items()
    }


def containers(files: Files) -> dict[str, Path]:
    """Return the paths whose `members` these files are.

    >>> containers({"skin": Path("a.csv"), "container/meta/info.json": Path("lab/run/meta/info.json")})
    {'skin': PosixPath('a.csv'), 'container': PosixPath('lab/run')}
    """
    found: dict[str, Path] = {}
    for key, path in files.items():
        name, _, within = key.partition("/")
        found.setdefault(name, path.parents[within.count("/")] if within else path)
    return found
