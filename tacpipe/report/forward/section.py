"""One result: what came out in a sentence, then figures, tables, and where the numbers come from."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.metrics import headline as headline_of
from tacpipe.metrics.headline import Headline
from tacpipe.report import contents, headline_box, markup, provenance
from tacpipe.report.forward import comparison, figures, methods, traces
from tacpipe.tasks.forward import units
from tacpipe.tasks.forward.headline import legitimate

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Tree = Mapping[str, Any]

SHOWN_STEPS = (1, 3, 5, 10)
TRACE_STEPS = (1, 5, 10)
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
OFF_SCALE = ("context_mean", "train_mean")  # so far off that the others would lie on one line


def headlines(result: Dataset) -> list[Headline]:
    """Return how the model of one result compares with its baselines, on known objects and unseen ones, or on all.

    Empty without the error sums of recordings that the model has not seen.
    """
    if not methods.comparable(result):
        return []
    run = methods.Run.read(result)
    if not run.errors.recordings:
        return []
    (method,) = methods.grouped([run])
    steps = comparison.shown_steps([run])
    parts = (True, False) if run.errors.named else (None,)
    found = (comparison.headline(method, [], steps, part) for part in parts)
    return [one for one in found if one is not None]


def sentences(found: Sequence[Headline], metrics: Tree, unit: str = units.COUNTS) -> list[tuple[str, str]]:
    """Return the result in a sentence or two, each with its verdict (`tacpipe.metrics.headline.verdict`)."""
    if found:
        return [(headline_of.sentence(one), one.verdict) for one in found]
    if "skill" not in metrics:
        described = (
            "No recording was left to evaluate the model on: it has seen all that were given, or none holds a window."
        )
        return [(described, "")]
    errors = {name: float(_both(metrics[name]["mse_counts"])["mean"]) for name in _predictors(metrics)}
    others = {name: error for name, error in errors.items() if name in EXPLAINED and legitimate(name)}
    if not others or "model" not in errors:
        return [("The model was evaluated without a baseline.", "")]
    best = min(others, key=lambda name: others[name])
    described = (
        f"Mean squared error over all steps: {markup.number(errors['model'])} {unit}² for the model, "
        f"{markup.number(others[best])} for {best}, the best of {len(others)} baselines. This result holds no sums by "
        f"recording, so there is no interval: evaluate the model again."
    )
    return [(described, "")]


def render(result: Dataset, number: int, of: int, drawn: int) -> str:
    """Return the part of the page that one result has: the ``number``-th ``of`` so many, with ``drawn`` traces."""
    metrics, config = (contents.tree(result, name) for name in ("metrics.json", "config.json"))
    rate_hz = float(config.get("rate_hz", 0.0))
    found, unit = headlines(result), units.of_model(config)
    badge = ' <span class="badge">simulated</span>' if provenance.simulated(result) else ""
    name = ": ".join(str(config[key]) for key in ("task", "architecture") if key in config) or "result"
    if isinstance(config.get("codec"), Mapping):
        name += f" · {config['codec'].get('name', config['codec'].get('kind', ''))}"
    trials = list(csv.DictReader(io.StringIO(result.files.get("trials.csv", b"").decode())))
    parts = [
        f"<h2>{f'{number}. ' if of > 1 else ''}{escape(name.replace('_', ' '))}{badge}</h2>",
        headline_box.box(sentences(found, metrics, unit)),
        headline_box.table(found),
        _floor(metrics, unit),
        _counts(metrics, provenance.simulated(result)),
        _horizon_figures(metrics, rate_hz, unit),
        _error_tables(metrics, unit),
        _objects(metrics, unit),
        _trials(trials, unit),
        _traces(result, trials, drawn),
        _seen(metrics),
        _training(contents.history(result)),
        provenance.section(result.manifest),
    ]
    return "\n".join(part for part in parts if part) + "\n"


def _counts(metrics: Tree, badge: bool) -> str:
    """Return how much the result rests on."""
    counts = metrics.get("counts", {})
    text = (
        f"{headline_of.counted(counts.get('recordings', 0), 'recordings')} that the model has not seen, "
        f"{counts.get('windows', 0)} windows; because windows overlap, they are worth about "
        f"{counts.get('effective_windows', 0)}. "
        "Intervals come from drawing whole recordings anew. "
        "Below, skill is 1 − squared error of the model / squared error of persistence."
    )
    if badge:
        text += " These recordings were simulated: nothing here is evidence about a real sensor."
    return f'<p class="note">{escape(text)}</p>'


def _floor(metrics: Tree, unit: str) -> str:
    """Return a warning where the codec alone loses more than persistence errs, empty otherwise."""
    if "codec" not in metrics:
        return ""
    floor, baseline = (_both(metrics[name]["mse_counts"]) for name in ("codec", "persistence"))
    steps = _steps(floor)
    lost = [step for step in steps if floor[f"t{step}"] >= baseline[f"t{step}"]]
    if not lost:
        return ""
    which = "at every step" if lost == steps else f"up to t+{max(lost)}"
    text = (
        f"The codec alone loses more than persistence errs {which} (squared error of the true future through the codec: "
        f"{markup.number(floor['mean'])} {unit}² on average), so a model of its latents can hardly win there in {unit}."
    )
    return f"<p>{escape(text)}</p>"


def _steps(scores: Tree) -> list[int]:
    return sorted(int(name[1:]) for name in scores if name != "mean")


def _both(scores: Tree) -> Tree:
    """Return the errors over all channels; results of before this was called ``both`` call it ``all``."""
    found: Tree = scores["both"] if "both" in scores else scores["all"]
    return found


def _predictors(metrics: Tree) -> list[str]:
    """Return the names of model and baselines, model first, then persistence."""
    found = [
        name
        for name, scores in metrics.items()
        if name != "skill" and isinstance(scores, Mapping) and "mse_counts" in scores
    ]
    order = list(EXPLAINED)
    return sorted(found, key=lambda name: (order.index(name) if name in order else len(order), name))


def _horizon_figures(metrics: Tree, rate_hz: float, unit: str) -> str:
    """Return error and skill over the time ahead, side by side."""
    names = _predictors(metrics)
    if not names:
        return ""
    steps = _steps(_both(metrics[names[0]]["mse_counts"]))
    ahead_ms = [1000 * step / rate_hz if rate_hz else float(step) for step in steps]
    errors = {
        name: [np.sqrt(_both(metrics[name]["mse_counts"])[f"t{step}"]) for step in steps]
        for name in names
        if name not in OFF_SCALE
    }
    parts = [
        markup.figure(
            figures.errors_by_horizon(errors, ahead_ms, f"root mean squared error ({unit})"),
            "Error over all channels and unseen recordings. Lower is better.",
        )
    ]
    described = metrics["skill"]["mse_counts"]
    if all("low" in described.get(f"t{step}", {}) for step in steps):
        skill = {part: [described[f"t{step}"][part] for step in steps] for part in ("mean", "low", "high")}
        caption = "Skill over persistence, with its 95 % interval over recordings."
        parts.append(markup.figure(figures.skill_by_horizon(skill, ahead_ms), caption))
    return f'<div class="pair">{"".join(parts)}</div>'


def _error_tables(metrics: Tree, unit: str) -> str:
    """Return errors by predictor, skill with intervals, and errors by sensor and axis."""
    names = _predictors(metrics)
    if not names:
        return ""
    groups = metrics[names[0]]["mae_counts"]
    shown = [f"t{step}" for step in _steps(_both(groups)) if step in SHOWN_STEPS] + ["mean"]
    heads = [name.replace("t", "t+") if name != "mean" else name for name in shown]
    parts = []
    for measure, title in (
        ("mae_counts", f"Mean absolute error ({unit})"),
        ("mse_counts", f"Mean squared error ({unit}²)"),
    ):
        rows = [[name, *(markup.number(_both(metrics[name][measure])[step]) for step in shown)] for name in names]
        parts.append(markup.table(title, ["", *heads], rows))
    described = [name for name in names if "mse_feature" in metrics[name]]
    rows = [[name, *(markup.number(metrics[name]["mse_feature"][step]) for step in shown)] for name in described]
    parts.append(markup.table("Mean squared error (latents scaled to ±1)", ["", *heads], rows))
    rows = []
    for measure, skill in metrics["skill"].items():
        rows.append([measure, *(markup.interval(skill.get(step, {})) for step in shown)])
    parts.append(markup.table("Skill over persistence, with 95 % interval", ["", *heads], rows))
    rows = [
        [f"{name}, {group}", *(markup.number(metrics[name]["mae_counts"][group][step]) for step in shown)]
        for group in groups
        if group not in ("both", "all")
        for name in names[:2]
    ]
    parts.append(markup.table(f"Mean absolute error by sensor and axis ({unit})", ["", *heads], rows))
    legend = "; ".join(f"{name}: {EXPLAINED[name]}" for name in names if name in EXPLAINED)
    return f'<h3>Errors</h3><p class="note">{escape(legend)}.</p>' + "".join(parts)


def _objects(metrics: Tree, unit: str) -> str:
    """Return errors and skill on objects that the model was trained on next to those on others, where it is given."""
    parts = {name: metrics[name] for name in ("known", "unseen") if "skill" in metrics.get(name, {})}
    if not parts:
        return ""
    rows = []
    for name, part in parts.items():
        steps = [f"t{step}" for step in _steps(_both(part["model"]["mae_counts"])) if step in SHOWN_STEPS] + ["mean"]
        objects = f"{name} objects ({part['counts']['recordings']} recordings)"
        for predictor in _predictors(part)[:2]:
            errors = _both(part[predictor]["mae_counts"])
            rows.append([f"{objects}, {predictor} ({unit})", *(markup.number(errors[step]) for step in steps)])
        described = part["skill"]["mse_counts"]
        rows.append([f"{objects}, skill", *(markup.interval(described.get(step, {})) for step in steps)])
    heads = [step.replace("t", "t+") if step != "mean" else step for step in steps]
    return markup.table("Known objects and unseen ones: mean absolute error, and skill", ["", *heads], rows)


def _trials(trials: Sequence[Mapping[str, str]], unit: str) -> str:
    """Return the skill on each unseen recording."""
    ranked = [one for one in trials if one["seen"] == "false" and one["skill"]]
    if not ranked:
        return ""
    skill, windows = [float(one["skill"]) for one in ranked], [int(one["windows"]) for one in ranked]
    better = sum(value > 0 for value in skill)
    caption = (
        f"Skill on each recording; better than persistence on {better} of {len(skill)}. Larger dots: more windows."
    )
    keys = ("mse_counts_model", "mse_counts_persistence")
    rows = [
        [
            one["recording"],
            one["windows"],
            *(markup.number(float(one[key])) for key in keys),
            markup.skill(float(one["skill"])),
        ]
        for one in sorted(ranked, key=lambda one: float(one["skill"]))
    ]
    heads = ["recording", "windows", f"model ({unit}²)", f"persistence ({unit}²)", "skill"]
    return (
        "<h3>By recording</h3>"
        + markup.figure(figures.skill_by_trial(skill, windows), caption)
        + markup.table("All recordings, the worst first", heads, rows)
    )


def _traces(result: Dataset, trials: Sequence[Mapping[str, str]], count: int) -> str:
    """Return example predictions of the recordings of median, lowest and highest skill."""
    ranked = sorted(
        (one for one in trials if one["seen"] == "false" and one["skill"] and one["recording"] in result.recordings),
        key=lambda one: float(one["skill"]),
    )
    if not ranked or not count:
        return ""
    chosen = {"median": ranked[len(ranked) // 2], "lowest": ranked[0], "highest": ranked[-1]}
    drawn: dict[str, str] = {}
    for rank, one in list(chosen.items())[:count]:
        name = one["recording"]
        if name not in drawn:
            caption = f"{name}, the recording of {rank} skill ({markup.skill(float(one['skill']))}). {traces.UNSHIFTED}"
            drawn[name] = markup.figure(traces.draw(result.recordings[name], (0, 1), TRACE_STEPS), caption)
    return "<h3>Predictions</h3>" + "".join(drawn.values())


def _seen(metrics: Tree) -> str:
    """Return the errors on recordings that the model was trained on, which prove nothing."""
    seen = metrics.get("seen", {})
    described = seen.get("skill", {}).get("mse_counts", {}).get("mean", {})
    if "mean" not in described:
        return ""
    count = headline_of.counted(seen["counts"]["recordings"], "recordings")
    text = (
        f"Left out of all above: {count} that the model was trained or stopped on. "
        f"Its skill on these is {markup.skill(described['mean'])}, averaged over all steps."
    )
    return f'<h3>Recordings the model has seen</h3><p class="note">{escape(text)}</p>'


def _training(history: Sequence[Tree]) -> str:
    """Return the losses by epoch, where the result holds them."""
    if not history:
        return ""
    best = min(history, key=lambda line: line["val_loss"])
    caption = f"{len(history)} epochs; the weights of epoch {best['epoch']} were kept, whose validation loss is lowest."
    return "<h3>Training</h3>" + markup.figure(figures.losses(history), caption)
