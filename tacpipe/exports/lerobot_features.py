"""The features of a LeRobot frame and their statistics: state, action and tactile observations of a synchronized table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tacpipe.arrays import ArrayType, Floats
from tacpipe.exports.contents import TIME
from tacpipe.plugins.constraints import Names, Rate
from tacpipe.plugins.params import added

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.exports.files import Scratch
    from tacpipe.exports.frames import Channel
    from tacpipe.io.columns import Columns

ORIGINALS = "tacpipe"
ACTION = "action"


@dataclass(frozen=True)
class Params:
    """The contents of the frames."""

    rate_hz: Rate | None = None  # synchronize to this rate first; without it the recordings must be synchronized
    master: str = ""  # stream whose samples start and end the frames; without it the first tactile one
    state: Names = ""  # streams of observation.state; without it those with joints or a pose
    tactile_in_state: bool = False  # append tactile channels to observation.state, for policies that read only it
    actions: str = ""  # stream of the actions: its targets, else its state one frame later
    common: bool = False  # omit columns that not all recordings have
    task: str = "touch"  # text of the task, with labels in braces
    robot_type: str = ""  # name of the robot in info.json
    originals: bool = True  # store the original shards under tacpipe/
    # codec of videos: h264 copies frames of H.264 cameras that match the rows, and encodes others; av1 as in LeRobot
    video_codec: Literal["h264", "av1"] = added("h264")


@dataclass(frozen=True)
class FrameFeature:
    """One feature of a frame: its channels with their names."""

    name: str
    channels: Sequence[Channel]
    names: Sequence[str]
    kind: ArrayType  # type of a frame's values; object for text
    later: bool = False  # whether a frame has the values of the next frame, as for actions without targets

    @property
    def columns(self) -> list[str]:
        """The columns of the synchronized recording."""
        return [channel.name for channel in self.channels]

    @property
    def dtype(self) -> str:
        """The type as named in info.json."""
        return "string" if self.kind.kind == "O" else str(self.kind)

    @property
    def shape(self) -> list[int]:
        """The shape of one frame."""
        return [len(self.channels)]

    @property
    def frame_bytes(self) -> int:
        """The size of a frame in bytes; for text, that of a reference."""
        return self.kind.itemsize * len(self.channels)

    def put_aside(self, columns: Columns, scratch: Scratch) -> Callable[[int, int], pa.Array]:
        """Write a recording's values to a temporary file; return a function from first frame and number of frames to values.

        Text stays in memory.
        """
        import pyarrow as pa

        from tacpipe.exports import frames

        width = len(self.channels)
        if self.dtype == "string":
            texts = columns.column(self.channels[0].name).combine_chunks()
            return lambda first, rows: texts.slice(first, rows)
        start = scratch.tell()
        for values in frames.value_blocks(columns, self.channels, self.kind, later=self.later):
            scratch.write(np.ascontiguousarray(values))
        scratch.check()

        def read(first: int, rows: int) -> pa.Array:
            content = scratch.piece(start + first * self.frame_bytes, rows * self.frame_bytes)
            numbers = pa.array(np.frombuffer(content, self.kind))
            return pa.FixedSizeListArray.from_arrays(numbers, width) if width > 1 else numbers

        return read


def features_of_frames(params: Params, columns: Columns) -> list[FrameFeature]:
    """Return the features of a synchronized recording: state, action, tactile, other signals, then the original columns."""
    from tacpipe.exports import frames

    channels = frames.channels(columns)
    state = frames.state_channels(channels, [name.strip() for name in params.state.split(",") if name.strip()])
    taxels = [channel for channel in channels if channel.signal and channel.quantity == frames.TACTILE]
    state = [channel for channel in state if channel not in taxels]

    def make_vector(name: str, members: Sequence[Channel], *, from_next_frame: bool = False) -> FrameFeature:
        is_one_stream = len({channel.stream for channel in members}) == 1
        names = [channel.short if is_one_stream else channel.name for channel in members]
        return FrameFeature(name, members, names, np.dtype(np.float32), from_next_frame)

    vectors: list[FrameFeature] = []
    state_channels = [*state, *taxels] if params.tactile_in_state else state
    vectors += [make_vector("observation.state", state_channels)] if state_channels else []
    if params.actions:
        members, from_next_frame = frames.action_channels(channels, params.actions)
        vectors.append(make_vector(ACTION, members, from_next_frame=from_next_frame))
    signals = [channel for channel in channels if channel.signal and channel not in state]
    for stream in dict.fromkeys(channel.stream for channel in signals):
        tactile = [channel for channel in signals if channel.stream == stream and channel in taxels]
        remaining = [channel for channel in signals if channel.stream == stream and channel not in taxels]
        vectors += [make_vector(f"observation.tactile.{stream}", tactile)] if tactile else []
        vectors += [make_vector(f"observation.{stream}", remaining)] if remaining else []
    latents = [channel for channel in channels if channel.quantity == frames.LATENT]
    vectors += [make_vector("observation.latents", latents)] if latents else []
    truth = [channel for channel in channels if channel.truth and channel.type in ("float", "double")]
    vectors += [make_vector(f"{ORIGINALS}.truth", truth)] if truth else []
    time = frames.Channel(TIME, "", "time", "ns", "int64")
    vectors.append(FrameFeature(f"{ORIGINALS}.{TIME}", [time], [TIME], np.dtype(np.int64)))
    used_channels = {channel.name for channel in (*state, *signals, *latents, *truth)}
    for channel in channels:
        if channel.name not in used_channels and (channel.number or channel.type == "string"):
            name = f"{channel.short}.{channel.stream}" if channel.stream else channel.short
            name = f"{ORIGINALS}.{name.replace('/', '_')}"
            kind = frames.common_type(columns, [channel]) if channel.number else np.dtype(object)
            vectors.append(FrameFeature(name, [channel], [channel.name], kind))
    return vectors


STATISTICS_TABLE = "stats"  # table of a part
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", *QUANTILES)
Stats = dict[str, dict[str, list[Any]]]  # feature -> statistic -> value of each channel


def column_statistics(feature: FrameFeature, columns: Columns) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield each column of a feature with its statistics, zeros if nothing was measured; nothing for text."""
    if feature.dtype == "string":
        return
    for channel in feature.channels:
        with np.errstate(over="ignore"):
            values = columns.column(channel.name).to_numpy().astype(feature.kind).astype(np.float64)
        if feature.later:
            values = np.concatenate([values[1:], values[-1:]])
        yield channel.name, _compute_statistics(values)


def _compute_statistics(values: Floats) -> tuple[float, ...]:
    """Return minimum, maximum, mean, standard deviation and quantiles of the finite values; zeros if there are none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return (0.0,) * len(STATISTICS)
    ends = (float(finite.min()), float(finite.max()), float(finite.mean()), float(finite.std()))
    return (*ends, *(float(quantile) for quantile in np.quantile(finite, list(QUANTILES.values()))))


def episode_statistics(features: Sequence[FrameFeature], part: Recording, rows: int) -> Stats:
    """Return the statistics of an episode's features from its part."""
    rows_by_column = {(row[ACTION], row["column"]): row for row in part.table(STATISTICS_TABLE).to_pylist()}
    statistics: Stats = {}
    for feature in features:
        if feature.dtype != "string":
            column_rows = [rows_by_column[feature.name == ACTION, column] for column in feature.columns]
            statistics[feature.name] = {
                **{name: [row[name] for row in column_rows] for name in STATISTICS},
                "count": [rows],
            }
    return statistics


def index_statistics(rows: int, episode: int, start: int, task: int, fps: float) -> Stats:
    """Return the statistics of the index columns of frames, episodes and tasks."""
    frame = np.arange(rows, dtype=np.float64)
    columns = {
        "timestamp": frame / fps,
        "frame_index": frame,
        "episode_index": np.full(rows, float(episode)),
        "index": frame + start,
        "task_index": np.full(rows, float(task)),
    }
    return {
        name: {
            **{key: [value] for key, value in zip(STATISTICS, _compute_statistics(values), strict=True)},
            "count": [rows],
        }
        for name, values in columns.items()
    }


def dataset_statistics(
    parts: Dataset,
    features: Sequence[FrameFeature],
    starts: Mapping[str, int],
    lengths: Mapping[str, int],
    tasks: Mapping[str, int],
    fps: float,
) -> Stats:
    """Return the statistics over all episodes, combined as LeRobot does: quantiles are averaged over frames.

    ``tasks`` is the index of each recording's task.
    """
    episodes = [
        {
            **episode_statistics(features, parts[name], rows),
            **index_statistics(rows, episode, starts[name], tasks[name], fps),
        }
        for episode, (name, rows) in enumerate(lengths.items())
    ]
    weights = np.array(list(lengths.values()), float)[:, None] / sum(lengths.values())
    statistics: Stats = {}
    for feature in episodes[0]:
        # (episode, channel)
        stacked = {name: np.array([values[feature][name] for values in episodes]) for name in STATISTICS}
        mean = (weights * stacked["mean"]).sum(0)
        spread = (weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(0)
        statistics[feature] = {
            "min": stacked["min"].min(0).tolist(),
            "max": stacked["max"].max(0).tolist(),
            "mean": mean.tolist(),
            "std": np.sqrt(spread).tolist(),
            "count": [sum(lengths.values())],
            **{name: (weights * stacked[name]).sum(0).tolist() for name in QUANTILES},
        }
    return statistics
