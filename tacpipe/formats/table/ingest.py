"""Read a lab's own tables, as a layout file describes them.

CSV, TSV, Excel, Parquet, NPY, NPZ and JSON lines, one file or several a recording. ``--guess`` prints a first layout,
``--dry-run`` describes what a layout would read.

Example: tacpipe ingest table my-lab --layout layout.toml -o data/recordings
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tacpipe.errors import UsageError
from tacpipe.formats.table import layout as layouts
from tacpipe.plugins.constraints import TomlFile
from tacpipe.plugins.stage import Files, RecordingOutput, Shared, Source, Values, stage
from tacpipe.plugins.stream_selection import StreamSelection


@dataclass(frozen=True)
class Params(StreamSelection):
    """How the tables are laid out."""

    layout: Annotated[str, TomlFile()] = ""  # layout file; docs/reference/layout.md describes its entries

    def check(self) -> None:
        """Raise `UsageError` for a layout that is missing or wrong, before any file is looked for."""
        self.parsed()

    def parsed(self) -> layouts.Layout:
        """Return the layout."""
        if not self.layout:
            raise UsageError("--layout must be given: the file that describes the tables. --guess prints a first one.")
        return layouts.layout_from_tables(json.loads(self.layout), "The layout")


def discover(params: Params, source: Path) -> dict[str, Source]:
    """Return the files and labels of each recording below ``source``."""
    from tacpipe.formats.table import contained, recordings

    layout = params.parsed()
    return contained.discover_sources(layout, source, recordings.find_recordings(layout, source))


def preview(params: Params, source: Path) -> str:
    """Return what would be read, in words."""
    from tacpipe.formats.table import contained, recordings

    layout = params.parsed()
    return contained.preview_text(layout, source, recordings.find_recordings(layout, source))


def guess(source: Path) -> str:
    """Return the text of a first layout."""
    from tacpipe.formats.table import guess

    return guess.guess_layout(source)


def why_unread(params: Params, source: Path) -> Callable[[str], str]:
    """Return a function from the path of a file below ``source`` to the reason why no recording is read from it."""
    from tacpipe.formats.table import contained

    return contained.why_unread(params.parsed(), source)


@stage(version=1, discover=discover, preview=preview, guess=guess, why_unread=why_unread)
def table(params: Params, files: Files, values: Values, shared: Shared | None = None) -> RecordingOutput:
    """Read a lab's own tables (CSV, Excel, Parquet, NumPy).

    A layout file names the files of each recording, their columns with quantity and unit, where time stamps and labels
    come from. Start with ``--guess``, replace each "?" in what it prints, look at the result with ``--dry-run``.

    Example: tacpipe ingest table my-lab --layout layout.toml -o data/recordings
    """
    from tacpipe.formats.table import contained

    return contained.read_recording(params.parsed(), None, files, values, shared)
