"""LeRobot datasets as LeRobot writes them, version 2.1 and 3.0, written with pyarrow and json."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.video import videos

FPS = 30
LENGTHS = (12, 7, 9)
TASKS = ("grasp the cup", "grasp the box")
NAMES = [f"joint{joint}_rad" for joint in range(1, 7)] + ["gripper"]
FEATURES: Mapping[str, Any] = {
    "observation.state": {"dtype": "float32", "shape": [7], "names": {"motors": NAMES}},
    "action": {"dtype": "float32", "shape": [7], "names": None},
    "observation.tactile.pad": {"dtype": "int64", "shape": [4], "names": None},
    "observation.images.top": {"dtype": "video", "shape": [480, 640, 3], "names": ["height", "width", "channels"]},
    "next.reward": {"dtype": "float32", "shape": [1], "names": None},
    "next.done": {"dtype": "bool", "shape": [1], "names": None},
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "index": {"dtype": "int64", "shape": [1], "names": None},
    "task_index": {"dtype": "int64", "shape": [1], "names": None},
}


def state(episode: int) -> Any:
    """Return the state of an episode (frame, 7)."""
    return np.random.default_rng(episode).normal(size=(LENGTHS[episode % 3], 7)).astype(np.float32)


def frames(episode: int, start: int = 0, late_s: float = 0.0) -> pa.Table:
    """Return the frames of an episode, of which ``start`` are before it; ``late_s`` is added to the last stamp."""
    rows = LENGTHS[episode % 3]
    stamps = (np.arange(rows) / FPS).astype(np.float32)
    stamps[-1] += np.float32(late_s)
    columns: dict[str, Any] = {
        "observation.state": _vectors(state(episode)),
        "action": _vectors(state(episode) + 1),
        "observation.tactile.pad": _vectors(np.arange(rows * 4).reshape(rows, 4)),
        "next.reward": pa.array(np.full(rows, 0.5, np.float32)),
        "next.done": pa.array(np.arange(rows) == rows - 1),
        "timestamp": pa.array(stamps),
        "frame_index": pa.array(np.arange(rows)),
        "episode_index": pa.array(np.full(rows, episode)),
        "index": pa.array(np.arange(rows) + start),
        "task_index": pa.array(np.full(rows, episode % 2)),
    }
    return pa.table(columns)


def _vectors(values: Any) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def write_v2(root: Path, episodes: int = 3, version: str = "v2.1", **info: Any) -> None:
    """Write a dataset of version 2: a file an episode, JSON lines of episodes and tasks."""
    lines = []
    for episode in range(episodes):
        path = root / "data" / "chunk-000" / f"episode_{episode:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(frames(episode), path)
        lines.append({"episode_index": episode, "tasks": [TASKS[episode % 2]], "length": LENGTHS[episode % 3]})
    data = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    video = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    _info(root, version, data_path=data, video_path=video, chunks_size=1000, total_episodes=episodes, **info)
    _lines(root / "meta" / "episodes.jsonl", lines)
    _lines(root / "meta" / "tasks.jsonl", [{"task_index": at, "task": task} for at, task in enumerate(TASKS)])


def write_v3(root: Path, files: Sequence[Sequence[int]] = ((0, 1), (2,)), **info: Any) -> None:
    """Write a dataset of version 3.0: ``files`` are the episodes of each file, one row group each."""
    rows: list[dict[str, Any]] = []
    start = 0
    for number, episodes in enumerate(files):
        path = root / "data" / "chunk-000" / f"file-{number:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(path, frames(0).schema) as writer:
            for episode in episodes:
                table = frames(episode, start)
                writer.write_table(table)
                row = {"episode_index": episode, "tasks": [TASKS[episode % 2]], "length": table.num_rows}
                row |= {"data/chunk_index": 0, "data/file_index": number, "stats/action/max": [1.0]}
                row |= {"videos/observation.images.top/chunk_index": 0, "videos/observation.images.top/file_index": 4}
                row["videos/observation.images.top/from_timestamp"] = start / videos.RATE_HZ
                rows.append({**row, "dataset_from_index": start, "dataset_to_index": start + table.num_rows})
                start += table.num_rows
    data = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    video = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    _info(root, "v3.0", data_path=data, video_path=video, total_episodes=len(rows), **info)
    path = root / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), path)


def _info(root: Path, version: str, **entries: Any) -> None:
    (root / "meta").mkdir(parents=True, exist_ok=True)
    output = {"codebase_version": version, "robot_type": "so100", "fps": FPS, "features": dict(FEATURES), **entries}
    (root / "meta" / "info.json").write_text(json.dumps(output))


def _lines(path: Path, values: Sequence[Mapping[str, Any]]) -> None:
    path.write_text("".join(json.dumps(value) + "\n" for value in values))
