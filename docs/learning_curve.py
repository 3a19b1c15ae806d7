"""Measure the benefit of more training recordings to ``forward``: `make learning-curve DATA=FOLDER`.

The script trains on 8, 16, 33 and all training recordings of a random split. Smaller sets are part of larger ones, and
all models are evaluated on the same test recordings. It prints a table of skill over persistence, with its interval over
recordings and its standard deviation over draws of the split. All models train for about the same number of steps, so
smaller sets have more epochs, and the epoch with the smallest validation error is used. The results and the table
``table.csv`` are written to ``.cache/learning-curve``. Stored results are reused.

``DATA`` is a dataset of segments (`tacpipe segment contacts`). Options are ``--sizes 8,16,33,0`` (0: all), ``--draws 10``,
and options of `tacpipe train forward` after ``--``, for example ``-- --members 2``.
"""

from __future__ import annotations

import argparse
import csv
import math
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.scores import intervals

ROOT = Path(__file__).parents[1]
WORK = ROOT / ".cache" / "learning-curve"
STEPS = (1, 5, 10)
PREDICTORS = ("model", "persistence")
FULL_SET = 40  # recordings; smaller sets have more epochs, in inverse proportion to their size
EPOCHS = 6  # epochs for `FULL_SET` or more recordings
# Absolute errors (2, step + 1) of model and persistence by recording; the last column is the number of values.
Sums = dict[str, AnyFloats]


class Point(NamedTuple):
    """Point of the learning curve."""

    trained: float  # number of training recordings, mean over draws
    tested: int  # number of test recordings, each counted once
    skill: Sequence[tuple[float, float, float]]  # (mean, low, high) per step in `STEPS`
    mae: Sequence[float]  # per step, in the channels' unit
    spread: Sequence[float]  # standard deviation of the skill over draws; NaN for one draw


def point(draws: Sequence[Sums], trained: float) -> Point:
    """Return the point of the curve for the error sums of each draw.

    The skill is that of `tacpipe evaluate`: 1 - the geometric mean over recordings of the ratio of the model's absolute
    error to that of persistence. The errors of a recording are summed over all draws that test it.
    """
    names = sorted({name for draw in draws for name in draw})
    pooled = np.stack([np.sum([draw[name] for draw in draws if name in draw], axis=0) for name in names])
    interval = _skill(pooled)
    skill = [(float(mean), float(low), float(high)) for mean, low, high in zip(*vars(interval).values(), strict=True)]
    total = pooled[:, 0].sum(axis=0)
    by_draw = [_skill(np.stack(list(draw.values()))).mean for draw in draws]
    spread = np.std(by_draw, axis=0, ddof=1) if len(draws) > 1 else np.full(len(STEPS), np.nan)
    return Point(trained, len(names), skill, (total[:-1] / total[-1]).tolist(), spread.tolist())


def _skill(errors: AnyFloats) -> intervals.Interval:
    """Return the skill at each step in `STEPS`, from error sums (recording, 2, step + 1)."""
    return intervals.geometric_skill_interval(errors[:, 0, :-1], errors[:, 1, :-1])


def per_doubling(points: Sequence[Point], step: int) -> float:
    """Return the increase in skill per doubling of the recordings at the step with this index in `STEPS`, by least squares.

    >>> curve = [Point(size, 10, [(skill, 0, 0)], [0], [0]) for size, skill in ((8, 0.1), (16, 0.15), (32, 0.2))]
    >>> round(per_doubling(curve, 0), 3)
    0.05
    """
    x = np.log2([point.trained for point in points])
    return float(np.polyfit(x, [point.skill[step][0] for point in points], 1)[0])


def sums(result: Path) -> Sums:
    """Return the error sums of each test recording of a result at `STEPS`, over all channels."""
    import pyarrow.parquet as pq

    table = pq.read_table(result / "errors.parquet").to_pylist()
    by_recording: Sums = {}
    for row in table:
        if row["seen"] or row["group"] != "both" or row["step"] not in STEPS or not row["windows"]:
            continue
        if row["predictor"] in PREDICTORS:
            errors = by_recording.setdefault(row["recording"], np.zeros((2, len(STEPS) + 1)))
            values = errors[PREDICTORS.index(row["predictor"])]
            values[STEPS.index(row["step"])], values[-1] = row["absolute"], row["windows"] * row["channels"]
    return by_recording


def run(*words: object) -> None:
    """Run a tacpipe command. Raises `SystemExit` if it fails."""
    command = [str(Path(sys.executable).parent / "tacpipe"), *map(str, words), "--quiet"]
    if subprocess.run(command, check=False).returncode:
        raise SystemExit(f"{' '.join(command)} failed; its message is above.")


def measure(data: Path, size: int, draws: int, options: Sequence[str]) -> Point:
    """Train and evaluate on at most ``size`` recordings (0: all) in each draw, and return the point of the curve."""
    import pyarrow.parquet as pq

    draw_sums, counts = [], []
    for draw in range(draws):
        name = f"{size}-{draw}"
        split, model, result = (WORK / part / name for part in ("splits", "models", "results"))
        few = ["--few", size] if size else []
        scheme = ["--scheme", "random", "--test", 0.2, "--val", 0.1, "--seed", draw]
        run("split", data, "-o", split, *scheme, *few, "--replace")
        roles = pq.read_table(split / "split.parquet").to_pydict()["role"]
        counts.append(roles.count("train"))
        epochs = math.ceil(EPOCHS * FULL_SET / min(counts[-1], FULL_SET))
        schedule = ["--seed", draw, "--epochs", epochs, "--stride", 2, "--no-baselines", *options, "--replace"]
        run("train", "forward", data, "--split", split, "-o", model, *schedule)
        run("evaluate", model, data, "--split", split, "-o", result, "--replace")
        draw_sums.append(sums(result))
    return point(draw_sums, float(np.mean(counts)))


def rows(points: Sequence[Point]) -> list[Mapping[str, str]]:
    """Return the table, one row per point."""
    return [
        {
            "trained": f"{point.trained:g}",
            "tested": f"{point.tested}",
            **{
                f"skill t+{step}": f"{mean:+.3f} ({low:+.3f} to {high:+.3f})"
                for step, (mean, low, high) in zip(STEPS, point.skill, strict=True)
            },
            **{f"over draws t+{step}": f"{value:.3f}" for step, value in zip(STEPS, point.spread, strict=True)},
            **{f"MAE t+{step}": f"{value:.2f}" for step, value in zip(STEPS, point.mae, strict=True)},
        }
        for point in points
    ]


def main(arguments: Sequence[str]) -> None:
    """Measure, print and write the curve."""
    script_arguments, _, options = " ".join(arguments).partition(" -- ")
    parser = argparse.ArgumentParser(description="Measure the benefit of more training recordings to forward.")
    parser.add_argument("data", type=Path, help="dataset of segments")
    parser.add_argument(
        "--sizes", default="8,16,33,0", help="numbers of training recordings, a comma-separated list; 0: all"
    )
    parser.add_argument("--draws", type=int, default=10, help="number of draws of the split")
    args = parser.parse_args(script_arguments.split())
    sizes = [int(size) for size in args.sizes.split(",")]
    points = [measure(args.data, size, args.draws, options.split()) for size in sizes]
    table = rows(points)
    with (WORK / "table.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    for row in table:
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    for index, step in enumerate(STEPS):
        increase, largest = per_doubling(points, index), points[-1].trained
        extrapolated = increase * math.log2((largest + 50) / largest)
        print(
            f"t+{step}: skill {increase:+.3f} per doubling; 50 recordings more than {largest:g} would add "
            f"{extrapolated:+.3f} (extrapolated)"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
