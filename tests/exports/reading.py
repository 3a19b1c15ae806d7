"""What runs in the environment of `tests.exports.environment`: opens exports with other tools and prints what these give.

It imports nothing of tacpipe.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from pathlib import Path
from typing import Any


def lerobot(folder: str) -> dict[str, Any]:
    """Open with LeRobot's loader: whole, one episode, with a window of the past; and its own view of the features."""
    import numpy as np
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.datasets.utils import dataset_to_policy_features

    whole = LeRobotDataset("tacpipe/export", root=folder)
    frames = [whole[index] for index in range(len(whole))]
    past = [-2 / whole.fps, 0.0, 1 / whole.fps]
    windows = LeRobotDataset("tacpipe/export", root=folder, episodes=[1], delta_timestamps={"observation.state": past})
    window = windows[0]
    return {
        "frames": len(whole),
        "episodes": whole.num_episodes,
        "fps": whole.fps,
        "values": {
            name: np.array([frame[name].tolist() for frame in frames]).tolist()
            for name in ("observation.state", "observation.tactile.skin", "action", "tacpipe.t_ns", "episode_index")
        },
        "tasks": sorted({frame["task"] for frame in frames}),
        "names": whole.features["observation.state"]["names"],
        "policy": {name: one.type.name for name, one in dataset_to_policy_features(whole.meta.features).items()},
        "window": window["observation.state"].tolist(),
        "padded": window["observation.state_is_pad"].tolist(),
        "mean": whole.meta.stats["observation.tactile.skin"]["mean"].tolist(),
        "recordings": list(whole.meta.episodes["tacpipe/recording"]),
    }


def add_frame(folder: str) -> dict[str, Any]:
    """Write the frames of an export again with LeRobot's own writer; return its seconds and bytes."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    given = LeRobotDataset("tacpipe/export", root=folder)
    index = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
    features = {name: one for name, one in given.features.items() if name not in index and one["dtype"] != "string"}
    frames = [given[number] for number in range(len(given))]
    started = time.perf_counter()
    made = LeRobotDataset.create("a/b", fps=given.fps, features=features, root=f"{folder}-theirs", use_videos=False)
    episode = 0
    for frame in frames:
        if frame["episode_index"].item() != episode:
            made.save_episode()
            episode = frame["episode_index"].item()
        values = {
            name: frame[name].numpy().astype(one["dtype"]).reshape(one["shape"]) for name, one in features.items()
        }
        made.add_frame({**values, "task": frame["task"]})
    made.save_episode()
    made.finalize()
    seconds = time.perf_counter() - started
    size = sum(path.stat().st_size for path in Path(f"{folder}-theirs").rglob("*") if path.is_file())
    return {"seconds": seconds, "bytes": size, "frames": len(frames)}


def hub(folder: str) -> dict[str, Any]:
    """Open a card with `datasets`: each configuration's rows and types."""
    import datasets

    found = {}
    for name in datasets.get_dataset_config_names(folder):
        rows = datasets.load_dataset(folder, name)["train"]
        found[name] = {
            "rows": len(rows),
            "types": {key: one.dtype for key, one in rows.features.items()},
            "last": rows[-1],
        }
    return found


def parquet(pattern: str) -> dict[str, Any]:
    """Open Parquet files with `datasets`."""
    import datasets

    rows = datasets.load_dataset("parquet", data_files=pattern)["train"]
    return {"rows": len(rows), "types": {key: one.dtype for key, one in rows.features.items()}}


def croissant(folder: str) -> dict[str, Any]:
    """Validate the metadata with `mlcroissant`, and read the rows through them."""
    import mlcroissant

    dataset = mlcroissant.Dataset(f"{folder}/croissant.json")
    issues = dataset.metadata.ctx.issues
    records = {one.id: list(dataset.records(one.id)) for one in dataset.metadata.record_sets}
    return {
        "errors": sorted(issues.errors),
        "warnings": sorted(issues.warnings),
        "name": dataset.metadata.name,
        "records": {
            name: {
                "rows": len(rows),
                "last": {key: one.decode() if isinstance(one, bytes) else one for key, one in rows[-1].items()},
            }
            for name, rows in records.items()
        },
    }


if __name__ == "__main__":
    logging.disable(logging.WARNING)
    result = {"lerobot": lerobot, "add_frame": add_frame, "hub": hub, "parquet": parquet, "croissant": croissant}[
        sys.argv[1]
    ](sys.argv[2])
    sys.stdout.write(json.dumps(result, default=float))
