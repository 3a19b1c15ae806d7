"""Results of the task ``material`` made by hand, with what the report reads of real ones."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from tests.fake_recordings import FakeDataset, FakeRecording, FakeShard

MATERIALS, TRIALS = 4, 5  # materials, and test slides of a sensor on each
MANIFEST = {
    "stage": "evaluate",
    "version": 2,
    "params": {},
    "digest": "ab" * 32,
    "chain": [{"stage": "segment.slides", "version": 1, "params": {"frames": 400}, "fitted": None}],
    "inputs": {"model": [{"dataset": "cd" * 32, "manifest": "ef" * 32}]},
}
Shares = Mapping[str, float]


def slides(
    sensor: str, materials: int = MATERIALS, trials: int = TRIALS, first: int = 1
) -> tuple[list[str], list[int]]:
    """Return the names of test slides and the material of each."""
    truth = [material for material in range(1, materials + 1) for _ in range(trials)]
    return [f"{sensor}-m{material:02d}-t{first + row % trials:03d}" for row, material in enumerate(truth)], truth


def said(truth: Sequence[int], wrong: int, materials: int = MATERIALS) -> list[int]:
    """Return what names all but the first ``wrong`` slides, by turns of the materials, right; wrong ones are the next."""
    order = np.argsort(np.arange(len(truth)) % (len(truth) // materials), kind="stable")
    named = np.array(truth)
    named[order[:wrong]] = named[order[:wrong]] % materials + 1
    return [int(number) for number in named]


def result(
    architecture: str = "raec",
    *,
    wrong: Mapping[str, int],
    also: Mapping[str, Mapping[str, int]] | None = None,
    fold: int | None = 0,
    epochs: int = 0,
    alignment: float = 0.01,
    partners: Mapping[int, int] | None = None,
    train: Mapping[str, int] | None = None,
    materials: int = MATERIALS,
    trials: int = TRIALS,
    first: int = 1,
    simulated: bool = False,
    published: bool = True,
    sessions: int = 1,
    metrics: Mapping[str, Any] | None = None,
    validation_slides: int = 0,
    **params: Any,
) -> Any:
    """Return one result whose model names all but ``wrong`` slides of each sensor right, and ``also`` by predictor.

    Networks, which have ``epochs``, have latents around their material's corner; the second sensor's lie where the first
    one's of the material lie whose ``partners`` theirs is. Slides are of the published sets unless they are ``simulated`` or
    not ``published``, and those of a material are of so many ``sessions``.
    """
    sensors = list(wrong)
    rows: dict[str, list[Any]] = {name: [] for name in ("recording", "sensor", "material", "seen", "session")}
    named_by_predictor: dict[str, list[int | None]] = {}
    latents = []
    rng = np.random.default_rng(fold or 0)
    for place, sensor in enumerate(sensors):
        names, truth = slides(sensor, materials, trials, first)
        rows["recording"] += [*names, f"{sensor}-seen"]
        rows["sensor"] += [sensor] * (len(names) + 1)
        rows["material"] += [*truth, 1]
        rows["seen"] += [False] * len(names) + [True]
        rows["session"] += [f"{sensor}-{material}-{at % sessions}" for at, material in enumerate([*truth, 1])]
        for predictor, mistakes in {"model": wrong, **(also or {})}.items():
            column: list[int | None] = [*said(truth, mistakes[sensor], materials), 2] if sensor in mistakes else []
            named_by_predictor.setdefault(predictor, []).extend(column or [None] * (len(names) + 1))
        original = {partner: first_class for first_class, partner in (partners or {}).items()} if place else {}
        corners = np.random.default_rng(1).normal(0, 1, (materials + 1, 40)) * 0.7 ** np.arange(40)
        at = corners[[original.get(material, material) for material in [*truth, 1]]]
        latents.append(at + rng.normal(0, 0.15, at.shape) * 0.7 ** np.arange(40))
    columns = {**rows, **{name: pa.array(values, pa.int32()) for name, values in named_by_predictor.items()}}
    if epochs:
        columns |= {f"z{index + 1:02d}": np.vstack(latents)[:, index].astype(np.float32) for index in range(40)}
    content = {
        "task": "material",
        "architecture": architecture,
        "sensors": {
            sensor: {"channels": ["a"], "frames": 400, "rate_hz": 100.0, "layout": "time"} for sensor in sensors
        },
        "classes": list(range(1, materials + 1)),
        "trained_on": {f"{sensor}-train{fold}-{index}": "00" for sensor in sensors for index in range(3)},
        "counts": {
            "train": dict(train or dict.fromkeys(sensors, 576)),
            "val": dict.fromkeys(sensors, validation_slides),
        },
        "params": {"architecture": architecture, "seed": 0, "joint": False, "known": "", **params},
        **({} if fold is None else {"fold": fold}),
        **(
            {}
            if partners is None
            else {"partners": {str(first_class): partner for first_class, partner in partners.items()}}
        ),
    }
    files = {
        "config.json": json.dumps(content).encode(),
        "metrics.json": json.dumps({"counts": {"slides": dict.fromkeys(sensors, trials)}, **(metrics or {})}).encode(),
    }
    if epochs:
        lines = [json.dumps(line) for line in history(sensors, epochs, alignment, bool(params.get("joint")))]
        files["history.jsonl"] = "\n".join([*lines, ""]).encode()
    attributes: dict[str, Any] = {"simulated": True} if simulated else {}
    if published and not simulated:
        attributes["published"] = ",".join(
            sorted({"biotac": "biotac-slide"}.get(first_class, first_class) for first_class in sensors)
        )
    return FakeDataset({"predictions": FakeShard("predictions", pa.table(columns), attributes)}, files, MANIFEST)


def history(sensors: Sequence[str], epochs: int, alignment: float, joint: bool) -> list[dict[str, Any]]:
    """Return lines of ``history.jsonl`` whose latent difference ends at ``alignment``."""
    lines = []
    for epoch in range(1, epochs + 1):
        near = 1 - np.exp(-4 * epoch / epochs)
        lines.append(
            {
                "epoch": epoch,
                "train_loss": 2 - near,
                "val_loss": 2.1 - near,
                "best": epoch == max(epochs - 1, 1),
                "alignment": alignment * 10 ** (3 * (1 - epoch / epochs)) if joint else None,
                "val": {sensor: {"accuracy": 0.95 * near - 0.02 * place} for place, sensor in enumerate(sensors)},
            }
        )
    return lines


def recorded() -> Any:
    """Return a dataset of slides."""
    slides = {name: FakeRecording({"slide": pa.table({"t_ns": [0]})}, name, {}) for name in ("a", "b")}
    return FakeDataset(slides)
