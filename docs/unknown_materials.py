"""How well a classifier answers ``unknown``: trained with materials left out, several draws of the published slides.

    python docs/unknown_materials.py DATA [FOLDER] [DRAWS]

DATA holds the published sets (data/README.md). In each draw each of five folds leaves out four of the twenty materials,
trains on the others, sets its threshold on validation slides of these, and is evaluated on slides of all twenty: so every
material is unknown once a draw. Slides are cut once; FOLDER holds them and their store. Prints a table, and writes
FOLDER/unknown-materials.csv with a row a draw, fold, architecture and sensor.
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

ARCHITECTURES = ("statistics",)  # the distance depends on the slides only, the probability on the architecture
FOLDS = 5
PLACE, DRAWS = ".cache/unknown-materials", 2
COUNTED = ("false_unknown", "false_known")
ASKED = CalibrationRequest((10, 50, 90), promise=False, false_unknown=0.05, seed=0)


@dataclass
class Slide:
    """A slide that is read once."""

    shard: Any
    tables: dict[str, Any] = field(default_factory=dict)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.shard, name)

    def table(self, stream: str = "") -> Any:
        """Return its table."""
        if stream not in self.tables:
            self.tables[stream] = self.shard.table(stream)
        return self.tables[stream]


@dataclass(frozen=True)
class Slides:
    """Some slides, as a task reads a dataset."""

    recordings: Mapping[str, Slide]
    files: Mapping[str, bytes] = field(default_factory=dict)


def main(data: Path, folder: Path, draws: int) -> None:
    """Run all draws, then print and write what they gave."""
    opened = _slides(data, folder)
    every = {name: Slide(shard) for name, shard in opened.recordings.items()}
    rows: list[dict[str, Any]] = []
    for draw in range(draws):
        options: dict[str, Any] = {"scheme": "kfold", "folds": FOLDS, "apart": "material", "val": 0.2, "seed": draw}
        split = tacpipe.run("split", opened, output=folder / f"split-{draw}", stratify="sensor,material", **options)
        for fold in range(FOLDS):
            parts = [
                Slides({name: every[name] for name in opened.select(split=split, fold=fold, role=role).recordings})
                for role in ("train", "val", "test")
            ]
            for architecture in ARCHITECTURES:
                rows += _evaluated(parts, (draw, fold, architecture))
                print(f"draw {draw} fold {fold} {architecture}", file=sys.stderr, flush=True)
            with (folder / "unknown-materials.csv").open("w", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)
    print(table(rows))


def _slides(data: Path, folder: Path) -> Any:
    given = [
        tacpipe.run(f"ingest.{name}", data / place, output=folder / name)
        for name, place in (("biotac-slide", "biotac_slide_20_50"), ("roboskin", "roboskin_slide_20_50"))
    ]
    return tacpipe.run("segment.slides", *given, output=folder / "slides")


def _evaluated(parts: list[Any], about: tuple[int, int, str]) -> list[dict[str, Any]]:
    """Return a row a sensor of one fold of a draw."""
    draw, fold, architecture = about
    options = {"architecture": architecture, "use_validation": False, "baselines": False}
    params = given_params.build("train.material", registry.load("train.material"), options=options)
    with tempfile.TemporaryDirectory() as workspace:
        model = network_training.train(params, parts[0], parts[1], Path(workspace))
    model = material_calibration.calibrate(model, ASKED, parts[0], parts[1])
    tree = json.loads(material_evaluation.evaluate(model, parts[2]).files["metrics.json"])
    known = json.loads(model["config.json"])["known"]
    return [
        {
            **{"draw": draw, "fold": fold, "architecture": architecture, "sensor": sensor, "rule": found["rule"]},
            **{f"auroc_{rule}": value for rule, value in found["auroc"].items()},
            **{name: found[name] for one in COUNTED for name in (one, f"{one}_n")},
            "accuracy": tree["model"]["accuracy"][sensor],
            "accuracy_of_answers": found.get("accuracy_of_answers", float("nan")),
            "calibrated_on": known[sensor]["slides"],
            **{
                f"{measure}_{name}": tree["calibration"][sensor][name][measure]
                for measure in ("calibration_error", "log_loss")
                for name in ("before", "after")
            },
        }
        for sensor, found in tree["unknown"].items()
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """Return a table in Markdown: means over draws and folds, the lowest and the highest of them in brackets."""
    head = ("sensor", "architecture", "folds", "AUROC probability", "AUROC distance", "AUROC chosen")
    lines = [
        "| " + " | ".join((*head, "distance chosen", "false unknown", "false known", "ECE before", "after")) + " |"
    ]
    lines.append("| --- " * 11 + "|")
    for sensor in sorted({one["sensor"] for one in rows}):
        for architecture in ARCHITECTURES:
            some = [one for one in rows if (one["sensor"], one["architecture"]) == (sensor, architecture)]
            chosen = [one[f"auroc_{one['rule']}"] for one in some]
            cells = [sensor, f"`{architecture}`", str(len(some))]
            cells += [_range([one[name] for one in some], 3) for name in ("auroc_probability", "auroc_distance")]
            cells += [_range(chosen, 3), f"{sum(one['rule'] == 'distance' for one in some)} of {len(some)}"]
            cells += [_range([100 * one[name] for one in some], 1) for name in COUNTED]
            cells += [_range([one[f"calibration_error_{name}"] for one in some], 3) for name in ("before", "after")]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _range(values: list[float], digits: int) -> str:
    low, mean, high = min(values), float(np.mean(values)), max(values)
    return f"{mean:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


if __name__ == "__main__":
    given = sys.argv[1:]
    main(Path(given[0]), Path(given[1] if len(given) > 1 else PLACE), int(given[2]) if len(given) > 2 else DRAWS)
