"""Read recordings of Lab Streaming Layer, as its LabRecorder writes them (XDF).

Each stream becomes one with its channels' names and units, markers become text. Stamps are moved to the clock of the
computer that recorded by a fit of the clock offsets in the file. These stay next to them, as do the stamps that were sent.

Example: tacpipe ingest xdf sessions -o data/recordings
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.formats.table.contained import Command, Params
from tacpipe.plugins.stage import Files, RecordingOutput, Values, stage

if TYPE_CHECKING:
    from tacpipe.formats.containers.container import Container

COMMAND = Command("xdf")


def opened(path: Path) -> Container:
    """Return an XDF file as a container."""
    from tacpipe.formats.xdf_streams import XdfFile

    return XdfFile(path)


@stage(
    version=1, discover=COMMAND.discover, preview=COMMAND.preview, guess=COMMAND.guess, why_unread=COMMAND.why_unread
)
def xdf(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read recordings of Lab Streaming Layer (XDF).

    Streams, channels and units are as the file declares them; a layout file replaces what is wrong. Stamps are on the
    clock of the computer that recorded, and as they were sent in ``t_device_ns``.

    Example: tacpipe ingest xdf sessions -o data/recordings
    """
    return COMMAND.read(params, files, values)
