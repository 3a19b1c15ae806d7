"""Results of the task ``touch`` made by hand, with what the report reads of real ones."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.channels import biotac_sp
from tests.fake_recordings import FakeDataset, FakeRecording

KNOWN, NOVEL = ("bleach", "coffee", "spam"), ("drill", "shoe")
PER_OBJECT = 8  # unseen grasps
MANIFEST = {
    "stage": "evaluate",
    "version": 3,
    "params": {},
    "digest": "ab" * 32,
    "chain": [{"stage": "segment.grasps", "version": 1, "params": {}, "fitted": None}],
    "inputs": {"model": [{"dataset": "cd" * 32, "manifest": "ef" * 32}]},
}
PARAMS = {
    "inputs": "rgbcont",
    "points": 750,
    "normalisation": "minmax",
    "rotation_deg": 0,
    "head": "fc3",
    "together": False,
    "transform": True,
    "epochs": 250,
    "batch": 10,
    "learning_rate": 0.01,
}
Errors = Mapping[str, float]  # object -> distance of the prediction from the truth, as a fraction of the range


def truth(target: str, grasps: int, seed: int = 0) -> AnyArray:
    """Return true values (grasp, value) as shares of the range, 0.5 on average and 0.1 off it."""
    width = biotac_sp.width(target)
    signs = np.where(np.arange(grasps) % 2 == 0, 1.0, -1.0)[:, None]
    pattern = np.cos(np.arange(width) + seed)[None] if width > 1 else np.ones((1, 1))
    shares: AnyArray = 0.5 + 0.1 * signs * pattern / np.sqrt(np.mean(pattern**2))
    return shares


def result(
    architecture: str = "strong",
    *,
    off: float | Errors = 0.05,
    known: Sequence[str] = KNOWN,
    novel: Sequence[str] = (),
    targets: Sequence[str] = biotac_sp.TARGETS,
    per_object: int = PER_OBJECT,
    baselines: Mapping[str, float] | None = None,
    split: str = "random",
    epochs: int = 0,
    train: int = 100,
    first: int = 0,
    simulated: bool = False,
    published: bool = True,
    metrics: Mapping[str, Any] | None = None,
    seed: int = 0,
    **params: Any,
) -> Any:
    """Return one result whose model is ``off`` by so much of the range on every value, by turns above and below.

    The constant says 0.5 of the range, which is off by 0.1 on average; other ``baselines`` are off as told. One more
    grasp, which the model was trained on, is told with values that would be seen in any sum.
    """
    objects = [name for name in (*known, *novel) for _ in range(per_object)]
    number = [first + index % per_object for index in range(len(objects))]
    rows = len(objects)
    offs = np.array([off[name] if isinstance(off, Mapping) else off for name in objects])
    side = np.where(np.arange(rows) % 4 < 2, 1.0, -1.0)
    shares = {"true": {target: truth(target, rows, seed=3) for target in targets}}
    true = shares["true"]
    shares["constant"] = {target: np.full_like(one, 0.5) for target, one in true.items()}
    offs_by_predictor = {"model": offs, **{name: np.full(rows, value) for name, value in (baselines or {}).items()}}
    shares |= {
        name: {target: values + (side * by)[:, None] for target, values in true.items()}
        for name, by in offs_by_predictor.items()
    }
    grasps = {
        "recording": [*(f"{name}-{index:03d}" for name, index in zip(objects, number, strict=True)), "bleach-seen"],
        "object": [*objects, "bleach"],
        "session": ["s01"] * (rows + 1),
        "t_ns": np.arange(rows + 1) * 60_000_000_000,
        "seen": [False] * rows + [True],
        "known": [*(name in known for name in objects), True],
    }
    tables = {name: _table(touch) for name, touch in shares.items()}
    marked = {"published": "vision2tactile"} if published else {}
    attributes = {"simulated": True} if simulated else marked
    shard: Any = FakeRecording({"grasps": pa.table(grasps), **tables}, "predictions", attributes)
    config = {
        "task": "touch",
        "architecture": architecture,
        "params": {**PARAMS, "architecture": architecture, "targets": ",".join(targets), "seed": seed, **params},
        "split": split,
        "targets": list(targets),
        "objects": sorted(known),
        "counts": {"train": train, "val": 10},
        "trained_on": {"bleach-seen": "00"},
        "parameters": 1000 if epochs else None,
    }
    files = {
        "config.json": json.dumps(config).encode(),
        "metrics.json": json.dumps({"model": {"n": rows}, **(metrics or {})}).encode(),
    }
    if epochs:
        lines = [json.dumps(line) for target in targets for line in history(target, epochs, seed)]
        files["history.jsonl"] = "\n".join([*lines, ""]).encode()
    return FakeDataset({"predictions": shard}, files, MANIFEST)


def history(target: str, epochs: int, seed: int) -> list[dict[str, Any]]:
    """Return lines of ``history.jsonl`` of one network."""
    lines = []
    for epoch in range(1, epochs + 1):
        loss = 0.05 + 0.1 * float(np.exp(-4 * epoch / epochs)) + 0.005 * np.sin(epoch + seed)
        line = {"epoch": epoch, "train_loss": loss, "val_loss": 1.2 * loss, "best": epoch == epochs, "target": target}
        lines.append(line)
    return lines


def _table(touch: Mapping[str, AnyArray]) -> pa.Table:
    """Return shares of ranges as the stream that holds them, in device counts, with a row of the seen grasp."""
    columns: dict[str, Any] = {}
    for target, shares in touch.items():
        counts = np.vstack([biotac_sp.to_counts(target, shares), np.full((1, shares.shape[1]), 1e6)])
        names = biotac_sp.value_columns(target)
        columns |= {name: counts[:, index].astype(np.float32) for index, name in enumerate(names)}
    return pa.table(columns)
