"""Draw the skill of forecasts by time ahead, and forecasts next to measurements."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import MODEL, Question
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import Chart, Charts, Fold, SmallPrint, fold
from tacpipe.report.charts import Curve
from tacpipe.report.context import Context, median_run
from tacpipe.scores import intervals, pairing
from tacpipe.scores.intervals import Interval
from tacpipe.scores.pairing import Sums
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.headline import BASELINE, Parts
from tacpipe.tasks.forward.report.methods import ComparedRun

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording

LINES = 4  # maximum number of methods in a chart of skill
FLOOR = -1.0  # minimum skill in a chart


def known_objects_of(question: Question) -> bool | None:
    """Return whether a question is about recordings of known objects; None if it is about all recordings."""
    parts = [known for known, name in headline.PARTS.items() if name and question.part.startswith(name)]
    return parts[0] if parts else None


def common_steps(context: Context) -> list[int]:
    """Return the steps that all runs predict."""
    return sorted(set.intersection(*(set(run.details.errors.steps) for run in context.runs)))


def sums_of_row(row: ComparisonRow, question: Question, steps: Sequence[int], group: str = "both") -> Sums:
    """Return the sums of a row's predictor at some steps in a group of channels, by seed and recording.

    For unseen objects, they are by seed and object.
    """
    known_objects, predictor = known_objects_of(question), row.predictor.split(" ")[0]
    parts = []
    for run in row.method.runs:
        clusters = run.details.errors.clusters(known_objects) or {}
        sums = run.details.errors.by_recording(predictor, steps, known_objects, group)
        parts += [((run.seed, clusters.get(name, name)), errors) for name, errors in sums.items()]
    return pairing.add_by_key(parts)


def skill_intervals(sums: Sums) -> Interval:
    """Return the skill over persistence at each step and overall (step + 1,), with intervals."""

    def log_ratios(draws: AnyFloats) -> AnyFloats:
        parts = Parts.from_sums(draws)
        return np.log1p(-np.hstack([parts.skill, parts.mean_skill[:, None]]))

    return intervals.skill_of_log_ratio(pairing.value_intervals(sums, log_ratios))


def mean_squared(sums: Sums) -> float:
    """Return the mean squared error over all steps; NaN if there are no sums."""
    if not sums:
        return float("nan")
    total = Parts.from_sums(np.sum(list(sums.values()), axis=0))
    return float((total.squared / total.values).mean())


def skill_folds(context: Context) -> list[Fold]:
    """Return a chart per question of skill by time ahead, for the best methods and the best baseline."""
    rows_by_comparison: dict[Comparison, list[ComparisonRow]] = {}
    for comparison in context.comparisons:
        baselines = [row for row in comparison.of("baseline") if row.predictor != BASELINE]
        rows_by_comparison[comparison] = [*comparison.models[:LINES], *baselines[:1]]
    order = list(dict.fromkeys(row.name for rows in rows_by_comparison.values() for row in rows))
    steps = common_steps(context)
    drawn = []
    for comparison, rows in rows_by_comparison.items():
        rate_hz = float(rows[0].method.details[0].config.get("rate_hz") or 0)  # 0 if a row has no fixed duration
        x = [1000 * step / rate_hz if rate_hz else float(step) for step in steps]
        curves = []
        for row in rows:
            skill = skill_intervals(sums_of_row(row, comparison.question, steps))
            curves.append(Curve(row.name, x, *(getattr(skill, name)[:-1] for name in ("mean", "low", "high"))))
        spec = charts.lines(
            curves, f"time ahead ({'ms' if rate_hz else 'steps'})", "skill over persistence (no unit)", order=order,
            level=("persistence", 0.0), floor=FLOOR,
        )  # fmt: skip
        caption = f"Grey line: persistence. {charts.explain_lines(spec, comparison.measure.cluster)}"
        drawn.append(Chart(f"Skill by time ahead: {comparison.question.where}", spec, caption))
    return fold("By time ahead", Charts(drawn)) if drawn else []


def _median_runs(context: Context) -> list[tuple[str, ComparedRun]]:
    """Return the name and a median run of the best method of each question on the main timeline, the last first."""
    compared = [comparison for comparison in context.comparisons if comparison.question.place < 2]
    winners = [(comparison, comparison.best.method) for comparison in reversed(compared) if comparison.best]
    return list({method.name: (method.name, median_run(method, at)) for at, method in winners}.values())


HORIZONS = 12  # drawn time around the steepest change, in multiples of the horizon
FORECAST_NOTE = (
    "A forecast is drawn at the time that it is for, so a perfect forecast lies on the measurement, and persistence "
    "follows it by one horizon. Grey: one horizon. The charts show the most loaded channel around its steepest change."
)


def forecast_folds(context: Context) -> list[Fold]:
    """Return forecasts next to measurements for the recordings of median, lowest and highest skill of the best method."""
    drawn: list[Chart] = []
    for method, run in _median_runs(context)[:1]:
        ranked = ranked_recordings(run)
        places = {"median": len(ranked) // 2, "lowest": 0, "highest": len(ranked) - 1} if ranked else {}
        names = {ranked[at][1]: (rank, ranked[at][0]) for rank, at in reversed(places.items())}
        for name, (rank, skill) in list(reversed(names.items()))[: context.traces]:
            caption = f"The recording of {rank} skill ({blocks.signed(skill)}) of {method}."
            drawn += draw_forecast(run, run.dataset.recordings[name], caption)
    return fold("Forecasts and measurements", *drawn, SmallPrint(FORECAST_NOTE)) if drawn else []


def ranked_recordings(run: ComparedRun) -> list[tuple[float, str]]:
    """Return skill and name of the unseen recordings whose predictions are in a result, the lowest skill first."""
    return sorted(
        (errors.measure.score_of([sums]), name)
        for errors in run.questions.values()
        for name, sums in errors.sums[MODEL].items()
        if name in run.dataset.recordings
    )


def draw_forecast(run: ComparedRun, recording: Recording, caption: str = "") -> list[Chart]:
    """Return a chart of the most loaded channel, its longest stored forecast and persistence, each when it is for.

    Empty if the recording has no row or no forecast.
    """
    rows = recording.table()
    steps = {name: _steps_of(name, rows.column_names) for name in rows.column_names}
    channels = {name: np.asarray(rows[name], np.float64) for name in rows.column_names if steps[name]}
    if not channels or not rows.num_rows:
        return []
    channel = max(channels, key=lambda name: float(np.ptp(np.nan_to_num(channels[name]))))
    step = steps[channel][-1]
    measured, forecast = channels[channel], np.asarray(rows[f"{channel}_t{step}"], np.float64)
    time_s = (rows["t_ns"].to_numpy() - rows["t_ns"][0].as_py()) / 1e9
    breaks = np.flatnonzero(np.diff(rows["contact"].to_numpy())) + 1  # forecasts do not cross contacts
    segments = [at for at in np.split(np.arange(len(time_s)), breaks) if len(at) > step]
    if not segments:
        return []
    issued = np.concatenate([at[:-step] for at in segments])
    centre = int(issued[np.argmax(np.nan_to_num(np.abs(measured[issued + step] - measured[issued])))])
    horizon_s = float(time_s[centre + step] - time_s[centre])
    first_s, last_s = (time_s[centre] + part * HORIZONS * horizon_s for part in (-0.4, 0.6))
    curves = []
    for name, values, shift in (
        ("measured", measured, 0),
        (f"forecast {step} rows before", forecast, step),
        (f"persistence of {step} rows before", measured, step),
    ):
        y = np.full(len(time_s), np.nan)
        for at in segments:
            y[at[shift:]] = values[at[: len(at) - shift]]
        shown = (time_s >= first_s) & (time_s <= last_s)
        curves.append(Curve(name, time_s[shown], y[shown]))
    shade, quantity = (float(time_s[centre]), float(time_s[centre + step])), f"{channel} ({_unit_of_run(run)})"
    spec = charts.lines(curves, "time (s)", quantity, points=False, height=190, shade=shade)
    return [Chart(f"{recording.name}: {channel}", spec, caption, wide=True)]


def _steps_of(channel: str, names: Sequence[str]) -> list[int]:
    """Return the steps of a channel's stored forecasts."""
    ends = [name.removeprefix(f"{channel}_t") for name in names if name.startswith(f"{channel}_t")]
    return sorted(int(end) for end in ends if end.isdigit())


def _unit_of_run(run: ComparedRun) -> str:
    """Return the unit of a run's stored forecasts: that of the channels if they are not compressed."""
    config = run.details.config
    return headline.unit_of_model(config) if config["codec"]["kind"] == "raw" else "latent units"


EXAMPLES = "bands.json"


def band_charts(context: Context) -> list[Chart]:
    """Return a chart with a forecast, its band and the measurement for each recording that the evaluation stored."""
    drawn = []
    for run in [run for run in context.runs if EXAMPLES in run.dataset.files][:1]:
        for example in json.loads(run.dataset.files[EXAMPLES]):
            levels = sorted(int(name[1:]) for name in example if name[0] == "q" and name[1:].isdigit())
            low, middle, high = (example[f"q{level}"] for level in (levels[0], levels[len(levels) // 2], levels[-1]))
            time_s = np.array(example["t_s"]) - example["t_s"][0]
            curves = [
                Curve("measured", time_s, example["measured"]),
                Curve(f"forecast {example['step']} rows before", time_s, middle, low, high),
            ]
            unit = headline.unit_of_model(run.details.config)
            spec = charts.lines(curves, "time (s)", f"{unit} above rest", points=False, height=190)
            caption = f"Band: {levels[0]} to {levels[-1]} % quantile."
            drawn.append(Chart(f"{example['recording']}: {example['channel']}", spec, caption, wide=True))
    return drawn
