"""The features of a LeRobot frame and their statistics: state, action and tactile observations of a synchronized table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tacpipe.exports.contents import TIME
from tacpipe.plugins.constraints import Names, Rate

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Floats
    from tacpipe.datasets.dataset import Dataset, Recording

ORIGINALS = "tacpipe"
ACTION = "action"


@dataclass(frozen=True)
class Params:
    """The contents of the frames."""

    rate_hz: Rate | None = None  # synchronize to this rate first; without it the recordings must be synchronized
    master: str = ""  # stream whose samples start and end the frames; without it the first tactile one
    state: Names = ""  # streams of observation.state; without it those with joints or a pose
    tactile_in_state: bool = False  # append tactile channels to observation.state, for policies that read nothing else
    actions: str = ""  # stream of the actions: its targets, else its state one frame later
    common: bool = False  # leave out columns that not all recordings have
    task: str = "touch"  # text of the task, with labels in braces
    robot_type: str = ""  # name of the robot in info.json
    originals: bool = True  # put the shards as they were given under tacpipe/


@dataclass(frozen=True)
class FrameFeature:
    """One feature of a frame: its values (time,) or (time, channel), and the channels' names, units and quantities."""

    name: str
    values: AnyArray
    names: Sequence[str]
    columns: Sequence[str]  # columns of the synchronized table
    units: Sequence[str] = ()
    quantities: Sequence[str] = ()

    @property
    def dtype(self) -> str:
        """The type, as info.json names it."""
        return "string" if self.values.dtype.kind in "OUT" else str(self.values.dtype)

    @property
    def shape(self) -> list[int]:
        """The shape of one frame."""
        return list(self.values.shape[1:]) or [1]


def features_from_table(params: Params, table: pa.Table) -> list[FrameFeature]:
    """Return the features of a synchronized table, in a fixed order."""
    import numpy as np

    from tacpipe.exports import frames

    channels = frames.channels(table)
    state = frames.state_channels(channels, [name.strip() for name in params.state.split(",") if name.strip()])
    taxels = [channel for channel in channels if channel.signal and channel.quantity == frames.TACTILE]
    state = [channel for channel in state if channel not in taxels]

    def vector(name: str, members: Sequence[frames.Channel], values: AnyArray | None = None) -> FrameFeature:
        values = frames.matrix(table, members, np.dtype(np.float32)) if values is None else values
        one_stream = len({channel.stream for channel in members}) == 1
        return FrameFeature(
            name,
            values[:, 0] if values.shape[1] == 1 else values,
            [channel.short if one_stream else channel.name for channel in members],
            [channel.name for channel in members],
            [channel.unit for channel in members],
            [channel.quantity for channel in members],
        )

    vectors: list[FrameFeature] = []
    observed = [*state, *taxels] if params.tactile_in_state else state
    vectors += [vector("observation.state", observed)] if observed else []
    if params.actions:
        vectors.append(vector(ACTION, *frames.actions(table, channels, params.actions)))
    signals = [channel for channel in channels if channel.signal and channel not in state]
    for stream in dict.fromkeys(channel.stream for channel in signals):
        touch = [channel for channel in signals if channel.stream == stream and channel in taxels]
        remaining = [channel for channel in signals if channel.stream == stream and channel not in taxels]
        vectors += [vector(f"observation.tactile.{stream}", touch)] if touch else []
        vectors += [vector(f"observation.{stream}", remaining)] if remaining else []
    latents = [channel for channel in channels if channel.quantity == frames.LATENT]
    vectors += [vector("observation.latents", latents)] if latents else []
    truth = [channel for channel in channels if channel.truth and channel.type in ("float", "double")]
    vectors += [vector(f"{ORIGINALS}.truth", truth)] if truth else []
    vectors.append(FrameFeature(f"{ORIGINALS}.{TIME}", table.column(TIME).to_numpy(), [TIME], [TIME], ["ns"], ["time"]))
    placed = {channel.name for channel in (*state, *signals, *latents, *truth)}
    for channel in channels:
        if channel.name not in placed and (channel.number or channel.type == "string"):
            name = f"{channel.short}.{channel.stream}" if channel.stream else channel.short
            name = f"{ORIGINALS}.{name.replace('/', '_')}"
            values = table.column(channel.name).to_numpy()
            vectors.append(
                FrameFeature(name, values, [channel.name], [channel.name], [channel.unit], [channel.quantity])
            )
    return vectors


STATISTICS_TABLE = "stats"  # table of a part
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", *QUANTILES)
Stats = dict[str, dict[str, list[Any]]]  # feature to statistic to a value a channel


def column_statistics(feature: FrameFeature) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield each column of a feature with its statistics; none of text, and NaN if nothing was measured."""
    import numpy as np

    if feature.dtype == "string":
        return
    values = feature.values.reshape(len(feature.values), -1).astype(np.float64)
    for channel, column in enumerate(feature.columns):
        yield column, _statistics_of(values[:, channel])


def _statistics_of(values: Floats) -> tuple[float, ...]:
    import numpy as np

    finite = values[np.isfinite(values)]
    if not len(finite):
        return (0.0,) * len(STATISTICS)
    ends = (float(finite.min()), float(finite.max()), float(finite.mean()), float(finite.std()))
    return (*ends, *(float(quantile) for quantile in np.quantile(finite, list(QUANTILES.values()))))


def episode_statistics(features: Sequence[FrameFeature], part: Recording, rows: int) -> Stats:
    """Return the statistics of an episode's features, as its part has them."""
    rows_by_column = {(row[ACTION], row["column"]): row for row in part.table(STATISTICS_TABLE).to_pylist()}
    statistics: Stats = {}
    for feature in features:
        if feature.dtype != "string":
            mine = [rows_by_column[feature.name == ACTION, column] for column in feature.columns]
            statistics[feature.name] = {**{name: [row[name] for row in mine] for name in STATISTICS}, "count": [rows]}
    return statistics


def index_statistics(rows: int, episode: int, start: int, task: int, fps: float) -> Stats:
    """Return the statistics of the columns that number frames, episodes and tasks."""
    import numpy as np

    frame = np.arange(rows, dtype=np.float64)
    columns = {
        "timestamp": frame / fps,
        "frame_index": frame,
        "episode_index": np.full(rows, float(episode)),
        "index": frame + start,
        "task_index": np.full(rows, float(task)),
    }
    return {
        name: {**{key: [value] for key, value in zip(STATISTICS, _statistics_of(values), strict=True)}, "count": [rows]}
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
    """Return the statistics over all episodes, put together as LeRobot does: of quantiles the mean over frames.

    ``tasks`` is the index of each recording's task.
    """
    import numpy as np

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
        stacked = {
            name: np.array([values[feature][name] for values in episodes]) for name in STATISTICS
        }  # (episode, channel)
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
