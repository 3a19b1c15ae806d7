"""Compute the skill of forecasts over persistence, by step and by situation, and the coverage of their quantiles."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.comparison.engine import ComparisonRow
from tacpipe.comparison.runs import MODEL
from tacpipe.metrics import calibration, intervals, pairing
from tacpipe.metrics.calibration import COVERAGE_FILE, Band
from tacpipe.metrics.intervals import Interval
from tacpipe.metrics.pairing import Sums
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, SmallPrint, fold, interval, number, table
from tacpipe.report.charts import Curve
from tacpipe.report.context import Context, band_fold, read_coverage
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.headline import BASELINE, PARTS, Parts
from tacpipe.tasks.forward.report import methods
from tacpipe.tasks.forward.report.methods import ComparedRun, Method
from tacpipe.tasks.forward.situations import LOST, PACE_M_S, SITUATIONS, TURNING_RAD_S, WIDTH_M

if TYPE_CHECKING:
    import pandas as pd


def sums_of_row(row: ComparisonRow, steps: Sequence[int], known_objects: bool | None, group: str = "both") -> Sums:
    """Return the sums of a row's predictor at some steps in a group of channels, by seed and recording."""
    return sums_of_method(row.method, row.predictor.split(" ")[0], steps, known_objects, group)


def sums_of_method(
    method: Method, predictor: str, steps: Sequence[int], known_objects: bool | None, group: str = "both"
) -> Sums:
    """Return the sums of a method's predictor at some steps in a group of channels, by seed and recording.

    For unseen objects, they are by seed and object.
    """
    parts = []
    for run in method.runs:
        clusters = methods.object_clusters(run.details, known_objects) or {}
        sums = methods.sums_by_recording(run.details, predictor, steps, known_objects, group)
        parts += [((run.seed, clusters.get(name, name)), errors) for name, errors in sums.items()]
    return pairing.add_by_key(parts)


def at_steps(draws: AnyFloats) -> AnyFloats:
    """Return the skill over persistence (draw, step + 1), at each step and overall, from sums (draw, part)."""
    parts = Parts.from_sums(draws)
    return np.hstack([parts.skill, parts.mean_skill[:, None]])


def skill_intervals(sums: Sums) -> Interval:
    """Return the skill over persistence at each step and overall, with intervals."""
    return intervals.skill_of_log_ratio(pairing.value_intervals(sums, lambda draws: np.log1p(-at_steps(draws))))


def _total(sums: Sums) -> Parts:
    return Parts.from_sums(np.sum(list(sums.values()), axis=0))


def mean_absolute(sums: Sums) -> list[float]:
    """Return the mean absolute error at each step."""
    total = _total(sums)
    return [float(value) for value in total.absolute / total.values]


def mean_squared(sums: Sums) -> float:
    """Return the mean squared error over all steps; NaN if there are no sums."""
    if not sums:
        return float("nan")
    total = _total(sums)
    return float((total.squared / total.values).mean())


def skill_cell(intervals: Interval | None, at: int) -> Cell:
    """Return a cell with a value and its interval, or a dash if there is none."""
    if intervals is None:
        return Cell(NONE)
    return blocks.interval(float(intervals.mean[at]), float(intervals.low[at]), float(intervals.high[at]))


SITUATION_NOTE = (
    "The situation of a window follows from its last row and the future rows, by the first rule that applies: no "
    f"contact; closing: the gripper closes by more than {1000 * WIDTH_M:g} mm or contact begins; releasing: it "
    f"opens by more than that or contact ends; slipping: the load falls by more than {100 * LOST:g} % while the "
    f"gripper is still; holding in motion: the hand is faster than {PACE_M_S:g} m/s or {TURNING_RAD_S:g} rad/s; "
    "holding still. Errors are means over all steps and channels. Skill is 1 − mean absolute error / that of "
    "persistence, as the geometric mean over recordings. Intervals are over recordings, for methods with a "
    "single run."
)


def situation_folds(context: Context) -> list[Fold]:
    """Return errors and skill by situation of each method; empty if no result has them."""
    rows: list[list[str | Cell]] = []
    for name in SITUATIONS:
        for method in context.methods:
            scores = skill_in_situation(method, name)
            if scores:
                share = f"{100 * scores['part']:.1f} %"
                skill = interval(scores["skill"], scores["low"], scores["high"])
                errors = (number(scores[BASELINE]), number(scores[MODEL]))
                rows.append([name, method.name, f"{scores['windows']:,.0f}", share, *errors, skill])
    heads = ["situation", "method", "windows", "of persistence's error", "MAE of persistence", "MAE", "skill"]
    if not rows:
        return []
    return fold("By situation", table("Errors by situation", heads, rows), SmallPrint(SITUATION_NOTE))


def skill_in_situation(method: Method, situation: str) -> dict[str, float] | None:
    """Return windows, errors, skill and the fraction of persistence's error in a situation, pooled over runs.

    Skill is weighted by windows; for a single run it has an interval. None if no run has skill in the situation.
    """
    trees = [run.details.metrics.situations for run in method.runs]
    selected = [part[situation] for part in trees if situation in part and "mean" in part[situation]["skill"]]
    if not selected:
        return None
    weights = [float(part["windows"]) for part in selected]

    def mean(values: list[float]) -> float:
        return float(np.average(values, weights=weights))

    parts = itertools.chain.from_iterable(tree.values() for tree in trees)
    total_error = sum(part["windows"] * part["mae_counts"][BASELINE]["mean"] for part in parts)
    persistence_error = mean([part["mae_counts"][BASELINE]["mean"] for part in selected])
    ends = selected[0]["skill"]["mean"] if len(method.runs) == 1 else {}
    return {
        "windows": sum(weights),
        "part": sum(weights) * persistence_error / total_error if total_error else float("nan"),
        BASELINE: persistence_error,
        MODEL: mean([part["mae_counts"][MODEL]["mean"] for part in selected]),
        "skill": mean([part["skill"]["mean"]["mean"] for part in selected]),
        "low": float(ends.get("low", np.nan)),
        "high": float(ends.get("high", np.nan)),
    }


EXAMPLES = "bands.json"
NAMES = {
    "model": "quantiles of the model",
    "model_unconditional": "model, one band for all windows",
    "persistence": "persistence, quantiles of its errors",
}
SHOWN = (1, 5, 10)  # steps of the table
EXPLAINED = (
    "A band has its nominal coverage if it is on the dashed line; shaded: 95 % intervals over recordings. The "
    "narrowest band with the correct coverage is best, as measured by the pinball loss (lower is better)."
)


def band_folds(context: Context) -> list[Fold]:
    """Return folds on the quality of quantiles of calibrated models, or an empty list if there are none."""
    runs = [run for run in context.runs if COVERAGE_FILE in run.details.dataset.files]
    if not runs:
        return []
    levels = sorted({tuple(run.details.metrics.quantiles.description["levels"]) for run in runs})[0]
    level = (levels[-1] - levels[0]) / 100
    methods = sorted({run.method for run in runs})
    drawn: list[Chart] = []
    rows: list[Sequence[Any]] = []
    for method in methods:
        fresh = _fresh_rows([run for run in runs if run.method == method])
        for known_objects in (True, False):
            rows_of_part = fresh[fresh.known == known_objects]
            if len(rows_of_part):
                title = " · ".join(filter(None, (method if len(methods) > 1 else "", PARTS[known_objects])))
                bands = calibration.measure_bands(rows_of_part, "step", "unit", BASELINE)
                drawn.append(_coverage_chart(title, bands, level))
                rows += _coverage_rows(title, bands)
    heads = ("", "step", "recordings", "coverage", "width", "pinball loss", "pinball loss below persistence's (%)")
    examples = [Charts(_example_charts(runs[0]))] if EXAMPLES in runs[0].details.dataset.files else []
    return band_fold(levels, drawn, EXPLAINED, heads, rows, *examples)


Bands = Mapping[tuple[Any, str], Band]  # (step, predictor) -> band


def _fresh_rows(runs: Sequence[ComparedRun]) -> pd.DataFrame:
    """Return the sums of recordings that the model was not trained on: one row per run, predictor, recording and step.

    The column ``unit`` has the clusters of intervals: recordings, or objects if these are unseen.
    """
    coverage = read_coverage([run.dataset for run in runs])
    assert coverage is not None, "each run has a coverage file"
    coverage["unit"] = coverage["recording"].where(coverage["known"] | coverage["object"].isna(), coverage["object"])
    return coverage[~coverage.seen]


def _coverage_chart(title: str, bands: Bands, level: float) -> Chart:
    """Return a chart of coverage by step of each predictor, with its interval over recordings."""
    lines = []
    for name in NAMES:
        coverage = {step: band.coverage for (step, predictor), band in sorted(bands.items()) if predictor == name}
        if coverage:
            mean, low, high = np.array(list(coverage.values())).T
            low, high = (np.where(np.isnan(ends), mean, ends) for ends in (low, high))
            lines.append(Curve(NAMES[name], np.array(list(coverage), float), mean, low, high, dashed=name != "model"))
    spec = charts.lines(lines, "rows ahead", "coverage", level=("asked for", level))
    return Chart(f"Coverage: {title}", spec)


def _coverage_rows(title: str, bands: Bands) -> list[Sequence[Any]]:
    """Return the rows of the table, one per predictor and step."""
    rows: list[Sequence[Any]] = []
    for name in NAMES:
        for step in (step for step in SHOWN if (step, name) in bands):
            band = bands[step, name]
            measured = (band.coverage[0], band.width, band.pinball, 100 * band.gain[0])
            rows.append([f"{title}: {NAMES[name]}", f"t+{step}", str(band.clusters), *map(number, measured)])
    return rows


def _example_charts(run: ComparedRun) -> list[Chart]:
    """Return a chart with a forecast, its band and the measurement for each recording that the evaluation stored."""
    drawn = []
    for example in json.loads(run.details.dataset.files[EXAMPLES]):
        levels = sorted((int(name[1:]), name) for name in example if name.startswith("q"))
        low, middle, high = (example[levels[at][1]] for at in (0, len(levels) // 2, -1))
        time_s = np.array(example["t_s"]) - example["t_s"][0]
        lines = [
            Curve("measured", time_s, example["measured"]),
            Curve(f"predicted {example['step']} rows before", time_s, middle, low, high, dashed=True),
        ]
        spec = charts.lines(
            lines, "time (s)", f"{headline.unit_of_model(run.details.config)} above rest", points=False, height=190
        )
        drawn.append(Chart(f"{example['recording']}: {example['channel']}", spec, wide=True))
    return drawn
