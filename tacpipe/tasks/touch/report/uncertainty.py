"""What the page states of quantiles of predicted touch: coverage, by target and electrode, of known and novel objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.channels import biotac_sp
from tacpipe.comparison.runs import Method
from tacpipe.io.parquet import from_parquet
from tacpipe.metrics import intervals
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, fold, number, table
from tacpipe.report.charts import Dot
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.report import electrodes, wording
from tacpipe.tasks.touch.report import methods as by_method
from tacpipe.tasks.touch.result_names import CONSTANT, COVERAGE, MODEL, OBJECT_MEAN

if TYPE_CHECKING:
    import pandas as pd

NAMES = {MODEL: "model", CONSTANT: "constant", OBJECT_MEAN: "mean of the object"}
EXPLAINED = (
    "A band holds as often as it states if its coverage lies on the dashed line. Intervals are over grasps of known "
    "objects, and over novel objects; the baselines have the quantiles of their own errors in training. The narrowest "
    "band of the right coverage is best, which the pinball loss measures (lower is better)."
)
ELECTRODES = "Coverage in percent. Blue: more than asked for; orange: less."
STRONGEST = 0.2  # difference of coverage that has the strongest colour


@dataclass(frozen=True)
class Measured:
    """A predictor's band on one target."""

    values: int
    coverage: tuple[float, float, float]  # with its 95 % interval
    width: float  # counts
    pinball: float  # counts
    gain: tuple[float, float, float]  # 1 - pinball / pinball of the constant, with its 95 % interval


def folds(methods: Sequence[Method]) -> list[Fold]:
    """Return how good quantiles are, of calibrated models; nothing without any."""
    found: list[Fold] = []
    several = len(by_method.splits([one for method in methods for one in method.details])) > 1
    for method in methods:
        read = _read(method)
        if read is None:
            continue
        levels = method.details[0].metrics["quantiles"]["levels"]
        asked = (levels[-1] - levels[0]) / 100
        parts = [(known, read[read.known == known]) for known in (True, False)]
        held = [(known, rows) for known, rows in parts if len(rows)]
        title = f"Bands from the {levels[0]} to the {levels[-1]} % quantile"
        heads = (
            "",
            "values",
            "coverage",
            "width (% of the range)",
            "pinball loss (counts)",
            "below the constant's (%)",
        )
        found += fold(
            "Uncertainty",
            Charts([_coverage(rows, known, asked) for known, rows in held]),
            blocks.notes(EXPLAINED),
            table(title, heads, [row for known, rows in held for row in _rows(rows, known)]),
            Charts([one for known, rows in held if (one := _by_electrode(rows, known, asked))]),
            blocks.notes(ELECTRODES),
            about=method.name + (f", {wording.place(*_parted(method))}" if several else ""),
        )
    return found


def measured(rows: pd.DataFrame, known: bool) -> dict[tuple[str, str], Measured]:
    """Return what each predictor's band is worth on each target, of grasps of known objects or of novel ones."""
    found = {}
    for target, same in rows.groupby("target"):
        clustered = same.groupby(["predictor", "recording" if known else "object"])
        sums = clustered[["covered", "pinball"]].sum().join(clustered.size().rename("values"))
        constant = sums.loc[CONSTANT]
        for predictor, one in same.groupby("predictor"):
            own = sums.loc[predictor]
            lost, still = (each["pinball"].to_numpy(float)[:, None] for each in (own, constant))
            gain = intervals.skill_interval(lost, still).first
            share = intervals.share_interval(*(own[[part]].to_numpy(float) for part in ("covered", "values"))).first
            found[str(target), str(predictor)] = Measured(
                len(one),
                share,
                float(one.width.mean()),
                float(one.pinball.mean()),
                gain,
            )
    return found


def by_electrode(rows: pd.DataFrame, target: str) -> AnyFloats:
    """Return the fraction of grasps whose value lies in the model's band, of each electrode of a finger (electrode,)."""
    own = rows[(rows.target == target) & (rows.predictor == MODEL)]
    found: AnyFloats = own.groupby("value")["covered"].mean().sort_index().to_numpy(float)
    return found


def _parted(method: Method) -> tuple[str, bool]:
    """Return how the grasps of a method were parted, and whether they were simulated."""
    return str(method.settings["split"]), bool(method.settings["simulated"])


def _read(method: Method) -> pd.DataFrame | None:
    """Return a row a value, predictor, grasp and run of a method; None where none of its runs is of a calibrated model."""
    import pandas as pd

    files = [one.dataset.files[COVERAGE] for one in method.details if COVERAGE in one.dataset.files]
    return pd.concat([from_parquet(one).to_pandas() for one in files]) if files else None


def _coverage(rows: pd.DataFrame, known: bool, asked: float) -> Chart:
    """Return the coverage of each predictor on each target."""
    found = measured(rows, known)
    targets = [name for name in headlines.TARGETS if (name, MODEL) in found]
    dots = []
    for target in targets:
        for predictor in (one for one in NAMES if (target, one) in found):
            kind = "model" if predictor == MODEL else "baseline"
            panel = headlines.TARGETS[target]
            dots.append(Dot(NAMES[predictor], *found[target, predictor].coverage, kind=kind, panel=panel))
    level = {headlines.TARGETS[target]: asked for target in targets}
    return Chart(f"Coverage: {headlines.PARTS[known]}", charts.ranking(dots, "coverage", level=level, row=18))


def _rows(rows: pd.DataFrame, known: bool) -> list[Sequence[str | Cell]]:
    """Return the rows of the table: a target and predictor each."""
    found = measured(rows, known)
    shown: list[Sequence[str | Cell]] = []
    for target in (name for name in headlines.TARGETS if (name, MODEL) in found):
        low_count, high_count = biotac_sp.RANGES[target]
        for predictor in (one for one in NAMES if (target, one) in found):
            one = found[target, predictor]
            shown.append(
                [
                    f"{headlines.PARTS[known]}, {headlines.TARGETS[target]}: {NAMES[predictor]}",
                    f"{one.values:,}",
                    _with_interval(one.coverage, 2),
                    number(100 * one.width / (high_count - low_count), 3),
                    number(one.pinball, 3),
                    Cell(NONE) if predictor == CONSTANT else _with_interval([100 * part for part in one.gain], 0),
                ]
            )
    return shown


def _with_interval(values: Sequence[float], digits: int) -> Cell:
    """Return a number above its interval, where that is defined."""
    mean, low, high = values
    below = "" if np.isnan(low) else f"{blocks.fixed(low, digits)} to {blocks.fixed(high, digits)}"
    return Cell(blocks.fixed(mean, digits), below, mean)


def _by_electrode(rows: pd.DataFrame, known: bool, asked: float) -> Chart | None:
    """Return the coverage of each electrode on the fingertips; None without electrodes."""
    tips: list[dict[str, object]] = []
    for target in (one for one in electrodes.FINGERS if (rows.target == one).any()):
        found = by_electrode(rows, target)
        strength = np.clip((found - asked) / STRONGEST, -1, 1)
        texts = [f"{100 * value:.0f}" for value in found]
        tips += electrodes.tip(wording.FINGERS[target], strength, texts, "Coverage (%)")
    if not tips:
        return None
    grasps = rows["recording"].nunique()
    caption = f"{blocks.counted(grasps, 'grasps')}; {100 * asked:.0f} % is asked for."
    return Chart(f"Coverage of each electrode, {headlines.PARTS[known]}", electrodes.plane(tips), caption)
