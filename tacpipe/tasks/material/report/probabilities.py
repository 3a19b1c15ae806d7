"""Report calibrated classifiers: reliability of their probabilities, and the answer ``unknown``."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.metrics import calibration, headline
from tacpipe.metrics.intervals import share_interval, wilson
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Block, Cell, Chart, Charts, Fold, fold, number, table
from tacpipe.report.charts import Curve
from tacpipe.tasks.material.report.methods import Method, runs_on, sensor_title, sensors_of

ANSWERS = "answers.csv"
UNKNOWN = "unknown"  # answer for a slide that resembles no learned material
MIN_BIN_COUNT = 20  # minimum number of answers per bin of predicted probability
RATES = np.linspace(0, 1, 101)  # false-unknown rates at which curves are averaged over runs
RELIABLE = (
    "Accuracy against predicted probability, in bins with equal numbers of slides. On the thin line, "
    "probabilities equal frequencies. Before calibration: bins of equal width. Shaded: 95 % intervals (Wilson) "
    "over slides, each counted once."
)
TABLE = (
    "False unknown: slides of known materials classified as unknown. False known: slides of left-out materials "
    "assigned to a class. Right: accuracy among the assigned slides of known materials. 95 % intervals are "
    "Wilson's over slides, each counted once, and for false known over materials, if there are six or more. "
    "Calibration error, log loss and AUROC are means over runs."
)
REFUSED = (
    "Each threshold classifies some slides of known materials and some slides of left-out materials as unknown. "
    "On the thin line, the score has no information. Diamonds: the threshold that calibration set without slides "
    "of unknown materials. Shaded: from the lowest to the highest run."
)


class Rate(NamedTuple):
    """Fraction of slides with its 95 % Wilson interval; a slide counts once, however many runs classified it."""

    fraction: float
    low: float
    high: float
    slides: int


def probability_folds(methods: Sequence[Method]) -> list[Fold]:
    """Return reliability charts and curves of unknown for calibrated models; empty if there are none."""
    reliable, refused, rows = [], [], []
    for sensor in sensors_of(methods):
        calibrated = [(method, answers) for method in methods if (answers := read_answers(method, sensor)) is not None]
        reliable += [
            _reliability_chart(f"{sensor_title(sensor)}: {method.name}", method, sensor, answers)
            for method, answers in calibrated
        ]
        curves = [(method.name, answers) for method, answers in calibrated if {True, False} <= set(answers.known)]
        refused += [_unknown_chart(sensor_title(sensor), curves)] if curves else []
        rows += [_table_row(method, sensor, answers) for method, answers in calibrated]
    heads = (
        "",
        "slides",
        "calibration error",
        "log loss",
        "false unknown (%)",
        "false known (%)",
        "AUROC",
        "right (%)",
    )
    if not rows:
        return []
    parts: list[Block] = [Charts(reliable), blocks.notes(RELIABLE)]
    parts += [Charts(refused), blocks.notes(REFUSED)] if refused else []
    return fold("Uncertainty", *parts, table("Probabilities and the answer unknown", heads, rows), blocks.notes(TABLE))


def read_answers(method: Method, sensor: str) -> pd.DataFrame | None:
    """Return the answers of calibrated runs for a sensor's slides, one row per unseen slide and run.

    Columns: ``run``, ``recording``, ``known`` (whether its material was learned), ``right``, ``probability``, ``score``
    and ``refused`` (answered unknown). None if no run has a calibrated model.
    """
    parts = []
    for index, run in enumerate(runs_on(method, sensor)):
        files = run.details.dataset.files
        if ANSWERS not in files:
            continue
        text = dict.fromkeys(("recording", "sensor", "named", "answer", "label"), str)
        answers = pd.read_csv(io.BytesIO(files[ANSWERS]), dtype=text, keep_default_na=False)
        answers = answers[(answers.sensor == sensor) & ~answers.seen]
        rows = run.details.predictions.of(sensor)
        truth = dict(zip(rows.recordings.tolist(), map(str, rows.named(rows.materials).tolist()), strict=True))
        is_counted = answers.recording.isin(truth) | ~answers.known  # known materials: slides as elsewhere on the page
        answers = answers[is_counted].assign(run=index, refused=answers.answer == UNKNOWN)
        parts.append(answers.assign(right=answers.named == answers.recording.map(truth)))
    return pd.concat(parts) if parts else None


def rate_of(rows: pd.DataFrame, column: str) -> Rate:
    """Return the fraction of slides for which a column is true, with Wilson's interval; NaN if there are none."""
    if not len(rows):
        return Rate(float("nan"), float("nan"), float("nan"), 0)
    slides = rows.recording.nunique()
    fraction = float(rows[column].mean())
    return Rate(fraction, *wilson(round(fraction * slides), slides), slides)


def rate_over_materials(rows: pd.DataFrame, column: str) -> Rate:
    """Return the fraction of slides of unknown materials for which a column is true, with its interval over materials.

    The bounds are NaN for fewer than `headline.MIN_CLUSTERS` materials, and in results without their names.
    """
    if "label" not in rows or rows.label.nunique() < headline.MIN_CLUSTERS:
        return rate_of(rows, column)._replace(low=float("nan"), high=float("nan"))
    interval = share_interval(rows[[column]].to_numpy(float), np.ones((len(rows), 1)), rows.label.to_numpy(str)).first
    return Rate(*interval, rows.recording.nunique())


def unknown_curve(known_scores: AnyFloats, unknown: AnyFloats) -> Floats:
    """Return the fraction of unknown slides below the thresholds at which the fractions `RATES` of known ones are (rate,).

    ``known_scores`` and ``unknown`` are scores (slide,). The curve is linear between thresholds, as for the area under
    it.
    """
    ends = np.r_[-np.inf, np.unique(np.concatenate([known_scores, unknown])), np.inf]
    refused_known, refused_unknown = (
        np.searchsorted(np.sort(scores), ends, side="left") / len(scores) for scores in (known_scores, unknown)
    )
    return np.interp(RATES, refused_known, np.maximum.accumulate(refused_unknown))


def _reliability_chart(title: str, method: Method, sensor: str, answers: pd.DataFrame) -> Chart:
    """Return a chart of accuracy by predicted probability, before and after the temperature."""
    known_rows = answers[answers.known].sort_values("probability", kind="stable")
    bins = np.array_split(
        np.arange(len(known_rows)), int(np.clip(len(known_rows) // MIN_BIN_COUNT, 1, calibration.BINS))
    )
    points = [
        (float(known_rows.iloc[indices].probability.mean()), rate_of(known_rows.iloc[indices], "right"))
        for indices in bins
        if len(indices)
    ]
    fractions, low, high = ([getattr(value, name) for _, value in points] for name in ("fraction", "low", "high"))
    lines = [Curve("calibrated", [probability for probability, _ in points], fractions, low, high)]
    if uncalibrated := _uncalibrated_points(method, sensor):
        lines.append(
            Curve("as trained", [value for value, _ in uncalibrated], [value for _, value in uncalibrated], dashed=True)
        )
    spec = charts.lines(lines, "stated probability", "fraction right", diagonal=(0, 1), height=220)
    return Chart(title, spec)


def _uncalibrated_points(method: Method, sensor: str) -> list[tuple[float, float]]:
    """Return mean confidence and accuracy of each bin of the uncalibrated probabilities."""
    sums: dict[int, list[float]] = {}
    for run in runs_on(method, sensor):
        measured = run.details.metrics.get("calibration", {}).get(sensor)
        for bin_tree in measured["before"]["reliability"] if measured else []:
            bin_index = min(int(bin_tree["confidence"] * calibration.BINS), calibration.BINS - 1)
            total = sums.setdefault(bin_index, [0.0, 0.0, 0.0])
            for index, value in enumerate((1.0, bin_tree["confidence"], bin_tree["accuracy"])):
                total[index] += bin_tree["n"] * value
    return [(probability / n, right / n) for _, (n, probability, right) in sorted(sums.items())]


def _unknown_chart(sensor: str, chart_lines: Sequence[tuple[str, pd.DataFrame]]) -> Chart:
    """Return a chart of true-unknown against false-unknown rates, with the thresholds."""
    lines, points = [], []
    for name, answers in chart_lines:
        loss_curves = []
        for _, run_rows in answers.groupby("run"):
            known_scores, unknown = (run_rows.score[run_rows.known == flag].to_numpy(float) for flag in (True, False))
            if len(known_scores) and len(unknown):
                loss_curves.append(100 * unknown_curve(known_scores, unknown))
        runs = np.stack(loss_curves)
        low, high = (runs.min(axis=0), runs.max(axis=0)) if len(runs) > 1 else (None, None)
        lines.append(Curve(name, 100 * RATES, runs.mean(axis=0), low, high))
        lost, unknown_rate = (
            100 * rate_of(answers[answers.known == flag], "refused").fraction for flag in (True, False)
        )
        points.append((name, lost, unknown_rate))
    x, y = (
        "slides of known materials classified as unknown (%)",
        "slides of unknown materials classified as unknown (%)",
    )
    spec = charts.lines(lines, x, y, diagonal=(0, 100), points=False, height=260)
    spec["layer"].append(charts.marked(points, x, y))
    return Chart(f"Unknown: {sensor}", spec)


def _table_row(method: Method, sensor: str, answers: pd.DataFrame) -> Sequence[str | Cell]:
    """Return the row of a method on a sensor's slides: errors of its probabilities, and rates of the answer unknown."""
    trees = [run.details.metrics for run in runs_on(method, sensor)]
    measured = [tree["calibration"][sensor] for tree in trees if sensor in tree.get("calibration", {})]
    refused = [tree["unknown"][sensor] for tree in trees if sensor in tree.get("unknown", {})]
    areas = [tree["auroc"][tree["rule"]] for tree in refused if "auroc" in tree]

    def mean(measure: Literal["calibration_error", "log_loss"]) -> Cell:
        if not measured:
            return Cell(NONE)
        parts = [(tree["before"][measure], tree["after"][measure]) for tree in measured]
        before, after = map(float, np.mean(parts, axis=0))
        return Cell(number(after, 3).text, f"{number(before, 3).text} as trained", after)

    known_rows, unknown_rows = answers[answers.known], answers[~answers.known]
    return [
        f"{sensor_title(sensor)}: {method.name}",
        f"{known_rows.recording.nunique():,}",
        mean("calibration_error"),
        mean("log_loss"),
        _rate_cell(rate_of(known_rows, "refused")),
        _rate_cell(rate_over_materials(unknown_rows.assign(named_known=~unknown_rows.refused), "named_known")),
        number(float(np.mean(areas)), 3) if areas else Cell(NONE),
        _rate_cell(rate_of(known_rows[~known_rows.refused], "right")),
    ]


def _rate_cell(rate: Rate) -> Cell:
    """Return a fraction in percent above its interval."""
    if not rate.slides:
        return Cell(NONE)
    ends = "" if np.isnan(rate.low) else f"{100 * rate.low:.1f} to {100 * rate.high:.1f} "
    below = f"{ends}of {rate.slides:,}"
    return Cell(f"{100 * rate.fraction:.1f}", below, rate.fraction)
