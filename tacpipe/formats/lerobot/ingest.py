"""Read LeRobot datasets.

Example: tacpipe ingest lerobot datasets/pusht -o data/recordings
"""

from __future__ import annotations

from tacpipe.formats.table.contained import Command, Params
from tacpipe.plugins.stage import Files, RecordingOutput, Values, stage

COMMAND = Command("lerobot")


@stage(
    version=2, discover=COMMAND.discover, preview=COMMAND.preview, guess=COMMAND.guess, why_unread=COMMAND.why_unread
)
def lerobot(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read LeRobot datasets, version 2.0, 2.1 and 3.0.

    An episode is a recording, a feature a stream, the task a label. Stamps are frame_index / fps where the timestamps agree
    with it. Videos are named and not read. A dataset that tacpipe exported gives the streams back as they were.

    Example: tacpipe ingest lerobot datasets/pusht -o data/recordings
    """
    return COMMAND.read(params, files, values)
