"""The runs that are shown singly: predictions next to the truth, training, and errors in full."""

from __future__ import annotations

import csv
import io

from tacpipe.comparison.runs import Method, Run
from tacpipe.report import blocks, learning
from tacpipe.report.blocks import Chart, Charts, Fold, Note, fold
from tacpipe.report.context import Context, median_run
from tacpipe.tasks.forward import units
from tacpipe.tasks.forward.report import methods as by_method
from tacpipe.tasks.forward.report import single_run, traces

TRACE_STEPS = (1, 5, 10)
LOSSES = {"training": "train_loss", "validation": "val_loss"}


def paper(context: Context) -> Method | None:
    """Return the paper's method where the recordings are the paper's."""
    return by_method.papers(context.methods) if context.published else None


def _representatives(context: Context) -> list[tuple[Method, Run]]:
    """Return a median run of the best method of the last part, and of the paper's: those that are shown singly."""
    held = [one for one in context.comparisons if one.best]
    last = next((one for one in reversed(held) if one.question.place < 2), next(iter(held), None))  # the main timeline
    if last is None or last.best is None:
        return []
    chosen = [one for one in (last.best.method, paper(context)) if one]
    if len(context.runs) <= 2:
        chosen += list(context.methods)
    found = {
        one.name: (one, median_run(one, next(each for each in context.comparisons if one.of(each.question))))
        for one in chosen
    }
    return list(found.values())


def predictions(context: Context) -> list[Fold]:
    """Return what was predicted next to what came, of recordings of median, lowest and highest skill, and the paper's."""
    drawn = []
    for method, run in _representatives(context):
        ranked = ranked_trials(run)
        places = {"median": len(ranked) // 2, "lowest": 0, "highest": len(ranked) - 1}
        named = {ranked[at][1]: (rank, ranked[at][0]) for rank, at in reversed(places.items()) if ranked}
        for name, (rank, skill) in list(reversed(named.items()))[: context.traces]:
            caption = f"The recording of {rank} skill ({blocks.signed(skill)}) of {method.name}."
            drawn += traces.draw(run.dataset.recordings[name], (0, 1), TRACE_STEPS, name, caption, unit=_unit(run))
    return fold(
        "Predictions next to the truth", *drawn, *_paper_traces(context), Note(traces.UNSHIFTED) if drawn else None
    )


def _unit(run: Run) -> str:
    """Return the unit of the latents of a run: that of the channels where they are not compressed, else none."""
    config = run.details.config
    return units.of_model(config) if config["codec"]["kind"] == "raw" else "latent units"


def _paper_traces(context: Context) -> list[Chart]:
    """Return Figures 5 and 6 of the paper: the first two components, and the second and fourth latent of AE-C1."""
    wanted = (
        ("PCA", (0, 1), "Figure 5 in the paper's form: the first two principal components"),
        ("AE-C1", (1, 3), "Figure 6 in the paper's form: the second and the fourth latent of AE-C1"),
    )
    drawn: list[Chart] = []
    for row, latents, title in wanted if context.published else ():
        found = [
            one
            for one in context.methods
            if by_method.recurrent(one) and by_method.paper_row(one.runs[0].details.config["codec"]) == row
        ]
        for method in found[:1]:
            held = next((one for one in context.comparisons if method.of(one.question)), None)
            run = median_run(method, held) if held else method.runs[0]
            ranked = ranked_trials(run)
            if ranked:
                name = ranked[len(ranked) // 2][1]
                caption = f"{name}, the recording of median skill of {method.name}."
                drawn += traces.draw(run.dataset.recordings[name], latents, (3, 5, 10), title, caption, unit=_unit(run))
    return drawn


def ranked_trials(run: Run) -> list[tuple[float, str]]:
    """Return skill and name of the recordings that the model has not seen, of the predictions that a result holds."""
    text = run.dataset.files.get("trials.csv", b"").decode()
    return sorted(
        (float(one["skill"]), one["recording"])
        for one in csv.DictReader(io.StringIO(text))
        if one["seen"] == "false" and one["skill"] and one["recording"] in run.dataset.recordings
    )


def training(context: Context) -> list[Fold]:
    """Return training and validation loss by epoch of the representative runs."""
    drawn = []
    for method, run in _representatives(context):
        history = run.details.history
        if not history:
            continue
        best = min(history, key=lambda line: line["val_loss"])
        curves = {name: [[one[key] for one in history]] for name, key in LOSSES.items()}
        spec = {**learning.by_epoch(curves, "loss (scaled latents)", log=True), "height": 190}
        kept = (
            f"{len(history)} epochs; the weights of epoch {best['epoch']} were kept, whose validation loss is lowest."
        )
        drawn.append(Chart(f"Loss by epoch: {method.name}", spec, kept))
    return fold("Training", Charts(drawn)) if drawn else []


def single(context: Context) -> list[Fold]:
    """Return the errors of representative runs in full, by predictor and step."""
    return [one for method, run in _representatives(context) for one in single_run.folds(method.name, run)]
