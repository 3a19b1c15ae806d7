"""The errors of one run in full: each predictor at each step, as ``metrics.json`` of its result has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tacpipe.comparison.runs import MODEL, Run
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import Cell, Chart, Fold, Note, Table, counted, fold, number, table
from tacpipe.report.charts import Line
from tacpipe.tasks.forward import headline, units

Tree = Mapping[str, Any]
OFF_SCALE = ("context_mean", "train_mean")  # so far off that the others would lie on one line
EXPLAINED = {
    "model": "the trained model",
    "persistence": "nothing changes: the last frame is held",
    "codec_persistence": "the last frame is held after going through the codec",
    "codec": "the true future through the codec, which is what compression alone costs",
    "model_anchored": "the model's forecast, moved so that it continues from the last frame",
    "codec_anchored": "the true future through the codec, moved so that it continues from the last frame",
    "context_mean": "the mean of the frames the model reads",
    "train_mean": "the mean of the training recordings",
    "damped_trend": "the last frames' trend continues and fades",
    "last_value_linear": "a linear map of the frames the model reads, the last frame taken off them",
    "ridge": "ridge regression of the changes to come on those of the frames the model reads",
    "ridge_actions": "the same with the planned motion",
}


def folds(method: str, run: Run) -> list[Fold]:
    """Return the errors of a run of a method; nothing where the result holds no errors by step."""
    metrics, unit = run.details.metrics, units.of_model(run.details.config)
    names = _ordered(metrics)
    if not names:
        return []
    held = [Note(text) for text in (_floor(metrics, unit), _seen(metrics)) if text]
    return fold(
        f"In full: {method}",
        *held,
        *_rmse(run, names, unit),
        *_error_tables(metrics, names, unit),
        about="one run, each predictor and step",
    )


def spelled(predictor: str) -> str:
    """Return a name of ``metrics.json`` as texts have it."""
    return predictor.replace("_", " ")


def _rmse(run: Run, names: Sequence[str], unit: str) -> list[Chart]:
    metrics, rate_hz = run.details.metrics, float(run.details.config.get("rate_hz") or 0)
    steps = sorted(int(name[1:]) for name in _both(metrics[names[0]]["mse_counts"]) if name != "mean")
    x = [1000 * step / rate_hz if rate_hz else float(step) for step in steps]
    several = [
        Line(
            spelled(name),
            x,
            [float(np.sqrt(_both(metrics[name]["mse_counts"])[f"t{step}"])) for step in steps],
            dashed=name != MODEL,
        )
        for name in names
        if name not in OFF_SCALE
    ]
    ahead = f"time ahead ({'ms' if rate_hz else 'steps'})"
    return [
        Chart(
            "Error of each predictor by time ahead",
            charts.lines(several, ahead, f"root mean squared error ({unit})"),
            "All channels, unseen recordings.",
        )
    ]


def _error_tables(metrics: Tree, names: Sequence[str], unit: str) -> list[Table]:
    groups = metrics[names[0]]["mae_counts"]
    shown = [f"t{step}" for step in headline.STEPS if f"t{step}" in _both(groups)] + ["mean"]
    heads = ["", *(name.replace("t", "t+") if name != "mean" else name for name in shown)]

    def cells(errors: Tree) -> list[Cell]:
        return [number(errors[step]) for step in shown]

    errors = {"mae_counts": f"Mean absolute error ({unit})", "mse_counts": f"Mean squared error ({unit}²)"}
    found = [
        table(title, heads, [[spelled(name), *cells(_both(metrics[name][measure]))] for name in names])
        for measure, title in errors.items()
    ]
    rows: list[Sequence[str | Cell]] = [
        [spelled(name), *cells(metrics[name]["mse_feature"])] for name in names if "mse_feature" in metrics[name]
    ]
    found += [table("Mean squared error (latents scaled to ±1)", heads, rows)] if rows else []
    rows = [[measure, *(_stated(skill.get(step, {})) for step in shown)] for measure, skill in metrics["skill"].items()]
    found.append(table("Skill over persistence, with 95 % interval", heads, rows))
    rows = [
        [f"{spelled(name)}, {group}", *cells(metrics[name]["mae_counts"][group])]
        for group in groups
        if group not in ("both", "all")
        for name in names[:2]
    ]
    found.append(table(f"Mean absolute error by sensor and axis ({unit})", heads, rows))
    rows = []
    for name in ("known", "unseen"):
        part = metrics.get(name, {})
        if "skill" in part:
            objects = f"{name} objects ({counted(part['counts']['recordings'], 'recordings')})"
            rows += [
                [f"{objects}, {spelled(one)} ({unit})", *cells(_both(part[one]["mae_counts"]))]
                for one in _ordered(part)[:2]
            ]
            rows.append([f"{objects}, skill", *(_stated(_of_recordings(part).get(step, {})) for step in shown)])
    return (
        [*found, table("Known objects and unseen ones: mean absolute error, and skill", heads, rows)] if rows else found
    )


def _floor(metrics: Tree, unit: str) -> str:
    """Return a warning where the codec alone loses more than persistence errs, empty otherwise."""
    if "codec" not in metrics:
        return ""
    floor, baseline = (_both(metrics[name]["mse_counts"]) for name in ("codec", "persistence"))
    steps = sorted(int(name[1:]) for name in floor if name != "mean")
    lost = [step for step in steps if floor[f"t{step}"] >= baseline[f"t{step}"]]
    if not lost:
        return ""
    which = "at every step" if lost == steps else f"up to t+{max(lost)}"
    return (
        f"The codec alone loses more than persistence errs {which} (squared error of the true future through the codec: "
        f"{number(floor['mean']).text} {unit}² on average), so a model of its latents can hardly win there in {unit}."
    )


def _seen(metrics: Tree) -> str:
    """Return the errors on recordings that the model was trained on, which prove nothing."""
    described = _of_recordings(metrics.get("seen", {})).get("mean", {})
    if "mean" not in described:
        return ""
    count = counted(metrics["seen"]["counts"]["recordings"], "recordings")
    mean = blocks.signed(described["mean"])
    return f"Left out: {count} that the model was trained or stopped on; its mean skill on these is {mean}."


def _of_recordings(part: Tree) -> Tree:
    """Return the skill that ratios of single recordings give; the pooled one of results of before this was measured."""
    skills: Tree = part.get("skill", {})
    scores: Tree = skills.get(headline.GEOMETRIC, skills.get("mse_counts", {}))
    return scores


def _stated(one: Tree) -> Cell:
    return (
        blocks.interval(one["mean"], one.get("low", np.nan), one.get("high", np.nan))
        if "mean" in one
        else Cell("not defined")
    )


def _both(scores: Tree) -> Tree:
    """Return the errors over all channels; results of before this was called ``both`` call it ``all``."""
    found: Tree = scores["both"] if "both" in scores else scores["all"]
    return found


def _ordered(metrics: Tree) -> list[str]:
    """Return the names of model and baselines, model first, then persistence."""
    found = [
        name
        for name, scores in metrics.items()
        if name != "skill" and isinstance(scores, Mapping) and "mse_counts" in scores
    ]
    order = list(EXPLAINED)
    return sorted(found, key=lambda name: (order.index(name) if name in order else len(order), name))
