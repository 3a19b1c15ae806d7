"""Read Zarr stores, as replay buffers of UMI.

Example: tacpipe ingest zarr replay.zarr.zip --layout layout.toml -o data/recordings
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.formats.table import contained
from tacpipe.plugins.stage import Files, RecordingOutput, Values, stage

if TYPE_CHECKING:
    from tacpipe.formats.arrays.container import ArrayContainer

COMMAND = contained.Command("zarr")


@dataclass(frozen=True)
class Params(contained.Params):
    """What the stores do not declare."""

    fill_missing_chunks: bool = False  # read chunks that are not there as fill values, which zarr 3 does not write


def opened(path: Path) -> ArrayContainer:
    """Return the container at ``path``."""
    from tacpipe.formats.arrays import zarr
    from tacpipe.formats.arrays.container import ArrayContainer
    from tacpipe.plugins import extras

    extras.require("Reading Zarr", "zarr")
    return ArrayContainer(path, lambda: zarr.opened(path))


def preview(params: Params, source: Path) -> str:
    """Return what would be read, in words."""
    from tacpipe.formats.arrays import zarr

    with zarr.missing_chunks(filled=params.fill_missing_chunks):
        return COMMAND.preview(params, source)


@stage(version=2, discover=COMMAND.discover, preview=preview, guess=COMMAND.guess, why_unread=COMMAND.why_unread)
def zarr(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read Zarr stores, as replay buffers of UMI.

    Folders and .zarr.zip files, format 2 and 3. Where meta/episode_ends cuts the arrays into episodes each is a recording,
    else the store is one. The rate, which replay buffers do not hold, comes from a layout file; ``--guess`` prints one.

    Example: tacpipe ingest zarr replay.zarr.zip --layout layout.toml -o data/recordings
    """
    from tacpipe.formats.arrays import zarr

    with zarr.missing_chunks(filled=params.fill_missing_chunks):
        return COMMAND.read(params, files, values)
