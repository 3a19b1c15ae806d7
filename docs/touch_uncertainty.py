"""Measure the coverage of the quantiles of predicted touch, calibrated on validation grasps.

    python docs/touch_uncertainty.py DATA [FOLDER] [DRAWS]

DATA contains the published sets (data/README.md). In each draw, five folds test all grasps of known objects, and each
object is left out once. Each model is trained, calibrated on grasps outside its training set, and evaluated. The script
prints a table with 95 % intervals over grasps (known objects) and over objects (novel ones). It writes
FOLDER/coverage.parquet with one row per value, predictor, grasp and draw.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tacpipe
from tacpipe.io.parquet import from_parquet
from tacpipe.plugins import given_params, registry
from tacpipe.scores.calibration import COVERAGE_FILE, Band, measure_bands
from tacpipe.tasks.task import CalibrationRequest
from tacpipe.tasks.touch import evaluation as touch_evaluation
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch import model as touch_model
from tacpipe.tasks.touch import training as touch_training
from tacpipe.tasks.touch.headline import CONSTANT, MODEL, OBJECT_MEAN

if TYPE_CHECKING:
    import pandas as pd

    from tacpipe.datasets.dataset import Dataset

OPTIONS: Mapping[str, Any] = {"architecture": "trees", "leaf": 4, "use_validation": False}
FOLDS = 5
SPLITS: Mapping[str, Mapping[str, Any]] = {  # 56 calibration grasps, or 60 if an object is left out
    "known": {"scheme": "kfold", "folds": FOLDS, "stratify": "object", "val": 0.25},
    "novel": {"scheme": "leave-one-out", "by": "object", "val": 0.25, "stratify": "object"},
}
DEFAULT_FOLDER, DRAWS = ".cache/touch-uncertainty", 2
REQUEST = CalibrationRequest((10, 50, 90), promise=False, false_unknown=0.05, seed=0)


def main(data: Path, folder: Path, draws: int) -> None:
    """Run all draws, write their coverage after each fold, and print the table."""
    import pandas as pd

    recordings = tacpipe.run("ingest.vision2tactile", data / "vision2tactile", output=folder / "recordings")
    grasps = tacpipe.run("segment.grasps", recordings, output=folder / "grasps")
    coverages = []
    for draw in range(draws):
        for name, options in SPLITS.items():
            split = tacpipe.run("split", grasps, output=folder / f"{name}-{draw}", seed=draw, **options)
            for fold, parts in _folds(grasps, split):
                coverages.append(_evaluate(parts, draw).assign(draw=draw, fold=fold))
                print(f"draw {draw} {name} fold {fold}", file=sys.stderr, flush=True)
                pd.concat(coverages).to_parquet(folder / COVERAGE_FILE)
    print(table(pd.concat(coverages)))


def _folds(grasps: Dataset, split: Any) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield each fold of a split and its parts by role."""
    count = int(split.recordings["split"].table()["fold"].to_numpy().max()) + 1
    for fold in range(count):
        yield fold, {role: grasps.select(split=split, fold=fold, role=role) for role in ("train", "val", "test")}


def _evaluate(parts: Mapping[str, Any], seed: int) -> pd.DataFrame:
    """Train, calibrate and evaluate a model, and return whether each value of the test grasps is within its band."""
    options = {**OPTIONS, "seed": seed}
    params = given_params.build("train.touch", registry.load("train.touch"), options=options)
    with tempfile.TemporaryDirectory() as workspace:
        model = touch_training.train(params, parts["train"], parts["val"], Path(workspace))
    model = touch_model.calibrate(model, REQUEST, parts["train"], parts["val"])
    coverage: pd.DataFrame = from_parquet(
        touch_evaluation.evaluate(model, parts["test"]).files[COVERAGE_FILE]
    ).to_pandas()
    return coverage


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table with one row per target, for known and for novel objects."""
    heads: tuple[str, ...] = ("objects", "target", "grasps", "coverage", "constant's", "width (counts)", "constant's")
    heads += ("pinball below the constant's", "object's mean below it")
    lines = ["| " + " | ".join(heads) + " |", "| --- " * len(heads) + "|"]
    for known in (True, False):
        values = rows[rows.known == known]
        bands = measure_bands(values, "target", "recording" if known else "object", CONSTANT)
        for target in (name for name in headlines.TARGETS if (name, MODEL) in bands):
            model, constant, mean = (bands[target, name] for name in (MODEL, CONSTANT, OBJECT_MEAN))
            cells = ["known" if known else "novel", f"`{target}`", str(values.recording.nunique())]
            cells += [_coverage(model), _coverage(constant), f"{model.width:.0f}", f"{constant.width:.0f}"]
            cells += [_gain(model), _gain(mean) if known else ""]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _coverage(band: Band) -> str:
    mean, low, high = band.coverage
    return f"{mean:.2f} ({low:.2f} to {high:.2f})"


def _gain(band: Band) -> str:
    mean, low, high = (100 * part for part in band.gain)
    return f"{mean:.0f} % ({low:.0f} to {high:.0f})".replace("-", "\N{MINUS SIGN}")


if __name__ == "__main__":
    arguments = [*sys.argv[1:], *["", DEFAULT_FOLDER, str(DRAWS)][len(sys.argv) - 1 :]]
    main(Path(arguments[0]), Path(arguments[1]), int(arguments[2]))
