"""Measure how well a classifier answers ``unknown`` for materials that it was not trained on.

    python docs/unknown_materials.py DATA [FOLDER] [DRAWS]

DATA contains the published sets (data/README.md). In each draw, each of five folds leaves out four of the twenty materials,
trains on the others, sets its threshold on their validation slides, and is evaluated on slides of all twenty, so every
material is unknown once per draw. Slides are cut once and stored in FOLDER. The script prints a table and writes
FOLDER/unknown-materials.csv with one row per draw, fold, architecture and sensor.
"""

from __future__ import annotations

import csv
import json
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import tacpipe
from tacpipe.plugins import given_params, registry
from tacpipe.tasks.material import calibration as material_calibration
from tacpipe.tasks.material import evaluation as material_evaluation
from tacpipe.tasks.material import network_training
from tacpipe.tasks.task import CalibrationRequest

ARCHITECTURES = ("statistics",)  # The distance depends only on the slides, the probability on the architecture
FOLDS = 5
DEFAULT_FOLDER, DRAWS = ".cache/unknown-materials", 2
RATES = ("false_unknown", "false_known")
REQUEST = CalibrationRequest((10, 50, 90), promise=False, false_unknown=0.05, seed=0)


@dataclass
class Slide:
    """Slide whose tables are read only once."""

    shard: Any
    tables: dict[str, Any] = field(default_factory=dict)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.shard, name)

    def table(self, stream: str = "") -> Any:
        """Return the table of a stream, read on the first call."""
        if stream not in self.tables:
            self.tables[stream] = self.shard.table(stream)
        return self.tables[stream]


@dataclass(frozen=True)
class Slides:
    """Set of slides with the interface of a dataset that tasks read."""

    recordings: Mapping[str, Slide]
    files: Mapping[str, bytes] = field(default_factory=dict)


def main(data: Path, folder: Path, draws: int) -> None:
    """Run all draws, write their results after each fold, and print the table."""
    dataset = _cut_slides(data, folder)
    slides = {name: Slide(shard) for name, shard in dataset.recordings.items()}
    rows: list[dict[str, Any]] = []
    for draw in range(draws):
        options: dict[str, Any] = {"scheme": "kfold", "folds": FOLDS, "apart": "material", "val": 0.2, "seed": draw}
        split = tacpipe.run("split", dataset, output=folder / f"split-{draw}", stratify="sensor,material", **options)
        for fold in range(FOLDS):
            parts = [
                Slides({name: slides[name] for name in dataset.select(split=split, fold=fold, role=role).recordings})
                for role in ("train", "val", "test")
            ]
            for architecture in ARCHITECTURES:
                rows += _evaluate(parts, (draw, fold, architecture))
                print(f"draw {draw} fold {fold} {architecture}", file=sys.stderr, flush=True)
            with (folder / "unknown-materials.csv").open("w", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)
    print(table(rows))


def _cut_slides(data: Path, folder: Path) -> Any:
    recordings = [
        tacpipe.run(f"ingest.{name}", data / source, output=folder / name)
        for name, source in (("biotac-slide", "biotac_slide_20_50"), ("roboskin", "roboskin_slide_20_50"))
    ]
    return tacpipe.run("segment.slides", *recordings, output=folder / "slides")


def _evaluate(parts: list[Any], run: tuple[int, int, str]) -> list[dict[str, Any]]:
    """Train, calibrate and evaluate a run (draw, fold, architecture), and return one row per sensor."""
    draw, fold, architecture = run
    options = {"architecture": architecture, "use_validation": False, "baselines": False}
    params = given_params.build("train.material", registry.load("train.material"), options=options)
    with tempfile.TemporaryDirectory() as workspace:
        model = network_training.train(params, parts[0], parts[1], Path(workspace))
    model = material_calibration.calibrate(model, REQUEST, parts[0], parts[1])
    metrics = json.loads(material_evaluation.evaluate(model, parts[2]).files["metrics.json"])
    calibrations = json.loads(model["config.json"])["known"]
    return [
        {
            **{"draw": draw, "fold": fold, "architecture": architecture, "sensor": sensor, "rule": scores["rule"]},
            **{f"auroc_{rule}": value for rule, value in scores["auroc"].items()},
            **{name: scores[name] for rate in RATES for name in (rate, f"{rate}_n")},
            "accuracy": metrics["model"]["accuracy"][sensor],
            "accuracy_of_answers": scores.get("accuracy_of_answers", float("nan")),
            "calibrated_on": calibrations[sensor]["slides"],
            **{
                f"{measure}_{name}": metrics["calibration"][sensor][name][measure]
                for measure in ("calibration_error", "log_loss")
                for name in ("before", "after")
            },
        }
        for sensor, scores in metrics["unknown"].items()
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table of means over draws and folds, with the lowest and the highest value in brackets."""
    head = ("sensor", "architecture", "folds", "AUROC probability", "AUROC distance", "AUROC chosen")
    lines = [
        "| " + " | ".join((*head, "distance chosen", "false unknown", "false known", "ECE before", "after")) + " |"
    ]
    lines.append("| --- " * 11 + "|")
    for sensor in sorted({row["sensor"] for row in rows}):
        for architecture in ARCHITECTURES:
            runs = [row for row in rows if (row["sensor"], row["architecture"]) == (sensor, architecture)]
            chosen = [row[f"auroc_{row['rule']}"] for row in runs]
            cells = [sensor, f"`{architecture}`", str(len(runs))]
            cells += [_range([row[name] for row in runs], 3) for name in ("auroc_probability", "auroc_distance")]
            cells += [_range(chosen, 3), f"{sum(row['rule'] == 'distance' for row in runs)} of {len(runs)}"]
            cells += [_range([100 * row[name] for row in runs], 1) for name in RATES]
            cells += [_range([row[f"calibration_error_{name}"] for row in runs], 3) for name in ("before", "after")]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _range(values: list[float], digits: int) -> str:
    low, mean, high = min(values), float(np.mean(values)), max(values)
    return f"{mean:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


if __name__ == "__main__":
    arguments = [*sys.argv[1:], *["", DEFAULT_FOLDER, str(DRAWS)][len(sys.argv) - 1 :]]
    main(Path(arguments[0]), Path(arguments[1]), int(arguments[2]))
