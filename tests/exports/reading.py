"""Open exports with other tools in the environment of `tests.exports.environment`, and print their content.

This module does not import tacpipe.
"""

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

    dataset = LeRobotDataset("tacpipe/export", root=folder)
    frames = [dataset[index] for index in range(len(dataset))]
    past = [-2 / dataset.fps, 0.0, 1 / dataset.fps]
    windows = LeRobotDataset("tacpipe/export", root=folder, episodes=[1], delta_timestamps={"observation.state": past})
    window = windows[0]
    return {
        "frames": len(dataset),
        "episodes": dataset.num_episodes,
        "fps": dataset.fps,
        "values": {
            name: np.array([frame[name].tolist() for frame in frames]).tolist()
            for name in ("observation.state", "observation.tactile.skin", "action", "tacpipe.t_ns", "episode_index")
        },
        "tasks": sorted({frame["task"] for frame in frames}),
        "names": dataset.features["observation.state"]["names"],
        "policy": {name: value.type.name for name, value in dataset_to_policy_features(dataset.meta.features).items()},
        "window": window["observation.state"].tolist(),
        "padded": window["observation.state_is_pad"].tolist(),
        "mean": dataset.meta.stats["observation.tactile.skin"]["mean"].tolist(),
        "recordings": list(dataset.meta.episodes["tacpipe/recording"]),
    }


def lerobot_video(folder: str) -> dict[str, Any]:
    """Decode some frames of a video feature with LeRobot's loader."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("tacpipe/export", root=folder)
    rows = [0, 1, 17, 39, 40, 63, 79]
    images = [dataset[row]["observation.images.gel"].tolist() for row in rows]
    return {"frames": len(dataset), "rows": rows, "images": images}


def add_frame(folder: str) -> dict[str, Any]:
    """Write the frames of an export again with LeRobot's own writer; return its seconds and bytes."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("tacpipe/export", root=folder)
    index = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
    features = {
        name: value for name, value in dataset.features.items() if name not in index and value["dtype"] != "string"
    }
    frames = [dataset[number] for number in range(len(dataset))]
    started = time.perf_counter()
    output = LeRobotDataset.create("a/b", fps=dataset.fps, features=features, root=f"{folder}-theirs", use_videos=False)
    episode = 0
    for frame in frames:
        if frame["episode_index"].item() != episode:
            output.save_episode()
            episode = frame["episode_index"].item()
        values = {
            name: frame[name].numpy().astype(value["dtype"]).reshape(value["shape"]) for name, value in features.items()
        }
        output.add_frame({**values, "task": frame["task"]})
    output.save_episode()
    output.finalize()
    seconds = time.perf_counter() - started
    size = sum(path.stat().st_size for path in Path(f"{folder}-theirs").rglob("*") if path.is_file())
    return {"seconds": seconds, "bytes": size, "frames": len(frames)}


def hub(folder: str) -> dict[str, Any]:
    """Open a card with `datasets`: each configuration's rows and types."""
    import datasets

    result = {}
    for name in datasets.get_dataset_config_names(folder):
        rows = datasets.load_dataset(folder, name)["train"]
        result[name] = {
            "rows": len(rows),
            "types": {key: value.dtype for key, value in rows.features.items()},
            "last": rows[-1],
        }
    return result


def parquet(pattern: str) -> dict[str, Any]:
    """Open Parquet files with `datasets`."""
    import datasets

    rows = datasets.load_dataset("parquet", data_files=pattern)["train"]
    return {"rows": len(rows), "types": {key: value.dtype for key, value in rows.features.items()}}


def croissant(folder: str) -> dict[str, Any]:
    """Validate the metadata with `mlcroissant`, and read the rows through them."""
    import mlcroissant

    dataset = mlcroissant.Dataset(f"{folder}/croissant.json")
    issues = dataset.metadata.ctx.issues
    records = {entry.id: list(dataset.records(entry.id)) for entry in dataset.metadata.record_sets}
    return {
        "errors": sorted(issues.errors),
        "warnings": sorted(issues.warnings),
        "name": dataset.metadata.name,
        "records": {
            name: {
                "rows": len(rows),
                "last": {key: value.decode() if isinstance(value, bytes) else value for key, value in rows[-1].items()},
            }
            for name, rows in records.items()
        },
    }


if __name__ == "__main__":
    logging.disable(logging.WARNING)
    result = {
        "lerobot": lerobot,
        "lerobot_video": lerobot_video,
        "add_frame": add_frame,
        "hub": hub,
        "parquet": parquet,
        "croissant": croissant,
    }[sys.argv[1]](sys.argv[2])
    sys.stdout.write(json.dumps(result, default=float))
