"""Read ROS bags and MCAP files, with or without a layout."""

from __future__ import annotations

from tacpipe.formats.table.contained import Command, Params
from tacpipe.plugins.stage import Files, RecordingOutput, Values, stage

_ROSBAG, _MCAP = Command("rosbag"), Command("mcap")


@stage(
    version=2, discover=_ROSBAG.discover, preview=_ROSBAG.preview, guess=_ROSBAG.guess, why_unread=_ROSBAG.why_unread
)
def rosbag(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read ROS bags (ROS 1, ROS 2 with SQLite or MCAP).

    Each bag is a recording, each topic a stream. Usual messages have names, quantities and units of their own; others
    are read by their definition. The time of a row is its header's stamp, or the log time where there is none.

    Example: tacpipe ingest rosbag FOLDER -o data/recordings
    """
    return _ROSBAG.read(params, files, values)


@stage(version=2, discover=_MCAP.discover, preview=_MCAP.preview, guess=_MCAP.guess, why_unread=_MCAP.why_unread)
def mcap(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read MCAP files (ROS, JSON or protobuf messages).

    Each file is a recording, each topic a stream. Usual messages have names, quantities and units of their own; others
    are read by their definition. The time of a row is its header's stamp, or the log time where there is none.

    Example: tacpipe ingest mcap FOLDER -o data/recordings
    """
    return _MCAP.read(params, files, values)
