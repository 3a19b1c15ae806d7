"""Read HDF5 files of robomimic, ALOHA or a lab's own.

Each group of arrays of one length is a stream, with the stamps that lie beside them or a rate that an attribute states.

Example: tacpipe ingest hdf5 demos -o data/recordings
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.formats.table.contained import Command, Params
from tacpipe.plugins.stage import Files, RecordingOutput, Values, stage

if TYPE_CHECKING:
    from tacpipe.formats.arrays.container import ArrayContainer

COMMAND = Command("hdf5")


def opened(path: Path) -> ArrayContainer:
    """Return the container at ``path``."""
    from tacpipe.plugins import extras

    with extras.named("Reading HDF5"):
        from tacpipe.formats.arrays import hdf5
    from tacpipe.formats.arrays.container import ArrayContainer

    return ArrayContainer(path, lambda: hdf5.opened(path))


@stage(
    version=2, discover=COMMAND.discover, preview=COMMAND.preview, guess=COMMAND.guess, why_unread=COMMAND.why_unread
)
def hdf5(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read HDF5 files of robomimic, ALOHA or a lab's own.

    A group such as demo_0 is a recording, else the file is one. A group of arrays of one length is a stream, with the stamps
    that lie next to them or a rate that an attribute states. ``--guess`` prints what the files declare as a layout file,
    to which rates, quantities and units can be added.

    Example: tacpipe ingest hdf5 demos -o data/recordings
    """
    return COMMAND.read(params, files, values)
