"""Draw single runs: errors by step, traces of recordings, losses by epoch."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.comparison.runs import MODEL
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import Cell, Chart, Charts, Fold, SmallPrint, Table, counted, fold, number, table
from tacpipe.report.charts import Curve
from tacpipe.report.context import Context, loss_chart, median_run
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.headline import ForwardMetrics, ForwardScores
from tacpipe.tasks.forward.report import methods
from tacpipe.tasks.forward.report.methods import ComparedRun, ForwardResult, Method

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording


OFF_SCALE = ("context_mean", "train_mean")  # their errors are so large that the other lines would coincide
EXPLAINED = {
    "model": "the trained model",
    "persistence": "no change: the last frame is repeated",
    "codec_persistence": "the last frame, encoded and decoded, is repeated",
    "codec": "the true future, encoded and decoded: the cost of the compression",
    "model_anchored": "the forecast of the model, shifted to continue from the last frame",
    "codec_anchored": "the true future, encoded and decoded, shifted to continue from the last frame",
    "context_mean": "the mean of the frames that the model reads",
    "train_mean": "the mean of the training recordings",
    "damped_trend": "a decaying continuation of the last trend",
    "last_value_linear": "a linear map of the frames that the model reads, relative to the last frame",
    "ridge": "ridge regression of the future changes on the changes in the frames that the model reads",
    "ridge_actions": "the same with the planned motion",
}


def run_folds(method: str, run: ComparedRun) -> list[Fold]:
    """Return the errors of a method's run, or nothing if the result has no errors by step."""
    result: ForwardResult = run.details
    metrics, unit = result.metrics, headline.unit_of_model(result.config)
    names = _ordered_predictors(metrics.fresh)
    if not names:
        return []
    notes = [SmallPrint(text) for text in (_describe_floor(metrics, unit), _describe_seen(metrics)) if text]
    return fold(
        f"In full: {method}",
        *notes,
        *_rmse_charts(run, names, unit),
        *_error_tables(metrics, names, unit),
        about="one run, each predictor and step",
    )


def predictor_title(predictor: str) -> str:
    """Return the name of a predictor of ``metrics.json`` for text."""
    return predictor.replace("_", " ")


def _rmse_charts(run: ComparedRun, names: Sequence[str], unit: str) -> list[Chart]:
    """Return a chart of the root mean squared error of each predictor by time ahead."""
    predictors, rate_hz = run.details.metrics.fresh.predictors, run.details.rate_hz
    steps = sorted(int(name[1:]) for name in predictors[names[0]]["mse_counts"]["both"] if name != "mean")
    x = [1000 * step / rate_hz if rate_hz else float(step) for step in steps]
    lines = [
        Curve(
            predictor_title(name),
            x,
            [float(np.sqrt(predictors[name]["mse_counts"]["both"][f"t{step}"])) for step in steps],
            dashed=name != MODEL,
        )
        for name in names
        if name not in OFF_SCALE
    ]
    ahead = f"time ahead ({'ms' if rate_hz else 'steps'})"
    return [
        Chart(
            "Error of each predictor by time ahead",
            charts.lines(lines, ahead, f"root mean squared error ({unit})"),
            "All channels, unseen recordings.",
        )
    ]


def _error_tables(metrics: ForwardMetrics, names: Sequence[str], unit: str) -> list[Table]:
    """Return the tables of errors by step, of skill, and by sensor, axis and part of the recordings."""
    predictors = metrics.fresh.predictors
    groups = predictors[names[0]]["mae_counts"]
    steps = [f"t{step}" for step in headline.STEPS if f"t{step}" in groups["both"]] + ["mean"]
    heads = ["", *(name.replace("t", "t+") if name != "mean" else name for name in steps)]

    def error_cells(errors: Mapping[str, float]) -> list[Cell]:
        return [number(errors[step]) for step in steps]

    absolute = {name: scores["mae_counts"]["both"] for name, scores in predictors.items()}
    squared = {name: scores["mse_counts"]["both"] for name, scores in predictors.items()}
    tables = [
        table(title, heads, [[predictor_title(name), *error_cells(errors[name])] for name in names])
        for title, errors in ((f"Mean absolute error ({unit})", absolute), (f"Mean squared error ({unit}²)", squared))
    ]
    rows: list[Sequence[str | Cell]] = [
        [predictor_title(name), *error_cells(predictors[name]["mse_feature"])]
        for name in names
        if "mse_feature" in predictors[name]
    ]
    tables += [table("Mean squared error (latents scaled to ±1)", heads, rows)] if rows else []
    rows = [
        [measure, *(_error_cell(skill.get(step, {})) for step in steps)]
        for measure, skill in metrics.fresh.skill.items()
    ]
    tables.append(table("Skill over persistence, with 95 % interval", heads, rows))
    rows = [
        [f"{predictor_title(name)}, {group}", *error_cells(predictors[name]["mae_counts"][group])]
        for group in groups
        if group != "both"
        for name in names[:2]
    ]
    tables.append(table(f"Mean absolute error by sensor and axis ({unit})", heads, rows))
    rows = []
    for name in ("known", "unseen"):
        part_metrics = metrics.parts.get(name)
        if part_metrics and part_metrics.skill:
            objects = f"{name} objects ({counted(part_metrics.counts['recordings'], 'recordings')})"
            rows += [
                [
                    f"{objects}, {predictor_title(predictor)} ({unit})",
                    *error_cells(part_metrics.predictors[predictor]["mae_counts"]["both"]),
                ]
                for predictor in _ordered_predictors(part_metrics)[:2]
            ]
            rows.append(
                [
                    f"{objects}, skill",
                    *(_error_cell(part_metrics.skill[headline.GEOMETRIC].get(step, {})) for step in steps),
                ]
            )
    return [*tables, table("Known and unseen objects: mean absolute error, and skill", heads, rows)] if rows else tables


def _describe_floor(metrics: ForwardMetrics, unit: str) -> str:
    """Return a warning if the codec's own loss exceeds the error of persistence, otherwise an empty string."""
    predictors = metrics.fresh.predictors
    if "codec" not in predictors:
        return ""
    floor, baseline = (predictors[name]["mse_counts"]["both"] for name in ("codec", "persistence"))
    steps = sorted(int(name[1:]) for name in floor if name != "mean")
    lost = [step for step in steps if floor[f"t{step}"] >= baseline[f"t{step}"]]
    if not lost:
        return ""
    steps_text = "at every step" if lost == steps else f"up to t+{max(lost)}"
    return (
        f"The error of the codec is larger than the error of persistence {steps_text} (mean squared error of the "
        f"true future, encoded and decoded: {number(floor['mean']).text} {unit}²), so a model of its latents can "
        f"hardly be better than persistence there, in {unit}."
    )


def _describe_seen(metrics: ForwardMetrics) -> str:
    """Return the number and mean skill of training recordings, which are left out; empty without any."""
    seen = metrics.parts.get("seen")
    described = seen.skill[headline.GEOMETRIC].get("mean", {}) if seen else {}
    if not seen or "mean" not in described:
        return ""
    count = counted(seen.counts["recordings"], "recordings")
    mean = blocks.signed(described["mean"])
    return f"Left out: {count} that were used for training or early stopping, with a mean skill of {mean}."


def _error_cell(interval_tree: Mapping[str, float]) -> Cell:
    """Return a cell with a mean and its interval, which may lack its bounds or be empty."""
    return (
        blocks.interval(interval_tree["mean"], interval_tree.get("low", np.nan), interval_tree.get("high", np.nan))
        if "mean" in interval_tree
        else Cell("not defined")
    )


def _ordered_predictors(scores: ForwardScores) -> list[str]:
    """Return the names of model and baselines: the model first, then persistence."""
    order = list(EXPLAINED)
    return sorted(scores.predictors, key=lambda name: (order.index(name) if name in order else len(order), name))


SHOWN_S = 12.0  # maximum drawn duration of a recording
TRUTH = "truth now"
UNSHIFTED = (
    "Each prediction is drawn at the time at which it was made, so a prediction that looks ahead is left of the "
    "truth, and persistence coincides with it. Only the first seconds of long recordings are drawn, at a reduced "
    "resolution."
)


def draw_traces(
    shard: Recording, latents: Sequence[int], steps: Sequence[int], title: str, caption: str = "", *, unit: str = ""
) -> list[Chart]:
    """Draw the first seconds of some latents of a recording, by index from 0, with their predictions.

    ``unit`` is the unit of latents that are channels. Latents and steps that the recording does not contain are
    omitted.
    """
    table = shard.table()
    if not table.num_rows:
        return []
    time_s = (table.column("t_ns").to_numpy() - table.column("t_ns")[0].as_py()) / 1e9
    time_s = time_s[time_s <= SHOWN_S]
    broken = np.concatenate([[False], np.diff(table.column("contact").to_numpy()) != 0])
    latent_names = [name for name in table.column_names if f"{name}_t1" in table.column_names]

    def values(name: str) -> AnyFloats:
        column: AnyFloats = table.column(name).to_numpy().astype(np.float64)
        column[broken] = np.nan
        return column[: len(time_s)]

    drawn = []
    for latent in (latent_names[index] for index in latents if index < len(latent_names)):
        ahead = [step for step in steps if f"{latent}_t{step}" in table.column_names]
        lines = [Curve(TRUTH, time_s, values(latent))]
        lines += [Curve(f"t+{step}", time_s, values(f"{latent}_t{step}"), dashed=True) for step in ahead]
        quantity = f"{latent} ({unit})" if unit else latent
        spec = charts.lines(lines, "time at which the prediction is made (s)", quantity, points=False, height=170)
        drawn.append(Chart(f"{title}: {latent}", spec, caption, wide=True))
    return drawn


TRACE_STEPS = (1, 5, 10)
LOSS_NAMES: Mapping[str, Literal["train_loss", "val_loss"]] = {"training": "train_loss", "validation": "val_loss"}


def paper_representative(context: Context) -> Method | None:
    """Return the paper's method if the recordings are the paper's."""
    return methods.paper_method(context.methods) if context.published else None


def _representatives(context: Context) -> list[tuple[Method, ComparedRun]]:
    """Return a median run of the best method of the last part, and one of the paper's method, which are shown in detail.

    With up to two runs, all methods are shown.
    """
    compared = [candidate for candidate in context.comparisons if candidate.best]
    last = next(
        (candidate for candidate in reversed(compared) if candidate.question.place < 2), next(iter(compared), None)
    )  # the main timeline
    if last is None or last.best is None:
        return []
    chosen = [candidate for candidate in (last.best.method, paper_representative(context)) if candidate]
    if len(context.runs) <= 2:
        chosen += list(context.methods)
    by_name = {
        candidate.name: (
            candidate,
            median_run(
                candidate, next(comparison for comparison in context.comparisons if candidate.of(comparison.question))
            ),
        )
        for candidate in chosen
    }
    return list(by_name.values())


def prediction_folds(context: Context) -> list[Fold]:
    """Return predictions and measurements of the recordings with median, minimum and maximum skill, and of the paper's."""
    drawn = []
    for method, run in _representatives(context):
        ranked = ranked_trials(run)
        places = {"median": len(ranked) // 2, "lowest": 0, "highest": len(ranked) - 1}
        rank_by_name = {ranked[at][1]: (rank, ranked[at][0]) for rank, at in reversed(places.items()) if ranked}
        for name, (rank, skill) in list(reversed(rank_by_name.items()))[: context.traces]:
            caption = f"The recording of {rank} skill ({blocks.signed(skill)}) of {method.name}."
            drawn += draw_traces(
                run.dataset.recordings[name], (0, 1), TRACE_STEPS, name, caption, unit=_unit_of_run(run)
            )
    return fold(
        "Predictions and measurements", *drawn, *_paper_traces(context), SmallPrint(UNSHIFTED) if drawn else None
    )


def _unit_of_run(run: ComparedRun) -> str:
    """Return the unit of the latents of a run: that of the channels if they are not compressed, otherwise empty."""
    config = run.details.config
    return headline.unit_of_model(config) if config["codec"]["kind"] == "raw" else "latent units"


def _paper_traces(context: Context) -> list[Chart]:
    """Return Figures 5 and 6 of the paper: the first two components, and the second and fourth latent of AE-C1."""
    choices = (
        ("PCA", (0, 1), "Figure 5 in the paper's form: the first two principal components"),
        ("AE-C1", (1, 3), "Figure 6 in the paper's form: the second and the fourth latent of AE-C1"),
    )
    drawn: list[Chart] = []
    for row, latents, title in choices if context.published else ():
        trace_charts = [
            method
            for method in context.methods
            if methods.is_recurrent(method) and methods.paper_row(method.runs[0].details.config["codec"]) == row
        ]
        for method in trace_charts[:1]:
            evaluated = next((comparison for comparison in context.comparisons if method.of(comparison.question)), None)
            run = median_run(method, evaluated) if evaluated else method.runs[0]
            ranked = ranked_trials(run)
            if ranked:
                name = ranked[len(ranked) // 2][1]
                caption = f"{name}, the recording of median skill of {method.name}."
                drawn += draw_traces(
                    run.dataset.recordings[name], latents, (3, 5, 10), title, caption, unit=_unit_of_run(run)
                )
    return drawn


def ranked_trials(run: ComparedRun) -> list[tuple[float, str]]:
    """Return skill and name of the unseen recordings whose predictions are in a result."""
    text = run.dataset.files.get("trials.csv", b"").decode()
    return sorted(
        (float(trial["skill"]), trial["recording"])
        for trial in csv.DictReader(io.StringIO(text))
        if trial["seen"] == "false" and trial["skill"] and trial["recording"] in run.dataset.recordings
    )


def training_folds(context: Context) -> list[Fold]:
    """Return training and validation loss by epoch of the representative runs."""
    drawn = []
    for method, run in _representatives(context):
        history = run.details.history
        if not history:
            continue
        best = min(history, key=lambda line: line["val_loss"])
        curves = {name: [[epoch[key] for epoch in history]] for name, key in LOSS_NAMES.items()}
        spec = loss_chart(curves, "loss (scaled latents)", log=True)
        spec["height"] = 190
        selected = (
            f"{len(history)} epochs; the weights of epoch {best['epoch']} were kept, whose validation loss is lowest."
        )
        drawn.append(Chart(f"Loss by epoch: {method.name}", spec, selected))
    return fold("Training", Charts(drawn)) if drawn else []


def single_run_folds(context: Context) -> list[Fold]:
    """Return all errors of representative runs, by predictor and step."""
    return [run_fold for method, run in _representatives(context) for run_fold in run_folds(method.name, run)]
