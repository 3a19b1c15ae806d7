"""Read recordings of files into a dataset.

One command per format. Files of a robot or a lab (bags, MCAP, HDF5, Zarr, LeRobot, XDF) declare their streams, and a
layout file adds what they omit; ``table`` reads a lab's own tables, which a layout file describes. The other commands
read published datasets. ``--guess`` prints a first layout, and ``--dry-run`` describes the recordings without reading
them.

Example: tacpipe ingest mcap FOLDER -o data/recordings
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Annotated

from tacpipe.errors import UsageError
from tacpipe.formats.table.contained import LayoutCommand, Params
from tacpipe.plugins.constraints import TomlFile
from tacpipe.plugins.stage import Files, RecordingOutput, Shared, Values, stage
from tacpipe.plugins.video_checks import VideoChecks, check_videos

ROSBAG, MCAP, HDF5 = LayoutCommand("rosbag"), LayoutCommand("mcap"), LayoutCommand("hdf5")
XDF, LEROBOT, ZARR, TABLE = LayoutCommand("xdf"), LayoutCommand("lerobot"), LayoutCommand("zarr"), LayoutCommand(None)


@stage(version=4, source=ROSBAG.discovery)
def rosbag(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read ROS bags (ROS 1, ROS 2 with SQLite or MCAP).

    Each bag is a recording, and each topic a stream. Common messages have predefined names, quantities and units;
    others are read by their definition. The time of a row is the stamp of its header, or the log time if there is none.

    Example: tacpipe ingest rosbag FOLDER -o data/recordings
    """
    return ROSBAG.read(params, files, values)


@stage(version=4, source=MCAP.discovery)
def mcap(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read MCAP files (ROS, JSON or protobuf messages).

    Each file is a recording, and each topic a stream. Common messages have predefined names, quantities and units;
    others are read by their definition. The time of a row is the stamp of its header, or the log time if there is none.

    Example: tacpipe ingest mcap FOLDER -o data/recordings
    """
    return MCAP.read(params, files, values)


@stage(version=4, source=HDF5.discovery)
def hdf5(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read HDF5 files of robomimic, ALOHA or a lab's own.

    A group such as demo_0 is a recording; without such groups, the file is one. A group of arrays of the same length is
    a stream, with time stamps in the group or a rate in an attribute. ``--guess`` prints what the files declare as a
    layout file, to which rates, quantities and units can be added.

    Example: tacpipe ingest hdf5 demos -o data/recordings
    """
    return HDF5.read(params, files, values)


@stage(version=2, source=XDF.discovery)
def xdf(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read recordings of Lab Streaming Layer (XDF).

    Streams, channels and units are as the file declares them; a layout file can correct them. Stamps are on the clock
    of the recording computer; the original ones are in ``t_device_ns``.

    Example: tacpipe ingest xdf sessions -o data/recordings
    """
    return XDF.read(params, files, values)


@dataclass(frozen=True)
class LeRobotParams(VideoChecks, Params):
    """Settings that datasets do not state."""

    def reading(self) -> AbstractContextManager[None]:
        """Return a context in which videos are checked as these settings state."""
        return check_videos(self)


@stage(version=4, source=LEROBOT.discovery)
def lerobot(params: LeRobotParams, files: Files, values: Values) -> RecordingOutput:
    """Read LeRobot datasets, version 2.0, 2.1 and 3.0.

    An episode is a recording, a feature a stream, and the task a label. Stamps are frame_index / fps if the timestamps
    agree with it. Exports of tacpipe give the original streams.

    Example: tacpipe ingest lerobot datasets/pusht -o data/recordings
    """
    return LEROBOT.read(params, files, values)


@dataclass(frozen=True)
class ZarrParams(Params):
    """Settings that Zarr stores do not declare."""

    fill_missing_chunks: bool = False  # read missing chunks as fill values, which zarr 3 does not write

    def reading(self) -> AbstractContextManager[None]:
        """Return a context in which missing chunks are read as these settings state."""
        from tacpipe.formats.arrays.zarr import allow_missing_chunks

        return allow_missing_chunks(filled=self.fill_missing_chunks)


@stage(version=4, source=ZARR.discovery)
def zarr(params: ZarrParams, files: Files, values: Values) -> RecordingOutput:
    """Read Zarr stores, such as replay buffers of UMI.

    Folders and .zarr.zip files, format 2 and 3. If meta/episode_ends divides the arrays into episodes, each is a
    recording; otherwise the store is one. The rate, which replay buffers do not contain, comes from a layout file;
    ``--guess`` prints one.

    Example: tacpipe ingest zarr replay.zarr.zip --layout layout.toml -o data/recordings
    """
    return ZARR.read(params, files, values)


@dataclass(frozen=True)
class TableParams(VideoChecks):
    """Layout of the tables."""

    layout: Annotated[str, TomlFile()] = ""  # layout file; docs/reference/layout.md describes its entries

    def check(self) -> None:
        """Raise `UsageError` for a missing or invalid layout, before files are searched."""
        if not self.layout:
            raise UsageError("--layout must be given: the file that describes the tables. --guess prints a first one.")
        TABLE.parsed(self)

    def reading(self) -> AbstractContextManager[None]:
        """Return a context in which videos are checked as these settings state."""
        return check_videos(self)


@stage(version=2, source=TABLE.discovery)
def table(params: TableParams, files: Files, values: Values, shared: Shared | None = None) -> RecordingOutput:
    """Read a lab's own tables (CSV, Excel, Parquet, NumPy).

    A layout file names the files of each recording, their columns with quantity and unit, and the sources of time
    stamps and labels. Start with ``--guess``, replace each "?" in its output, and check the result with ``--dry-run``.

    Example: tacpipe ingest table my-lab --layout layout.toml -o data/recordings
    """
    return TABLE.read(params, files, values, shared)
