"""Report quantiles of predicted touch: coverage by target and electrode, on known and novel objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.channels import biotac_sp
from tacpipe.metrics import calibration
from tacpipe.metrics.calibration import Band
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, number
from tacpipe.report.charts import Dot
from tacpipe.report.context import band_fold, read_coverage
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.headline import CONSTANT, MODEL, OBJECT_MEAN
from tacpipe.tasks.touch.report import figures
from tacpipe.tasks.touch.report.methods import FINGER_NAMES, Method, describe_split, ordered_splits

if TYPE_CHECKING:
    import pandas as pd

NAMES = {MODEL: "model", CONSTANT: "constant", OBJECT_MEAN: "mean of the object"}
EXPLAINED = (
    "A band has its nominal coverage if it is on the dashed line. Intervals are over grasps of known objects, "
    "and over novel objects. The baselines have the quantiles of their training errors. The narrowest band with "
    "the correct coverage is best, as measured by the pinball loss (lower is better)."
)
ELECTRODES = "Coverage in percent. Blue: above the nominal coverage; orange: below."
STRONGEST = 0.2  # coverage error with the most saturated colour


def quantile_folds(methods: Sequence[Method]) -> list[Fold]:
    """Return sections on the quality of quantiles of calibrated models; empty if there are none."""
    folds: list[Fold] = []
    has_several_splits = len(ordered_splits([run for method in methods for run in method.details])) > 1
    for method in methods:
        coverage_rows = read_coverage([run.dataset for run in method.runs])
        if coverage_rows is None:
            continue
        levels = method.details[0].config["quantiles"]["levels"]
        level = (levels[-1] - levels[0]) / 100
        rows_by_known = {known: coverage_rows[coverage_rows.known == known] for known in (True, False)}
        evaluated = [(known_objects, rows) for known_objects, rows in rows_by_known.items() if len(rows)]
        heads = (
            "",
            "values",
            "coverage",
            "width (% of the range)",
            "pinball loss (counts)",
            "below the constant's (%)",
        )
        electrode_charts = [_electrode_chart(rows, known_objects, level) for known_objects, rows in evaluated]
        split = str(method.settings["split"]), bool(method.settings["simulated"])
        folds += band_fold(
            levels,
            [_coverage_chart(rows, known_objects, level) for known_objects, rows in evaluated],
            EXPLAINED,
            heads,
            [row for known_objects, rows in evaluated for row in _coverage_rows(rows, known_objects)],
            Charts([chart for chart in electrode_charts if chart]),
            blocks.notes(ELECTRODES),
            about=method.name + (f", {describe_split(*split)}" if has_several_splits else ""),
        )
    return folds


def measure_bands(rows: pd.DataFrame, known_objects: bool) -> dict[tuple[str, str], Band]:
    """Return the measures of each predictor's band on each target, over known or novel objects."""
    return calibration.measure_bands(rows, "target", "recording" if known_objects else "object", CONSTANT)


def coverage_by_electrode(rows: pd.DataFrame, target: str) -> AnyFloats:
    """Return the fraction of grasps whose value is in the model's band, for each electrode of a finger (electrode,)."""
    model_rows = rows[(rows.target == target) & (rows.predictor == MODEL)]
    coverage: AnyFloats = model_rows.groupby("value")["covered"].mean().sort_index().to_numpy(float)
    return coverage


def _coverage_chart(rows: pd.DataFrame, known_objects: bool, nominal: float) -> Chart:
    """Return a chart of the coverage of each predictor on each target."""
    bands = measure_bands(rows, known_objects)
    targets = [name for name in headlines.TARGETS if (name, MODEL) in bands]
    dots = []
    for target in targets:
        for predictor in (name for name in NAMES if (target, name) in bands):
            kind = "model" if predictor == MODEL else "baseline"
            panel = headlines.TARGETS[target]
            dots.append(Dot(NAMES[predictor], *bands[target, predictor].coverage, kind=kind, panel=panel))
    level = {headlines.TARGETS[target]: nominal for target in targets}
    return Chart(f"Coverage: {headlines.PARTS[known_objects]}", charts.ranking(dots, "coverage", level=level, row=18))


def _coverage_rows(rows: pd.DataFrame, known_objects: bool) -> list[Sequence[str | Cell]]:
    """Return the table rows, one per target and predictor."""
    bands = measure_bands(rows, known_objects)
    rows_shown: list[Sequence[str | Cell]] = []
    for target in (name for name in headlines.TARGETS if (name, MODEL) in bands):
        low_count, high_count = biotac_sp.RANGES[target]
        for predictor in (item for item in NAMES if (target, item) in bands):
            item = bands[target, predictor]
            rows_shown.append(
                [
                    f"{headlines.PARTS[known_objects]}, {headlines.TARGETS[target]}: {NAMES[predictor]}",
                    f"{item.values:,}",
                    _interval_cell(item.coverage, 2),
                    number(100 * item.width / (high_count - low_count), 3),
                    number(item.pinball, 3),
                    Cell(NONE) if predictor == CONSTANT else _interval_cell([100 * part for part in item.gain], 0),
                ]
            )
    return rows_shown


def _interval_cell(values: Sequence[float], digits: int) -> Cell:
    """Return a cell with a number and its interval below, if defined."""
    mean, low, high = values
    below = "" if np.isnan(low) else f"{blocks.fixed(low, digits)} to {blocks.fixed(high, digits)}"
    return Cell(blocks.fixed(mean, digits), below, mean)


def _electrode_chart(rows: pd.DataFrame, known_objects: bool, nominal: float) -> Chart | None:
    """Return a chart of the coverage of each electrode on the fingertips; None if there are no electrodes."""
    tips: list[charts.DataRow] = []
    for target in (finger for finger in figures.FINGERS if (rows.target == finger).any()):
        coverage = coverage_by_electrode(rows, target)
        strength = np.clip((coverage - nominal) / STRONGEST, -1, 1)
        texts = [f"{100 * value:.0f}" for value in coverage]
        tips += figures.fingertip(FINGER_NAMES[target], strength, texts, "Coverage (%)")
    if not tips:
        return None
    grasps = rows["recording"].nunique()
    caption = f"{blocks.counted(grasps, 'grasps')}; nominal coverage {100 * nominal:.0f} %."
    return Chart(
        f"Coverage of each electrode, {headlines.PARTS[known_objects]}", figures.draw_fingertips(tips), caption
    )
