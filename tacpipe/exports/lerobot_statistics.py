"""Statistics of a LeRobot dataset: of each column, episode and of all episodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from tacpipe.exports.lerobot_features import ACTION, Feature

if TYPE_CHECKING:
    from tacpipe.arrays import Floats
    from tacpipe.datasets.dataset import Dataset, Recording

TABLE = "stats"  # table of a part
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", *QUANTILES)
Stats = dict[str, dict[str, list[Any]]]  # feature to statistic to a value a channel


def by_column(one: Feature) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield each column of a feature with its statistics; none of text, and NaN where nothing was measured."""
    import numpy as np

    if one.dtype == "string":
        return
    values = one.values.reshape(len(one.values), -1).astype(np.float64)
    for channel, column in enumerate(one.columns):
        yield column, _numbers(values[:, channel])


def _numbers(values: Floats) -> tuple[float, ...]:
    import numpy as np

    finite = values[np.isfinite(values)]
    if not len(finite):
        return (0.0,) * len(STATISTICS)
    ends = (float(finite.min()), float(finite.max()), float(finite.mean()), float(finite.std()))
    return (*ends, *(float(one) for one in np.quantile(finite, list(QUANTILES.values()))))


def of_episode(made: Sequence[Feature], part: Recording, rows: int) -> Stats:
    """Return the statistics of an episode's features, as its part has them."""
    known = {(row[ACTION], row["column"]): row for row in part.table(TABLE).to_pylist()}
    found: Stats = {}
    for one in made:
        if one.dtype != "string":
            mine = [known[one.name == ACTION, column] for column in one.columns]
            found[one.name] = {**{name: [row[name] for row in mine] for name in STATISTICS}, "count": [rows]}
    return found


def of_index(rows: int, episode: int, start: int, task: int, fps: float) -> Stats:
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
        name: {**{key: [value] for key, value in zip(STATISTICS, _numbers(values), strict=True)}, "count": [rows]}
        for name, values in columns.items()
    }


def of_all(
    parts: Dataset,
    made: Sequence[Feature],
    starts: Mapping[str, int],
    lengths: Mapping[str, int],
    tasks: Mapping[str, int],
    fps: float,
) -> Stats:
    """Return the statistics over all episodes, put together as LeRobot does: of quantiles the mean over frames.

    ``tasks`` is the index of each recording's task.
    """
    import numpy as np

    every = [
        {
            **of_episode(made, parts[name], rows),
            **of_index(rows, episode, starts[name], tasks[name], fps),
        }
        for episode, (name, rows) in enumerate(lengths.items())
    ]
    weights = np.array(list(lengths.values()), float)[:, None] / sum(lengths.values())
    found: Stats = {}
    for feature in every[0]:
        stacked = {name: np.array([one[feature][name] for one in every]) for name in STATISTICS}  # (episode, channel)
        mean = (weights * stacked["mean"]).sum(0)
        spread = (weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(0)
        found[feature] = {
            "min": stacked["min"].min(0).tolist(),
            "max": stacked["max"].max(0).tolist(),
            "mean": mean.tolist(),
            "std": np.sqrt(spread).tolist(),
            "count": [sum(lengths.values())],
            **{name: (weights * stacked[name]).sum(0).tolist() for name in QUANTILES},
        }
    return found
