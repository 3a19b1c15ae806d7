"""Read recordings of files into a dataset.

One command per format. Files of a robot or a lab (bags, MCAP, HDF5, Zarr, LeRobot, XDF) declare their streams, and a
layout file adds what they omit; ``table`` reads a lab's own tables, which a layout file describes. The other commands
read published datasets. ``--guess`` prints a first layout, and ``--dry-run`` describes the recordings without reading
them.

Example: tacpipe ingest mcap FOLDER -o data/recordings
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tacpipe.errors import UsageError
from tacpipe.formats.table import contained
from tacpipe.formats.table import layout as layouts
from tacpipe.formats.table.contained import ContainerCommand, Params
from tacpipe.plugins.constraints import TomlFile
from tacpipe.plugins.stage import Files, RecordingOutput, Shared, Source, Values, stage
from tacpipe.plugins.video_checks import VideoChecks, check_videos

ROSBAG, MCAP, HDF5 = ContainerCommand("rosbag"), ContainerCommand("mcap"), ContainerCommand("hdf5")
XDF, LEROBOT, ZARR = ContainerCommand("xdf"), ContainerCommand("lerobot"), ContainerCommand("zarr")


@ROSBAG.stage(version=4)
def rosbag(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read ROS bags (ROS 1, ROS 2 with SQLite or MCAP).

    Each bag is a recording, and each topic a stream. Common messages have predefined names, quantities and units;
    others are read by their definition. The time of a row is the stamp of its header, or the log time if there is none.

    Example: tacpipe ingest rosbag FOLDER -o data/recordings
    """
    return ROSBAG.read(params, files, values)


@MCAP.stage(version=4)
def mcap(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read MCAP files (ROS, JSON or protobuf messages).

    Each file is a recording, and each topic a stream. Common messages have predefined names, quantities and units;
    others are read by their definition. The time of a row is the stamp of its header, or the log time if there is none.

    Example: tacpipe ingest mcap FOLDER -o data/recordings
    """
    return MCAP.read(params, files, values)


@HDF5.stage(version=4)
def hdf5(params: Params, files: Files, values: Values) -> RecordingOutput:
    """Read HDF5 files of robomimic, ALOHA or a lab's own.

    A group such as demo_0 is a recording; without such groups, the file is one. A group of arrays of the same length is
    a stream, with time stamps in the group or a rate in an attribute. ``--guess`` prints what the files declare as a
    layout file, to which rates, quantities and units can be added.

    Example: tacpipe ingest hdf5 demos -o data/recordings
    """
    return HDF5.read(params, files, values)


@XDF.stage(version=2)
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


def preview_lerobot(params: LeRobotParams, source: Path) -> str:
    """Describe the streams that would be read from LeRobot datasets."""
    with check_videos(params):
        return LEROBOT.preview(params, source)


@LEROBOT.stage(version=4, preview=preview_lerobot)
def lerobot(params: LeRobotParams, files: Files, values: Values) -> RecordingOutput:
    """Read LeRobot datasets, version 2.0, 2.1 and 3.0.

    An episode is a recording, a feature a stream, and the task a label. Stamps are frame_index / fps if the timestamps
    agree with it. Exports of tacpipe give the original streams.

    Example: tacpipe ingest lerobot datasets/pusht -o data/recordings
    """
    with check_videos(params):
        return LEROBOT.read(params, files, values)


@dataclass(frozen=True)
class ZarrParams(Params):
    """Settings that Zarr stores do not declare."""

    fill_missing_chunks: bool = False  # read missing chunks as fill values, which zarr 3 does not write


def preview_zarr(params: ZarrParams, source: Path) -> str:
    """Describe the streams that would be read from Zarr stores."""
    from tacpipe.formats.arrays.zarr import allow_missing_chunks

    with allow_missing_chunks(filled=params.fill_missing_chunks):
        return ZARR.preview(params, source)


@ZARR.stage(version=4, preview=preview_zarr)
def zarr(params: ZarrParams, files: Files, values: Values) -> RecordingOutput:
    """Read Zarr stores, such as replay buffers of UMI.

    Folders and .zarr.zip files, format 2 and 3. If meta/episode_ends divides the arrays into episodes, each is a
    recording; otherwise the store is one. The rate, which replay buffers do not contain, comes from a layout file;
    ``--guess`` prints one.

    Example: tacpipe ingest zarr replay.zarr.zip --layout layout.toml -o data/recordings
    """
    from tacpipe.formats.arrays.zarr import allow_missing_chunks

    with allow_missing_chunks(filled=params.fill_missing_chunks):
        return ZARR.read(params, files, values)


@dataclass(frozen=True)
class TableParams(VideoChecks):
    """Layout of the tables."""

    layout: Annotated[str, TomlFile()] = ""  # layout file; docs/reference/layout.md describes its entries

    def check(self) -> None:
        """Raise `UsageError` for a missing or invalid layout, before files are searched."""
        self.parsed()

    def parsed(self) -> layouts.Layout:
        """Return the layout."""
        if not self.layout:
            raise UsageError("--layout must be given: the file that describes the tables. --guess prints a first one.")
        return layouts.layout_from_tables(json.loads(self.layout), "The layout")


def discover_table(params: TableParams, source: Path) -> dict[str, Source]:
    """Return the files and labels of each recording in ``source``."""
    from tacpipe.formats.table import recordings

    layout = params.parsed()
    return contained.discover_sources(layout, source, recordings.find_recordings(layout, source))


def preview_table(params: TableParams, source: Path) -> str:
    """Describe in words what would be read."""
    from tacpipe.formats.table import recordings

    layout = params.parsed()
    return contained.preview_text(layout, source, recordings.find_recordings(layout, source))


def guess_table(source: Path) -> str:
    """Return the text of a guessed layout."""
    from tacpipe.formats.table import guess

    return guess.guess_layout(source)


def why_unread_table(params: TableParams, source: Path) -> Callable[[str], str]:
    """Return a function from the path of a file in ``source`` to the reason why it is not read."""
    return contained.why_unread(params.parsed(), source)


@stage(version=2, discover=discover_table, preview=preview_table, guess=guess_table, why_unread=why_unread_table)
def table(params: TableParams, files: Files, values: Values, shared: Shared | None = None) -> RecordingOutput:
    """Read a lab's own tables (CSV, Excel, Parquet, NumPy).

    A layout file names the files of each recording, their columns with quantity and unit, and the sources of time
    stamps and labels. Start with ``--guess``, replace each "?" in its output, and check the result with ``--dry-run``.

    Example: tacpipe ingest table my-lab --layout layout.toml -o data/recordings
    """
    with check_videos(params):
        return contained.read_recording(params.parsed(), None, files, values, shared)
