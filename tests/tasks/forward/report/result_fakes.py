"""Handmade results with the parts that the report reads."""

import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.fake_recordings import FakeDataset, FakeShard

STEPS = (1, 2, 3)
GROUPS = {"both": 12, "sensor1": 6, "sensor2": 6, "x": 4, "standard": 12, "feature": 3}  # channels of each
WINDOWS = {"r1": 10, "r2": 30, "r3": 20, "r4": 20}
KNOWN = ("r1", "r2")
CODECS = {
    "raw": {"kind": "raw", "of": "levels", "frames": 1, "latents": 12, "name": "raw"},
    "PCA-20": {"kind": "pca", "of": "levels", "frames": 1, "latents": 20, "name": "PCA-20"},
    "PCA-8": {"kind": "pca", "of": "levels", "frames": 1, "latents": 8, "name": "PCA-8"},
    "AE-C1-8": {"kind": "autoencoder", "of": "levels", "frames": 1, "latents": 8, "name": "AE-C1-8"},
}
MANIFEST = {
    "stage": "evaluate",
    "version": 1,
    "params": {},
    "digest": "ab" * 32,
    "chain": [{"stage": "synchronize", "version": 2, "params": {"rate_hz": 50.0}, "fitted": None}],
    "inputs": {"model": [{"dataset": "cd" * 32, "manifest": "ef" * 32}]},
}


def errors(
    ratios: Mapping[str, Mapping[str, float]],
    windows: Mapping[str, int] = WINDOWS,
    known_objects_of: Sequence[str] = KNOWN,
    seen_recordings: Sequence[str] = (),
    steps: Sequence[int] = STEPS,
) -> bytes:
    """Return ``errors.parquet``.

    Persistence has a squared error of ``step`` a window and channel, and each predictor ``ratios`` by recording as much.
    """
    rows = [
        {
            "recording": name,
            "object": f"object of {name}",
            "known": name in known_objects_of,
            "seen": name in seen_recordings,
            "predictor": predictor,
            "group": group,
            "step": step,
            "windows": count,
            "channels": width,
            "squared": float(by_recording[name] * step * count * width),
            "absolute": float(by_recording[name] * 2 * step * count * width),
        }
        for predictor, by_recording in {**ratios, "persistence": dict.fromkeys(windows, 1.0)}.items()
        for group, width in GROUPS.items()
        for step in steps
        for name, count in windows.items()
    ]
    content = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows), content)
    return content.getvalue()


def result(
    codec: str = "PCA-20",
    seed: int = 0,
    *,
    architecture: str = "recurrent",
    ratio: float | Mapping[str, float] = 0.5,
    attributes: Mapping[str, Any] | None = None,
    **config: Any,
) -> Any:
    """Return one result whose model has ``ratio`` times the squared error of persistence.

    Without ``attributes``, its recordings are those of the published set.
    """
    by_recording = dict.fromkeys(WINDOWS, ratio) if isinstance(ratio, float) else dict(ratio)
    ratios = {
        "model": by_recording,
        "train_mean": dict.fromkeys(WINDOWS, 9.0),
        "ridge": dict.fromkeys(WINDOWS, 0.75),
        "codec": dict.fromkeys(WINDOWS, 0.25),
    }
    stored_config: dict[str, Any] = {
        "task": "forward",
        "architecture": architecture,
        "codec": CODECS[codec],
        "timeline": "uniform",
        "rate_hz": 50.0,
        "validation": {"mse_feature": 0.01 * (1 + seed)},
        **config,
        "params": {"seed": seed, "hidden": 200, "epochs": 50, "actions": "planned", **config.get("params", {})},
    }
    files = {
        "config.json": json.dumps(stored_config).encode(),
        "metrics.json": json.dumps(metrics(by_recording)).encode(),
        "errors.parquet": errors(ratios),
        "history.jsonl": b'{"epoch": 1, "train_loss": 0.2, "val_loss": 0.3}\n',
    }
    latents = [f"z{index:02d}" for index in range(4)]
    marked = {"published": "xela-flat"} if attributes is None else dict(attributes)
    shards = {name: FakeShard(name, predictions(latents), dict(marked)) for name in WINDOWS}
    return FakeDataset(shards, files, MANIFEST)


def metrics(ratio: Mapping[str, float]) -> dict[str, Any]:
    """Return ``metrics.json`` as `tacpipe.tasks.forward.metrics` writes it, with known and unseen objects and ``seen``."""
    tree = _part(ratio, list(ratio))
    tree["known"] = _part(ratio, list(KNOWN))
    tree["unseen"] = _part(ratio, [name for name in ratio if name not in KNOWN])
    tree["seen"] = _part({"old": 0.1}, ["old"])
    return tree


def predictions(latents: Sequence[str], rows: int = 40) -> pa.Table:
    """Return a shard of predictions: what was and what was forecast at each row."""
    t = np.arange(rows)
    columns: dict[str, Any] = {"t_ns": t * 20_000_000, "contact": (t > 20).astype(np.int32)}
    for index, name in enumerate(latents):
        for step in (0, 1, 3, 5, 10):
            columns[f"{name}_t{step}" if step else name] = np.sin((t + step) / (4 + index)).astype(np.float32)
    return pa.table(columns)


def _part(ratio: Mapping[str, float], names: Sequence[str]) -> dict[str, Any]:
    mean = float(np.mean([ratio[name] for name in names]))
    skill = {f"t{step}": {"mean": 1 - mean, "low": 0.9 - mean, "high": 1.1 - mean} for step in STEPS}
    skill["mean"] = {"mean": 1 - mean, "low": 0.9 - mean, "high": 1.1 - mean}
    tree: dict[str, Any] = {
        "counts": {"windows": 40, "recordings": len(names), "recordings_without_window": 0, "effective_windows": 13},
        "skill": {"mse_counts": skill, "mse_latent": skill, "mae_counts_geometric": skill},
    }
    for name, share in (("model", mean), ("persistence", 1.0), ("train_mean", 9.0), ("codec", 0.25)):
        scores = {f"t{step}": share * step for step in STEPS} | {"mean": 2 * share}
        grouped = dict.fromkeys(("both", "sensor1", "sensor2", "x"), scores)
        tree[name] = {"mse_latent": scores, "mse_feature": scores, "mse_counts": grouped, "mae_counts": grouped}
    del tree["train_mean"]["mse_feature"]
    return tree
