"""Write recordings as MCAP files, one per recording, for Foxglove and ROS 2.

Each stream is a topic of ROS 2 messages at its own rate, with one field per column in its own type. Events are also a
topic, and labels are a metadata record. Columns that form a pose, a wrench, a twist, joint states, tactile states or an
encoded image are additionally written as these messages, except with ``--no-usual-messages``. Log time and header stamp
are the timestamps of the stream.

Example: tacpipe export mcap data/recordings -o exports/mcap
"""

from __future__ import annotations

import functools
import heapq
import itertools
import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from tacpipe.exports import contents, files
from tacpipe.exports.contents import TIME, ColumnName, Loss
from tacpipe.exports.files import Files
from tacpipe.plugins.stage import ALL, RecordingName, RecordingOutput, Result, stage
from tacpipe.video.stream import read_format

if TYPE_CHECKING:
    import pyarrow as pa
    from mcap.writer import Writer

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.exports.pictures import Pictures
    from tacpipe.exports.ros import Topic
    from tacpipe.io.columns import Columns

    Parts = Dataset

RECORD = "tacpipe"  # the name of the metadata record
_OPENING = """
One MCAP file a recording (profile `ros2`, messages in CDR with their definitions): open it in Foxglove, play it with
`ros2 bag play FILE.mcap`, or read it in Python with `rosbags` or `mcap`.

The topic `/STREAM` has messages of the type `tacpipe_msgs/msg/Stream`, a field a column; the metadata of its channel name
stream, columns and units (`tacpipe`, JSON). Topics below it repeat some columns as usual messages: `/STREAM/pose`, and
encoded images as `sensor_msgs/msg/CompressedImage` in `/STREAM/image`. A video that Foxglove plays (H.264, H.265, VP9 or
AV1 without B-frames) is in `/STREAM/video` as `foxglove_msgs/msg/CompressedVideo`, with start codes in place of sizes. Any
other video is decoded and encoded as JPEG in `/STREAM/image`, which loses some detail. `/STREAM` has all packets bit for
bit. Labels are in the metadata record `tacpipe`. tacpipe reads the files back with `tacpipe ingest mcap`.
"""


@dataclass(frozen=True)
class Params:
    """Messages in addition to the streams."""

    # poses, wrenches, twists, joint and tactile states and encoded images as messages of these types too
    usual_messages: bool = True


@stage(version=3, reads=ALL)
def part(params: Params, recording: Recording, name: RecordingName) -> Result:
    """Return the MCAP file of one recording."""
    losses: list[Loss] = []
    streams = list(_streams(params, recording, losses))
    write = functools.partial(_write_mcap, recording, name, streams)
    columns = [name for stream in streams for name in stream.columns]
    return Result({"": RecordingOutput(contents.part(recording, losses, columns))}, written={f"{name}.mcap": write})


@stage(version=3)
def mcap(params: Params, recordings: Dataset, parts: Annotated[Parts, part]) -> Result:
    """Write recordings as MCAP files for Foxglove and ROS 2.

    One file per recording, one topic per stream at its own rate with each column in its own type. Labels are metadata, and
    events are a topic.

    Example: tacpipe export mcap data/recordings -o exports/mcap
    """
    described = contents.contents_from_parts(parts)
    text = files.readme_text("Tactile recordings as MCAP", _OPENING, recordings, described)
    return Result(files=Files({files.README_NAME: text}), notes=files.loss_notes(recordings, described))


@dataclass(frozen=True)
class _Stream:
    """A stream that becomes topics, and the function that converts its blocks of rows."""

    topics: Callable[[pa.Table], Sequence[Topic]]
    name: str
    columns: Sequence[ColumnName]  # columns that the messages represent
    ordered: bool  # whether the rows are ordered by time


def _write_mcap(recording: Recording, name: str, streams: Sequence[_Stream], sink: Any) -> None:
    """Write the MCAP file of a recording, ordered by time, with only some rows of each stream in memory."""
    from mcap.writer import CompressionType, Writer

    writer = Writer(sink, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library="tacpipe")
    metadata = {"recording": name, "attributes": json.dumps(dict(recording.attributes), sort_keys=True)}
    writer.add_metadata(RECORD, metadata)
    messages = [message for stream in streams for message in _register_topics(writer, recording, stream)]
    for number, (log_ns, channel, content) in enumerate(heapq.merge(*messages, key=lambda message: message[0])):
        writer.add_message(channel, log_ns, content, log_ns, number)
    writer.finish()  # type: ignore[no-untyped-call]


def _streams(params: Params, recording: Recording, losses: list[Loss]) -> Iterator[_Stream]:
    """Yield the streams that become topics, and add to ``losses`` what the messages cannot represent."""
    from tacpipe.exports import ros
    from tacpipe.exports.pictures import Pictures

    starts = [start for start in (_start(recording, stream) for stream in recording.streams) if start is not None]
    for stream in recording.streams:
        table = recording.columns(stream)
        if TIME not in table.column_names:
            if set(ros.POINT) <= set(table.column_names) and starts and min(starts) >= 0:
                columns = [(stream, name) for name in ros.cloud_columns(table.schema)]
                yield _Stream(functools.partial(_cloud, stream, min(starts)), stream, columns, ordered=False)
                losses.append(Loss("it has no time: its one message is stamped with the recording's start", stream))
                losses += contents.unwritten_losses([(stream, name) for name in table.column_names], columns)
            else:
                losses.append(Loss("it has no time, and a message needs one", stream))
            continue
        t_ns = table.column(TIME).to_numpy()
        if table.num_rows and not 0 <= t_ns.min() <= t_ns.max() <= ros.MAX_STAMP_S * 10**9:
            losses.append(Loss("its stamps lie before 1970 or after 2038, which ROS has no stamps for", stream))
            continue
        losses += _losses(stream, table)
        first_topic = ros.stream_topic(stream, table.schema.empty_table())
        columns = [(stream, name) for name in (TIME, *(column["name"] for column in first_topic.metadata["columns"]))]
        images = [name for name in table.column_names if _holds_images(table, name)] if params.usual_messages else []
        video_format = read_format(table) if params.usual_messages and not images and table.num_rows else None
        frames = None if video_format is None else Pictures(table, video_format)
        topics = functools.partial(_topics, params, stream, images, frames)
        yield _Stream(topics, stream, columns, ordered=not np.any(np.diff(t_ns) < 0))


def _holds_images(table: Columns, name: str) -> bool:
    """Return whether the first value of a binary column is an encoded image."""
    import pyarrow as pa

    from tacpipe.video.images import picture_encoding

    if not pa.types.is_binary(table.schema.field(name).type):
        return False
    first = next((value.as_py() for value in table.column(name) if value.is_valid and len(value.as_buffer())), b"")
    return bool(picture_encoding(first))


def _cloud(stream: str, start_ns: int, table: pa.Table) -> list[Topic]:
    """Return the topic of a point cloud with one message for all rows."""
    from tacpipe.exports import ros

    return [ros.cloud_topic(stream, table, start_ns)]


def _topics(
    params: Params, stream: str, images: Sequence[str], frames: Pictures | None, table: pa.Table
) -> list[Topic]:
    """Return the topics for a block of rows of a stream."""
    from tacpipe.exports import ros

    standard = ros.usual_topics(stream, table, images) if params.usual_messages else []
    standard += [frames.topic(stream, table)] if frames is not None else []
    return [ros.stream_topic(stream, table), *standard]


def _start(recording: Recording, stream: str) -> int | None:
    """Return the first timestamp of a stream, or None if it has none."""
    columns = recording.columns(stream)
    if TIME not in columns.column_names or not columns.num_rows:
        return None
    return int(columns.column(TIME)[0].as_py())


def _register_topics(writer: Writer, recording: Recording, stream: _Stream) -> list[Iterator[tuple[int, int, bytes]]]:
    """Register the topics of a stream; return log time, channel and content of each topic's messages, ordered by time.

    Topics of a stream have the same timestamps, so they consume the same rows at about the same time.
    """
    stored = recording.columns(stream.name)
    tables = stored.batches() if stream.ordered else iter([recording.table(stream.name)])
    first_table = next(tables, stored.schema.empty_table())
    first_topics = stream.topics(first_table)
    blocks = _share_values(itertools.chain([first_topics], map(stream.topics, tables)), len(first_topics))
    channels = []
    for topic in first_topics:
        schema = writer.register_schema(topic.type, "ros2msg", topic.definition.encode())
        metadata = {"tacpipe": json.dumps(topic.metadata, sort_keys=True)}
        channels.append(writer.register_channel(topic.name, "cdr", schema, metadata))
    return [
        _topic_messages(number, channel, topic_blocks)
        for number, (channel, topic_blocks) in enumerate(zip(channels, blocks, strict=True))
    ]


def _share_values(values: Iterator[Any], readers: int) -> list[Iterator[Any]]:
    """Return iterators over the same values, each buffered until all have read it (itertools.tee buffers 57 at a time)."""
    queues: list[deque[Any]] = [deque() for _ in range(readers)]

    def read(own_queue: deque[Any]) -> Iterator[Any]:
        while True:
            if not own_queue:
                try:
                    value = next(values)
                except StopIteration:
                    return
                for queue in queues:
                    queue.append(value)
                del value
            yield own_queue.popleft()

    return [read(own_queue) for own_queue in queues]


def _topic_messages(number: int, channel: int, blocks: Iterable[Sequence[Topic]]) -> Iterator[tuple[int, int, bytes]]:
    """Yield log time, channel and content of the messages of the topic with this index."""
    from tacpipe.exports import ros

    for topics in blocks:
        topic = topics[number]
        t_ns = topic.t_ns
        stamps, messages = t_ns.tolist(), ros.pack_messages(topic.parts, len(t_ns))
        del topics, topic
        if np.any(np.diff(t_ns) < 0):  # rows are not ordered by time, such as events, which are ordered by stream
            all_messages = list(messages)
            yield from ((stamps[row], channel, all_messages[row]) for row in np.argsort(t_ns, kind="stable").tolist())
        else:
            yield from zip(stamps, (channel for _ in stamps), messages, strict=True)


def _losses(stream: str, table: Columns) -> Iterator[Loss]:
    """Yield what messages cannot represent of a stream: columns without a message type, and missing values."""
    import pyarrow as pa

    from tacpipe.exports import ros

    for field in table.schema:
        column = table.column(field.name)
        if str(field.type) not in ros.TYPES:
            yield Loss(f"messages have no type for {field.type}", stream, field.name)
        elif column.null_count:
            filler: Any = "NaN" if pa.types.is_floating(field.type) else 0
            filler = "empty" if pa.types.is_string(field.type) or pa.types.is_binary(field.type) else filler
            yield Loss(f"missing values are written as {filler}", stream, field.name)
