"""What the page states of calibrated classifiers: whether probabilities are frequencies, and the answer ``unknown``."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.comparison.runs import Method
from tacpipe.metrics import calibration, headline
from tacpipe.metrics.intervals import share_interval
from tacpipe.metrics.proportions import wilson
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Block, Cell, Chart, Charts, Fold, fold, number, table
from tacpipe.report.charts import Line
from tacpipe.tasks.material.report.methods import of, sensors_of, shown

if TYPE_CHECKING:
    import pandas as pd

ANSWERS = "answers.csv"
UNKNOWN = "unknown"  # of the answers
FEWEST = 20  # answers of a bin of stated probabilities
RATES = np.linspace(0, 1, 101)  # of known slides that are answered unknown, at which curves are averaged over runs
RELIABLE = (
    "Right against stated, in bins of as many slides each: on the thin line probabilities are frequencies. As trained: in "
    "bins of the same width. Shaded: 95 % (Wilson) over slides, each counted once."
)
TABLE = (
    "False unknown: slides of known materials answered unknown. False known: slides of materials that were left out, given "
    "a name. Right: of the names given to slides of known materials. 95 % intervals are Wilson's over slides, each counted "
    "once, and of false known over materials, where these are six or more; calibration error, log loss and AUROC are means "
    "over runs."
)
REFUSED = (
    "Each threshold answers some slides of known materials with unknown, and some of materials that were left out of "
    "training. On the thin line the score distinguishes nothing. Diamonds: the threshold that calibration set without "
    "a slide of an unknown material. Shaded: from the lowest to the highest run."
)


class Rate(NamedTuple):
    """A fraction of slides, each counted once however many runs answered it, with its 95 % interval (Wilson)."""

    fraction: float
    low: float
    high: float
    slides: int


def folds(methods: Sequence[Method]) -> list[Fold]:
    """Return reliability and curves of unknown, of calibrated models; nothing without any."""
    reliable, refused, rows = [], [], []
    for sensor in sensors_of(methods):
        held = [(one, read) for one in methods if (read := answers(one, sensor)) is not None]
        reliable += [_reliability(f"{shown(sensor)}: {one.name}", one, sensor, read) for one, read in held]
        curves = [(one.name, read) for one, read in held if {True, False} <= set(read.known)]
        refused += [_unknown(shown(sensor), curves)] if curves else []
        rows += [_row(one, sensor, read) for one, read in held]
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


def answers(method: Method, sensor: str) -> pd.DataFrame | None:
    """Return what calibrated runs of a method answered of a sensor's slides: a row a slide that was not seen and a run.

    Columns: ``run``, ``recording``, ``known`` (whether its material was learned), ``right``, ``probability``, ``score`` and
    ``refused`` (answered unknown). None where no run is of a calibrated model.
    """
    import pandas as pd

    parts = []
    for number_of, run in enumerate(of(method, sensor)):
        files = run.details.dataset.files
        if ANSWERS not in files:
            continue
        text = dict.fromkeys(("recording", "sensor", "named", "answer", "label"), str)
        read = pd.read_csv(io.BytesIO(files[ANSWERS]), dtype=text, keep_default_na=False)
        read = read[(read.sensor == sensor) & ~read.seen]
        rows = run.details.predictions.of(sensor)
        truth = dict(zip(rows.recordings.tolist(), map(str, rows.named(rows.materials).tolist()), strict=True))
        counted = read.recording.isin(truth) | ~read.known  # of known materials those that count elsewhere too
        read = read[counted].assign(run=number_of, refused=read.answer == UNKNOWN)
        parts.append(read.assign(right=read.named == read.recording.map(truth)))
    return pd.concat(parts) if parts else None


def rate(rows: pd.DataFrame, column: str) -> Rate:
    """Return in which fraction of slides a column is true, with Wilson's interval; NaN without slides."""
    if not len(rows):
        return Rate(float("nan"), float("nan"), float("nan"), 0)
    slides = rows.recording.nunique()
    fraction = float(rows[column].mean())
    return Rate(fraction, *wilson(round(fraction * slides), slides), slides)


def rate_over_materials(rows: pd.DataFrame, column: str) -> Rate:
    """Return in which fraction of slides of unknown materials a column is true, with its interval over materials.

    Ends are NaN with fewer than `headline.FEWEST` materials, and in results that do not name them.
    """
    if "label" not in rows or rows.label.nunique() < headline.FEWEST:
        return rate(rows, column)._replace(low=float("nan"), high=float("nan"))
    interval = share_interval(rows[[column]].to_numpy(float), np.ones((len(rows), 1)), rows.label.to_numpy(str)).first
    return Rate(*interval, rows.recording.nunique())


def curve(known: AnyFloats, unknown: AnyFloats) -> Floats:
    """Return which fraction of unknown slides scores below the threshold below which `RATES` of known ones do (rate,).

    ``known`` and ``unknown`` (slide,) are scores. Between thresholds it is linear, as the area under it is.
    """
    ends = np.r_[-np.inf, np.unique(np.concatenate([known, unknown])), np.inf]
    one, other = (np.searchsorted(np.sort(scores), ends, side="left") / len(scores) for scores in (known, unknown))
    found: Floats = np.interp(RATES, one, np.maximum.accumulate(other))
    return found


def _reliability(title: str, method: Method, sensor: str, read: pd.DataFrame) -> Chart:
    """Return accuracy by stated probability, before and after the temperature."""
    own = read[read.known].sort_values("probability", kind="stable")
    bins = np.array_split(np.arange(len(own)), int(np.clip(len(own) // FEWEST, 1, calibration.BINS)))
    each = [(float(own.iloc[some].probability.mean()), rate(own.iloc[some], "right")) for some in bins if len(some)]
    right, low, high = ([getattr(one, name) for _, one in each] for name in ("fraction", "low", "high"))
    several = [Line("calibrated", [stated for stated, _ in each], right, low, high)]
    if before := _before(method, sensor):
        several.append(Line("as trained", [one for one, _ in before], [one for _, one in before], dashed=True))
    spec = charts.lines(several, "stated probability", "fraction right", diagonal=(0, 1), height=220)
    return Chart(title, spec)


def _before(method: Method, sensor: str) -> list[tuple[float, float]]:
    """Return mean confidence and accuracy of each bin of what the runs stated before calibration."""
    sums: dict[int, list[float]] = {}
    for run in of(method, sensor):
        tree = run.details.metrics.get("calibration", {}).get(sensor, {}).get("before", {})
        for one in tree.get("reliability", []):
            place = min(int(one["confidence"] * calibration.BINS), calibration.BINS - 1)
            total = sums.setdefault(place, [0.0, 0.0, 0.0])
            for at, value in enumerate((1.0, one["confidence"], one["accuracy"])):
                total[at] += one["n"] * value
    return [(stated / n, right / n) for _, (n, stated, right) in sorted(sums.items())]


def _unknown(sensor: str, several: Sequence[tuple[str, pd.DataFrame]]) -> Chart:
    """Return how many slides of unknown materials are found against known ones that are lost, and where thresholds lie."""
    drawn, points = [], []
    for name, read in several:
        each = []
        for _, one in read.groupby("run"):
            known, unknown = (one.score[one.known == flag].to_numpy(float) for flag in (True, False))
            if len(known) and len(unknown):
                each.append(100 * curve(known, unknown))
        runs = np.stack(each)
        low, high = (runs.min(axis=0), runs.max(axis=0)) if len(runs) > 1 else (None, None)
        drawn.append(Line(name, 100 * RATES, runs.mean(axis=0), low, high))
        lost, found = (100 * rate(read[read.known == flag], "refused").fraction for flag in (True, False))
        points.append((name, lost, found))
    x, y = "slides of known materials answered unknown (%)", "slides of unknown materials answered unknown (%)"
    spec = charts.lines(drawn, x, y, diagonal=(0, 100), points=False, height=260)
    spec["layer"].append(charts.marked(points, x, y))
    return Chart(f"Unknown: {sensor}", spec)


def _row(method: Method, sensor: str, read: pd.DataFrame) -> Sequence[str | Cell]:
    """Return a row of the table."""
    trees = [run.details.metrics for run in of(method, sensor)]
    measured = [tree["calibration"][sensor] for tree in trees if sensor in tree.get("calibration", {})]
    refused = [tree.get("unknown", {}).get(sensor, {}) for tree in trees]
    areas = [one["auroc"][one["rule"]] for one in refused if "auroc" in one]

    def mean(measure: str) -> Cell:
        if not measured:
            return Cell(NONE)
        before, after = (float(np.mean([one[when][measure] for one in measured])) for when in ("before", "after"))
        return Cell(number(after, 3).text, f"{number(before, 3).text} as trained", after)

    known, other = read[read.known], read[~read.known]
    return [
        f"{shown(sensor)}: {method.name}",
        f"{known.recording.nunique():,}",
        *map(mean, ("calibration_error", "log_loss")),
        _percent(rate(known, "refused")),
        _percent(rate_over_materials(other.assign(named_known=~other.refused), "named_known")),
        number(float(np.mean(areas)), 3) if areas else Cell(NONE),
        _percent(rate(known[~known.refused], "right")),
    ]


def _percent(found: Rate) -> Cell:
    """Return a fraction in percent above its interval."""
    if not found.slides:
        return Cell(NONE)
    ends = "" if np.isnan(found.low) else f"{100 * found.low:.1f} to {100 * found.high:.1f} "
    below = f"{ends}of {found.slides:,}"
    return Cell(f"{100 * found.fraction:.1f}", below, found.fraction)
