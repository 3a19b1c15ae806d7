"""How well quantiles of predicted touch hold: calibrated on validation grasps, several draws of the published grasps.

    python docs/touch_uncertainty.py DATA [FOLDER] [DRAWS]

DATA holds the published sets (data/README.md). In each draw five folds test all grasps of known objects, and each object is
left out once: a model is trained, calibrated on grasps that it did not learn from, and evaluated. Prints a table with 95 %
intervals over grasps (known objects) and over objects (novel ones), and writes FOLDER/coverage.parquet with a row a value,
predictor, grasp and draw.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tacpipe
from tacpipe.io.parquet import from_parquet
from tacpipe.metrics.calibration import COVERAGE_FILE, Band
from tacpipe.plugins import given_params, registry
from tacpipe.tasks.task import CalibrationRequest
from tacpipe.tasks.touch import evaluation as touch_evaluation
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch import model as touch_model
from tacpipe.tasks.touch import training as touch_training
from tacpipe.tasks.touch.headline import CONSTANT, MODEL, OBJECT_MEAN
from tacpipe.tasks.touch.report.quantiles import measure_bands

if TYPE_CHECKING:
    import pandas as pd

    from tacpipe.datasets.dataset import Dataset

OPTIONS: Mapping[str, Any] = {"architecture": "trees", "leaf": 4, "use_validation": False}
FOLDS = 5
SPLITS: Mapping[str, Mapping[str, Any]] = {  # calibrated on 56 grasps, on 60 where an object is left out
    "known": {"scheme": "kfold", "folds": FOLDS, "stratify": "object", "val": 0.25},
    "novel": {"scheme": "leave-one-out", "by": "object", "val": 0.25, "stratify": "object"},
}
PLACE, DRAWS = ".cache/touch-uncertainty", 2
ASKED = CalibrationRequest((10, 50, 90), promise=False, false_unknown=0.05, seed=0)


def main(data: Path, folder: Path, draws: int) -> None:
    """Run all draws, then print and write what they gave."""
    import pandas as pd

    given = tacpipe.run("ingest.vision2tactile", data / "vision2tactile", output=folder / "recordings")
    grasps = tacpipe.run("segment.grasps", given, output=folder / "grasps")
    parts = []
    for draw in range(draws):
        for name, options in SPLITS.items():
            split = tacpipe.run("split", grasps, output=folder / f"{name}-{draw}", seed=draw, **options)
            for fold, one in _folds(grasps, split):
                parts.append(_evaluated(one, draw).assign(draw=draw, fold=fold))
                print(f"draw {draw} {name} fold {fold}", file=sys.stderr, flush=True)
                pd.concat(parts).to_parquet(folder / COVERAGE_FILE)
    print(table(pd.concat(parts)))


def _folds(grasps: Dataset, split: Any) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield each fold of a split and its parts by role."""
    count = int(split.recordings["split"].table()["fold"].to_numpy().max()) + 1
    for fold in range(count):
        yield fold, {role: grasps.select(split=split, fold=fold, role=role) for role in ("train", "val", "test")}


def _evaluated(parts: Mapping[str, Any], seed: int) -> pd.DataFrame:
    """Return each value of the test grasps of one fold, and whether it lies in its band."""
    options = {**OPTIONS, "seed": seed}
    params = given_params.build("train.touch", registry.load("train.touch"), options=options)
    with tempfile.TemporaryDirectory() as workspace:
        model = touch_training.train(params, parts["train"], parts["val"], Path(workspace))
    model = touch_model.calibrate(model, ASKED, parts["train"], parts["val"])
    found: pd.DataFrame = from_parquet(touch_evaluation.evaluate(model, parts["test"]).files[COVERAGE_FILE]).to_pandas()
    return found


def table(rows: pd.DataFrame) -> str:
    """Return a table in Markdown: a row a target, for known objects and for novel ones."""
    heads: tuple[str, ...] = ("objects", "target", "grasps", "coverage", "constant's", "width (counts)", "constant's")
    heads += ("pinball below the constant's", "object's mean below it")
    lines = ["| " + " | ".join(heads) + " |", "| --- " * len(heads) + "|"]
    for known in (True, False):
        some = rows[rows.known == known]
        found = measure_bands(some, known)
        for target in (name for name in headlines.TARGETS if (name, MODEL) in found):
            model, constant, mean = (found[target, name] for name in (MODEL, CONSTANT, OBJECT_MEAN))
            cells = ["known" if known else "novel", f"`{target}`", str(some.recording.nunique())]
            cells += [_coverage(model), _coverage(constant), f"{model.width:.0f}", f"{constant.width:.0f}"]
            cells += [_gain(model), _gain(mean) if known else ""]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _coverage(one: Band) -> str:
    mean, low, high = one.coverage
    return f"{mean:.2f} ({low:.2f} to {high:.2f})"


def _gain(one: Band) -> str:
    mean, low, high = (100 * part for part in one.gain)
    return f"{mean:.0f} % ({low:.0f} to {high:.0f})".replace("-", "\N{MINUS SIGN}")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(Path(given[0]), Path(given[1] if len(given) > 1 else PLACE), int(given[2]) if len(given) > 2 else DRAWS)
