"""Write recordings as a LeRobot dataset (v3.0): frames at one rate, together with the recorded shards.

Recordings must be synchronized, or have ``--rate-hz``. The robot's streams are ``observation.state``, tactile streams
``observation.tactile.STREAM``; clocks and masks are ``tacpipe.*``, which policies ignore. ``--actions`` names the
stream whose targets, or next state, are ``action``. The task is ``--task``, with labels in braces. The original shards,
with their own rates and types, are under ``tacpipe/``.

Example: tacpipe export lerobot data/recordings -o exports/lerobot --rate-hz 50 --actions robot --task "grasp the {object}"
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import numpy as np

from tacpipe.channels.streams import GRID
from tacpipe.errors import UsageError
from tacpipe.exports import contents
from tacpipe.exports.contents import TIME, Loss
from tacpipe.exports.files import README_NAME, Content, Files, Scratch, loss_notes, readme_text
from tacpipe.exports.lerobot_features import (
    ACTION,
    ORIGINALS,
    STATISTICS,
    STATISTICS_TABLE,
    FrameFeature,
    Params,
    Stats,
    column_statistics,
    dataset_statistics,
    episode_statistics,
    features_of_frames,
    index_statistics,
)
from tacpipe.exports.lerobot_videos import (
    EpisodeVideo,
    VideoFeature,
    VideoFeatureJson,
    combine_statistics,
    find_cameras,
)
from tacpipe.plugins.stage import Attribute, RecordingOutput, Result, stage
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.exports.frames import Channel
    from tacpipe.io.columns import Columns

    Parts = Dataset

VERSION = "v3.0"
RECORDING, ATTRIBUTES = "tacpipe/recording", "tacpipe/attributes"  # columns of the episodes; the attributes are JSON
# columns with indices and times of frames
INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
GROUP_FRAMES = 1 << 17  # maximum number of frames of an episode in memory; a longer episode has several row groups
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
CHUNK_FILES, FILE_BYTES = 1000, 100 << 20  # LeRobot's limits
_PLACE = re.compile(r"\{([^{}]+)\}")
_OPENING = """
A LeRobot dataset, v3.0:

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("tacpipe/export", root="EXPORT")
```

`observation.state` is the robot, `observation.tactile.STREAM` a tactile sensor in its unit, `observation.images.STREAM` a
camera: the nearest frame in time. `tacpipe.t_ns` is the time of a
frame in nanoseconds of UTC, `tacpipe.held.STREAM` and `tacpipe.gap.STREAM` mark frames in which a sensor repeated its last
value or sent nothing, `tacpipe.dt_ns.STREAM` is the distance to the nearest sample. `meta/tacpipe.json` has unit and
quantity of each column.
"""


def prepare(params: Params) -> Mapping[str, Mapping[str, str | float]]:
    """Return the stage that synchronizes the recordings first, if a rate is given."""
    from tacpipe.exports import frames

    return frames.synchronize_stage(params.rate_hz, params.master)


def shards(params: Params) -> str:
    """Return the folder for the input shards."""
    return ORIGINALS if params.originals else ""


@stage(version=3, reads=("grid", "grid_rate_hz"))
def part(params: Params, recording: Recording) -> RecordingOutput:
    """Return the statistics of each feature of one recording."""
    import pyarrow as pa

    from tacpipe.exports import frames

    columns = frames.synchronized_columns(recording)
    losses = list(_losses(params, columns, str(recording.attributes[GRID])))
    has_actions = bool(params.actions) and _has_stream(columns, params.actions)
    frame_features = features_of_frames(params if has_actions else replace(params, actions=""), columns)
    rows = [
        (feature.name == ACTION, column, *values)
        for feature in frame_features
        for column, values in column_statistics(feature, columns)
    ]
    names = [ACTION, "column", *STATISTICS]
    rows_of_statistics = pa.Table.from_arrays([pa.array(values) for values in zip(*rows, strict=True)], names=names)
    carried = [("", column) for feature in frame_features for column in feature.columns]
    # named above as unsupported
    carried += [("", channel.name) for channel in _unsupported_channels(frames.channels(columns))]
    return RecordingOutput({**contents.part(recording, losses, carried), STATISTICS_TABLE: rows_of_statistics})


@stage(version=3, originals=shards)
def lerobot(
    params: Params, recordings: Annotated[Dataset, prepare], parts: Annotated[Parts, part], originals: Dataset
) -> Result:
    """Write recordings as a LeRobot dataset (v3.0).

    Frames at one rate: synchronized recordings, or any with ``--rate-hz``. The robot's streams are observation.state,
    tactile ones observation.tactile.STREAM; the original shards are under tacpipe/.

    Example: tacpipe export lerobot data/recordings -o exports/lerobot --rate-hz 50 --actions robot
    """
    from tacpipe.exports import frames

    all_recordings = list(recordings)
    fps = frames.common_rate_hz(all_recordings)
    columns, described = frames.frame_columns(contents.contents_from_parts(parts), common=params.common)
    cameras, losses = find_cameras(originals)
    described = frames.add_frame_losses(
        described, recordings, originals, _shards_note(params), [camera.stream for camera in cameras]
    )
    frame_features = features_of_frames(params, frames.synchronized_columns(all_recordings[0]).select(columns))
    tasks = _tasks(params, all_recordings)
    tables = {recording.name: parts[recording.name].table(contents.STREAMS) for recording in all_recordings}
    lengths = {name: int(table["rows"][0].as_py()) for name, table in tables.items()}
    videos = {
        recording.name: {
            camera.name: EpisodeVideo.from_recordings(
                camera, originals[recording.name], frames.synchronized_columns(recording), params.video_codec, fps
            )
            for camera in cameras
        }
        for recording in all_recordings
    }
    bundles = list(_group_by_size(all_recordings, lengths, sum(feature.frame_bytes for feature in frame_features)))
    files: dict[str, Content] = {}
    written: dict[str, Callable[[Any], object]] = {}
    starts: dict[str, int] = {}
    file_numbers: dict[str, tuple[int, int]] = {}
    number = start = 0
    for index, bundle in enumerate(bundles):
        chunk, file = divmod(index, CHUNK_FILES)
        for recording in bundle:
            starts[recording.name], file_numbers[recording.name] = start, (chunk, file)
            start += lengths[recording.name]
        episodes = _Episodes(columns, frame_features, bundle, number, starts, tasks, fps)
        written[f"data/chunk-{chunk:03d}/file-{file:03d}.parquet"] = episodes.write
        number += len(bundle)
    for episode, recording in enumerate(all_recordings):
        for camera in cameras:
            video = videos[recording.name][camera.name]
            chunk, file = divmod(episode, CHUNK_FILES)
            video_path = VIDEO_PATH.format(video_key=camera.name, chunk_index=chunk, file_index=file)
            written[video_path] = video.write
            losses += [(recording.name, loss) for loss in video.losses(camera.stream, _shards_note(params))]
    described = replace(described, losses={**described.losses, **contents.loss_sentences(losses)})
    colours = {name: {key: video.statistics() for key, video in by_key.items()} for name, by_key in videos.items()}
    files["meta/episodes/chunk-000/file-000.parquet"] = _episodes_table(
        frame_features, all_recordings, parts, originals, starts, file_numbers, lengths, tasks, fps, colours
    )
    files["meta/tasks.parquet"] = _task_table(tasks)
    files["meta/info.json"] = _json_bytes(_info(params, frame_features, cameras, lengths, tasks, fps))
    task_indices = _task_order(tasks)
    indices = {name: task_indices[task] for name, task in tasks.items()}
    statistics = dataset_statistics(parts, frame_features, starts, lengths, indices, fps)
    for camera in cameras:
        statistics[camera.name] = combine_statistics([by_key[camera.name] for by_key in colours.values()])
    files["meta/stats.json"] = _json_bytes(statistics)
    files["meta/tacpipe.json"] = _json_bytes(_feature_metadata(frame_features, described))
    files[README_NAME] = readme_text("Tactile recordings as a LeRobot dataset", _OPENING, recordings, described)
    return Result(files=Files(files), notes=loss_notes(recordings, described), written=written)


def _losses(params: Params, columns: Columns, grid: str) -> Iterator[Loss]:
    """Yield what the features cannot represent of a synchronized recording."""
    from tacpipe.exports import frames

    channels = frames.channels(columns)
    ending = _shards_note(params)
    yield Loss(f"rates of the streams and what happened between frames: one frame rate for all{ending}")
    if not params.originals:
        yield Loss("stream events, and types and units of the recorded streams (with --originals they are carried)")
    if grid != "uniform":
        times = f"{ORIGINALS}.{TIME} has the times"
        yield Loss(f"distances between frames: timestamp is frame / fps, and the grid is {grid}; {times}")
    rounded = frames.rounded_channels(columns, [channel for channel in channels if channel.signal])
    for stream in dict.fromkeys(channel.stream for channel in rounded):
        yield Loss(f"digits beyond float32{ending}", stream)
    for channel in _unsupported_channels(channels):
        if channel.quantity == frames.IMAGE:
            continue  # packets are in the videos
        yield Loss(f"features have no type for {channel.type}{ending}", channel.stream, channel.short)


def _unsupported_channels(channels: Sequence[Channel]) -> list[Channel]:
    """Return the channels whose type no feature supports."""
    return [channel for channel in channels if not channel.number and channel.type != "string"]


def _shards_note(params: Params) -> str:
    """Return the end of a sentence about a loss if the recorded shards are part of the export."""
    return f"; the shards under {ORIGINALS}/ keep it" if params.originals else ""


def _has_stream(columns: Columns, stream: str) -> bool:
    from tacpipe.exports import frames

    return any(channel.stream == stream for channel in frames.channels(columns))


def _tasks(params: Params, recordings: Sequence[Recording]) -> dict[str, str]:
    """Return the task of each recording. Raises `UsageError` if a recording lacks a label that the task contains."""
    tasks = {}
    for recording in recordings:
        for label in _PLACE.findall(params.task):
            if recording.attributes.get(label) is None:
                raise UsageError(
                    f"The task names {{{plain(label)}}}, and recording {recording.name} has no such label; it has "
                    f"{listed(recording.attributes)}."
                )
        tasks[recording.name] = _fill_task(params.task, recording.attributes)
    return tasks


def _fill_task(task: str, labels: Mapping[str, Attribute]) -> str:
    """Return a task's text with the values of its labels inserted."""
    return _PLACE.sub(lambda match: str(labels[match[1]]), task)


def _group_by_size(
    recordings: Sequence[Recording], lengths: Mapping[str, int], row_bytes: int
) -> Iterator[list[Recording]]:
    """Yield the recordings of each data file, which together have at most `FILE_BYTES`."""
    bundle: list[Recording] = []
    size = 0
    for recording in recordings:
        recording_bytes = lengths[recording.name] * row_bytes
        if bundle and size + recording_bytes > FILE_BYTES:
            yield bundle
            bundle, size = [], 0
        bundle.append(recording)
        size += recording_bytes
    yield bundle


@dataclass(frozen=True)
class _Episodes:
    """The recordings of one data file."""

    columns: Sequence[str]
    features: Sequence[FrameFeature]
    recordings: Sequence[Recording]
    first_episode: int
    starts: Mapping[str, int]
    tasks: Mapping[str, str]
    fps: float

    def write(self, sink: Any) -> None:
        """Write the data file with one row group per episode, or several for more than `GROUP_FRAMES` frames."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        from tacpipe.exports import frames
        from tacpipe.io.columns import release

        task_indices = _task_order(self.tasks)
        names = [*(feature.name for feature in self.features), *INDICES]
        writer = None
        for episode, recording in enumerate(self.recordings, start=self.first_episode):
            columns = frames.synchronized_columns(recording).select(self.columns)
            length, start, task = (
                columns.num_rows,
                self.starts[recording.name],
                task_indices[self.tasks[recording.name]],
            )
            scratch = Scratch()
            release()
            features = [feature.put_aside(columns, scratch) for feature in self.features]
            columns.forget()
            release()
            for first in range(0, max(1, length), GROUP_FRAMES):
                rows = min(GROUP_FRAMES, length - first)
                numbers = _index_columns(first, rows, episode, start, task, self.fps)
                table = pa.Table.from_arrays([*(read(first, rows) for read in features), *numbers], names)
                writer = writer or pq.ParquetWriter(sink, table.schema, compression="zstd")
                writer.write_table(table, row_group_size=max(1, rows))
        assert writer is not None
        writer.close()


def _index_columns(first: int, rows: int, episode: int, start: int, task: int, fps: float) -> list[pa.Array]:
    """Return the columns `INDICES` for ``rows`` frames of an episode, starting with the frame ``first``.

    ``start`` is the index of the episode's first frame in the dataset.
    """
    import pyarrow as pa

    frame = np.arange(first, first + rows)
    return [
        pa.array((frame / fps).astype(np.float32)),
        pa.array(frame),
        pa.array(np.full(rows, episode)),
        pa.array(frame + start),
        pa.array(np.full(rows, task)),
    ]


def _task_order(tasks: Mapping[str, str]) -> dict[str, int]:
    return {task: index for index, task in enumerate(sorted(set(tasks.values())))}


def _task_table(tasks: Mapping[str, str]) -> bytes:
    """Return the tasks as LeRobot stores them: a pandas frame with the text as index."""
    import pandas as pd

    order = _task_order(tasks)
    sink = io.BytesIO()
    pd.DataFrame({"task_index": list(order.values())}, index=list(order)).to_parquet(sink)
    return sink.getvalue()


def _episodes_table(
    frame_features: Sequence[FrameFeature],
    recordings: Sequence[Recording],
    parts: Dataset,
    originals: Dataset,
    starts: Mapping[str, int],
    file_numbers: Mapping[str, tuple[int, int]],
    lengths: Mapping[str, int],
    tasks: Mapping[str, str],
    fps: float,
    colours: Mapping[str, Stats],
) -> bytes:
    """Return the table of the episodes, with their files, statistics and original attributes, as Parquet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    task_indices = _task_order(tasks)
    rows = []
    for episode, recording in enumerate(recordings):
        chunk, file = file_numbers[recording.name]
        stats = episode_statistics(frame_features, parts[recording.name], lengths[recording.name])
        stats |= index_statistics(
            lengths[recording.name], episode, starts[recording.name], task_indices[tasks[recording.name]], fps
        )
        stats |= colours[recording.name]
        video_chunk, video_file = divmod(episode, CHUNK_FILES)
        video_entries = {"chunk_index": video_chunk, "file_index": video_file, "from_timestamp": 0.0}
        video_entries["to_timestamp"] = lengths[recording.name] / fps
        row: dict[str, Any] = {
            "episode_index": episode,
            "tasks": [tasks[recording.name]],
            "length": lengths[recording.name],
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": starts[recording.name],
            "dataset_to_index": starts[recording.name] + lengths[recording.name],
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            RECORDING: recording.name,
            ATTRIBUTES: json.dumps(dict(originals[recording.name].attributes), sort_keys=True),
        }
        for name in colours[recording.name]:
            row |= {f"videos/{name}/{key}": value for key, value in video_entries.items()}
        for name, values in stats.items():
            row |= {f"stats/{name}/{key}": value for key, value in values.items()}
        rows.append(row)
    sink = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist(rows), sink, compression="zstd")
    return bytes(sink.getvalue().to_pybytes())


class FeatureJson(TypedDict):
    """A feature of the frames in LeRobot's format."""

    dtype: str
    shape: list[int]
    names: list[str] | None


class InfoJson(TypedDict):
    """The description of a dataset in LeRobot's format."""

    codebase_version: str
    robot_type: str | None
    total_episodes: int
    total_frames: int
    total_tasks: int
    chunks_size: int
    data_files_size_in_mb: int
    video_files_size_in_mb: int
    fps: float
    splits: dict[str, str]
    data_path: str
    video_path: str | None
    features: dict[str, FeatureJson | VideoFeatureJson]


def _info(
    params: Params,
    frame_features: Sequence[FrameFeature],
    cameras: Sequence[VideoFeature],
    lengths: Mapping[str, int],
    tasks: Mapping[str, str],
    fps: float,
) -> InfoJson:
    """Return the content of info.json: totals, paths and features."""
    described: dict[str, FeatureJson | VideoFeatureJson] = {
        feature.name: {
            "dtype": feature.dtype,
            "shape": feature.shape,
            "names": list(feature.names) if feature.shape != [1] else None,
        }
        for feature in frame_features
    }
    described |= {camera.name: camera.feature(params.video_codec, fps) for camera in cameras}
    described["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in INDICES[1:]:
        described[name] = {"dtype": "int64", "shape": [1], "names": None}
    return {
        "codebase_version": VERSION,
        "robot_type": params.robot_type or None,
        "total_episodes": len(lengths),
        "total_frames": sum(lengths.values()),
        "total_tasks": len(set(tasks.values())),
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_BYTES >> 20,
        "video_files_size_in_mb": 200,
        "fps": int(fps) if fps.is_integer() else fps,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": VIDEO_PATH if cameras else None,
        "features": described,
    }


class FeatureMetadata(TypedDict):
    """Metadata that LeRobot's format cannot represent."""

    features: dict[str, dict[str, list[str]]]  # columns, units and quantities of each feature
    columns: dict[str, dict[str, str]]  # type and metadata of each column of the synchronized table


def _feature_metadata(frame_features: Sequence[FrameFeature], described: contents.Contents) -> FeatureMetadata:
    """Return columns, units and quantities of each feature, and the columns of the synchronized table."""
    return {
        "features": {
            feature.name: {
                "columns": feature.columns,
                "units": [channel.unit for channel in feature.channels],
                "quantities": [channel.quantity for channel in feature.channels],
            }
            for feature in frame_features
        },
        "columns": {
            column.name: {"type": column.type, **column.about}
            for stream in described.streams.values()
            for column in stream.columns
        },
    }


def _json_bytes(value: Any) -> bytes:
    return json.dumps(value, indent=4, ensure_ascii=False).encode() + b"\n"
