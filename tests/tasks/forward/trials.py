"""Small recordings, params and models for the tests of the forward task."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.codecs import codec as codecs
from tacpipe.plugins import registry
from tacpipe.plugins.stage import Result
from tacpipe.signals import kinematics
from tacpipe.tasks.forward import evaluation as forward_evaluation
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward import training as forward_training
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.predictors import Predicted, iterate_predictions
from tests.fake_recordings import FakeShard, dataset
from tests.stage_params import fitting
from tests.stages.learning_fakes import CHANNELS, REST, motion, table

CONTEXT, HORIZON = 5, 4
LENGTH = CONTEXT + HORIZON
SMALL = {"architecture": "gru", "hidden": 16, "epochs": 2, "batch": 64, "context": CONTEXT, "horizon": HORIZON}
ENSEMBLE = {"members": 2}


def params(**changed: Any) -> Any:
    """The params of the training stage, small."""
    return fitting("train.forward", SMALL, **changed)


def trained(folder: Path, training: Any = None, validation: Any = None, **changed: Any) -> dict[str, bytes]:
    """The files of a small model of swinging arms."""
    training = training or dataset(*(motion(seed) for seed in range(3)))
    return forward_training.train(params(**changed), training, validation or dataset(motion(10)), folder)


def compressed(*shards: FakeShard, files: Mapping[str, bytes] | None = None, representation: str = "levels") -> Any:
    """The recordings with three principal components, and the codec's files."""
    stage = registry.load("compress.pca")
    assert stage.fit is not None
    params = stage.params(components=3, representation=representation)
    files = dict(files or stage.fit(params, dataset(*shards)).files)
    latent = [dataclasses.replace(shard, content=stage(params, shard, files)) for shard in shards]
    return dataset(*latent, files=files)


def track(content: pa.Table, name: str = "trial", **attributes: Any) -> tracks.Track:
    """The track of a table."""
    shard: Any = FakeShard(name, content, attributes)
    return tracks.track(shard, tracks.codec_of(content.schema, {}))


def evaluated(model: Mapping[str, bytes], *shards: FakeShard, files: Mapping[str, bytes] | None = None) -> Any:
    """``metrics.json`` and the result of evaluating a model on recordings."""
    result: Result = forward_evaluation.evaluate(model, dataset(*shards, files=files))
    return json.loads(result.files["metrics.json"]), result


def predicted_windows(forecaster: Forecaster, shard: Any) -> tuple[tracks.Track, Int64s, Predicted]:
    """Return a recording, the first rows of its windows, and the predictions for all of them."""
    recorded = tracks.track(shard, forecaster.codec)
    starts = recorded.starts(forecaster.context, forecaster.horizon)
    (windows,) = iterate_predictions(forecaster, recorded, starts)
    return recorded, starts, windows


def asked(recorded: tracks.Track, starts: Int64s, columns: int = 13) -> tuple[AnyFloats, AnyFloats]:
    """The windows and plans that `predict` is given for these first rows; without velocities where 7 columns do."""
    past, plan = (starts[:, None] + np.arange(*ends) for ends in ((0, CONTEXT), (CONTEXT, LENGTH)))
    finger = [recorded.finger[past][..., None]] if columns > 7 else []
    window = np.concatenate([recorded.tactile[past], recorded.arm[past][..., :columns], *finger], axis=-1)
    return window, recorded.arm[plan][..., :columns]


def counts(shard: FakeShard) -> AnyFloats:
    """Counts above rest as they stand in a recording's columns (time, channel)."""
    return np.column_stack([shard.content[name].to_numpy() for name in CHANNELS]).astype(np.float64) - REST


def poses(shard: FakeShard) -> AnyFloats:
    """The poses as they stand in a recording's columns (time, 7)."""
    return np.column_stack([shard.content[name].to_numpy() for name in tracks.POSE])


def panda(rows: int = 60) -> tuple[AnyFloats, dict[str, AnyFloats]]:
    """The hand's poses (time, 7) of a Panda that swings, and the columns of its joints."""
    time_s, start = np.arange(rows)[:, None] * 0.02, np.array([0.0, -0.4, 0.1, -2.0, 0.0, 1.8, 0.7])
    size, rate = np.linspace(0.05, 0.2, 7), np.linspace(2, 4, 7)
    angles, speeds = start + size * np.sin(rate * time_s), size * rate * np.cos(rate * time_s)
    last = kinematics.joint_frames(kinematics.PANDA, angles)[:, -1]
    place = last[:, :3, :3] @ np.array([0.0, 0.0, 0.2]) + last[:, :3, 3]
    columns: dict[str, AnyFloats] = {f"robot_joint{joint + 1}_rad": angles[:, joint] for joint in range(7)}
    columns |= {f"robot_joint{joint + 1}_velocity_rad_s": speeds[:, joint] for joint in range(7)}
    return np.hstack([place, Rotation.from_matrix(last[:, :3, :3]).as_quat()]), columns


def raw() -> codecs.Codec:
    """The codec of recordings that have none."""
    return tracks.codec_of(motion(0).content.schema, {})


__all__ = ["CHANNELS", "FakeShard", "dataset", "motion", "table"]
