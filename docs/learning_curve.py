"""Measure what more recordings are worth to ``forward``: `make learning-curve DATA=FOLDER`.

Trains on 8, 16, 33 and all training recordings of a random split, each smaller set being part of the larger ones, evaluates
on the same test recordings, and prints a table of skill over persistence, with its interval over recordings and its
standard deviation over draws of the split. Each model makes about as many steps, so fewer recordings have more epochs, and
the best epoch on the validation recordings counts. Results lie in ``.cache/learning-curve``: what is there is not computed
again. The table is ``docs/tasks/forward-learning.csv``.

``DATA`` is a dataset of segments (`tacpipe segment contacts`). Options are ``--sizes 8,16,33,0``, 0 being all, ``--draws
10``, and those of `tacpipe train forward` behind ``--``, as ``-- --members 2``.
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
from tacpipe.metrics import intervals

ROOT = Path(__file__).parents[1]
WORK, TABLE = ROOT / ".cache" / "learning-curve", ROOT / "docs" / "tasks" / "forward-learning.csv"
STEPS = (1, 5, 10)
PREDICTORS = ("model", "persistence")
EPOCHS = 6  # on `MOST` recordings or more
MOST = 40  # recordings on which `EPOCHS` are made; of fewer, as many more epochs
# By recording, absolute errors of model and persistence, shape (2, step + 1); the last column counts the values.
Sums = dict[str, AnyFloats]


class Point(NamedTuple):
    """A point of the curve."""

    trained: float  # recordings trained on, mean over draws
    tested: int  # recordings tested on, each counted once
    skill: Sequence[tuple[float, float, float]]  # of each of `STEPS`: mean, low, high
    mae: Sequence[float]  # of the model, in the channels' unit
    spread: Sequence[float]  # standard deviation of the skill over draws, NaN of one draw


def point(draws: Sequence[Sums], trained: float) -> Point:
    """Return skill with its interval and mean absolute errors, from the error sums of recordings in each draw.

    The skill is that of `tacpipe evaluate`: 1 - the geometric mean over recordings of the model's absolute error divided by
    persistence's. A recording that several draws test counts once, with the sum of its errors.
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
    """Return the skill at each of `STEPS` of error sums (recording, 2, step + 1)."""
    return intervals.geometric_skill_interval(errors[:, 0, :-1], errors[:, 1, :-1])


def per_doubling(points: Sequence[Point], step: int) -> float:
    """Return by how much skill rises with each doubling of recordings at a place in `STEPS`: least squares on the logarithm.

    >>> curve = [Point(size, 10, [(skill, 0, 0)], [0], [0]) for size, skill in ((8, 0.1), (16, 0.15), (32, 0.2))]
    >>> round(per_doubling(curve, 0), 3)
    0.05
    """
    x = np.log2([one.trained for one in points])
    return float(np.polyfit(x, [one.skill[step][0] for one in points], 1)[0])


def sums(result: Path) -> Sums:
    """Return the error sums of each recording of a result at `STEPS`, over all channels."""
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
    """Run a command of tacpipe; raises `SystemExit` where it fails."""
    command = [str(Path(sys.executable).parent / "tacpipe"), *map(str, words), "--quiet"]
    if subprocess.run(command, check=False).returncode:
        raise SystemExit(f"{' '.join(command)} failed; its message is above.")


def measured(data: Path, size: int, draws: int, options: Sequence[str]) -> Point:
    """Return the point of the curve where at most ``size`` recordings are trained on, 0 for all."""
    import pyarrow.parquet as pq

    found, counts = [], []
    for draw in range(draws):
        name = f"{size}-{draw}"
        split, model, result = (WORK / part / name for part in ("splits", "models", "results"))
        few = ["--few", size] if size else []
        run(
            "split",
            data,
            "-o",
            split,
            "--scheme",
            "random",
            "--test",
            0.2,
            "--val",
            0.1,
            "--seed",
            draw,
            *few,
            "--replace",
        )
        roles = pq.read_table(split / "split.parquet").to_pydict()["role"]
        counts.append(roles.count("train"))
        epochs = math.ceil(EPOCHS * MOST / min(counts[-1], MOST))
        chosen = ["--seed", draw, "--epochs", epochs, "--stride", 2, "--no-baselines", *options, "--replace"]
        run("train", "forward", data, "--split", split, "-o", model, *chosen)
        run("evaluate", model, data, "--split", split, "-o", result, "--replace")
        found.append(sums(result))
    return point(found, float(np.mean(counts)))


def rows(points: Sequence[Point]) -> list[Mapping[str, str]]:
    """Return the table: a row a point."""
    return [
        {
            "trained": f"{one.trained:g}",
            "tested": f"{one.tested}",
            **{
                f"skill t+{step}": f"{mean:+.3f} ({low:+.3f} to {high:+.3f})"
                for step, (mean, low, high) in zip(STEPS, one.skill, strict=True)
            },
            **{f"over draws t+{step}": f"{value:.3f}" for step, value in zip(STEPS, one.spread, strict=True)},
            **{f"MAE t+{step}": f"{value:.2f}" for step, value in zip(STEPS, one.mae, strict=True)},
        }
        for one in points
    ]


def main(given: Sequence[str]) -> None:
    """Measure, print and write the curve."""
    own, _, options = " ".join(given).partition(" -- ")
    parser = argparse.ArgumentParser(description="Measure what more recordings are worth to forward.")
    parser.add_argument("data", type=Path, help="dataset of segments")
    parser.add_argument("--sizes", default="8,16,33,0", help="training recordings, with commas between; 0: all")
    parser.add_argument("--draws", type=int, default=10, help="draws of the split")
    asked = parser.parse_args(own.split())
    sizes = [int(one) for one in asked.sizes.split(",")]
    points = [measured(asked.data, size, asked.draws, options.split()) for size in sizes]
    table = rows(points)
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    for row in table:
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    for at, step in enumerate(STEPS):
        rise, most = per_doubling(points, at), points[-1].trained
        more = rise * math.log2((most + 50) / most)
        print(
            f"t+{step}: skill {rise:+.3f} with each doubling; 50 more than {most:g} would add {more:+.3f}, extrapolated"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
