"""All results of the task next to each other, in the order in which they are given."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from tacpipe.report import headline_box, markup, provenance
from tacpipe.report.material import (
    confusion,
    curves,
    headline,
    latents,
    printed,
    profiles,
    reduction,
    tables,
    wording,
    zero_shot,
)
from tacpipe.report.material.methods import Method, shown
from tacpipe.report.material.predictions import LAST, LEVEL

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

PAIRED = (
    "A slide that several runs evaluated counts as the fraction of runs that named it right; the interval is from "
    "drawing slides anew. McNemar's test takes a slide for right where at least half of the runs are; the t test "
    "pairs accuracies of the same fold. "
)


def render(methods: Sequence[Method], slides: Sequence[Dataset]) -> str:
    """Return the part of the page that reports on the task ``material``."""
    plain = [one for one in methods if one.plain]
    simulated = any(one.simulated for one in methods)
    badge = ' <span class="badge">simulated</span>' if simulated else ""
    runs = sum(len(one.runs) for one in methods)
    several = f"{len(methods)} methods in {runs} results" if runs > 1 else methods[0].name
    statements = headline.sentences(methods)
    caution = markup.note(wording.caution(methods))
    others = tables.elsewhere(methods)
    reduced, swaps, paired = reduction.tables(methods), tables.swaps(methods), tables.differences(methods)
    parts = [
        f"<h2>{'Materials by touch: ' if runs > 1 else ''}{escape(several)}{badge}</h2>",
        headline_box.box(statements),
        headline_box.table(headline.headlines(methods)),
        markup.note(f"{_basis(methods)} {wording.caution(methods)}"),
        *(["<h3>Which material it is</h3>", tables.accuracies(methods), markup.note(_pooled(plain)), caution]
          if plain else []),
        *([others, caution] if others else []),
        *([paired, markup.note(PAIRED), caution] if paired else []),
        *([swaps, caution] if swaps else []),
        *(["<h3>Fewer slides of one sensor</h3>", reduced, caution] if reduced else []),
        curves.few_slides(methods),
        zero_shot.table(methods),
        _training(methods),
        confusion.section(plain),
        latents.section(methods),
        profiles.section(slides),
        "<h3>All runs</h3>",
        tables.every_run(methods),
        caution,
        _source(methods),
    ]  # fmt: skip
    return "\n".join(part for part in parts if part) + "\n"


def _pooled(methods: Sequence[Method]) -> str:
    """Return what the table of accuracies of these methods holds."""
    runs = [run for one in methods for run in one.runs]
    published = all(one.published for one in methods)
    last = any(LAST in run.predictions.predicted for run in runs)
    described = [
        "Accuracy ± standard deviation over runs; in small print, slides named right of all that runs of the method were "
        "evaluated on, then the 95 % interval (Wilson) over slides, each counted once however many runs named it.",
        "Networks have the weights that did best in validation, unless the name states otherwise."
        if any(run.history for run in runs)
        else "",
        f"Last epoch is what the weights of the last one do{', which the paper’s code reports' if published else ''}."
        if last
        else "",
        "Skill is 1 − errors / errors of the mean level alone, a linear readout of the time-averaged channels."
        if any(LEVEL in run.predictions.predicted for run in runs)
        else "",
        "Mapping to a known space is reported for the sensor that was mapped to the other's."
        if any(one.settings["frozen_sensor"] for one in methods)
        else "",
        printed.BASIS if published else "",
    ]
    return " ".join(filter(None, described))


def _training(methods: Sequence[Method]) -> str:
    drawn = curves.convergence(methods) + curves.alignment(methods)
    return f"<h3>Training</h3>{drawn}" if drawn else ""


def _basis(methods: Sequence[Method]) -> str:
    """Return what all rests on: slides, training slides, and settings."""
    described = []
    for sensor in tables.sensors_of(methods):
        names = {
            str(name) for one in methods for run in one.of(sensor) for name in run.predictions.of(sensor).recordings
        }
        trained = sorted({run.learned[sensor] for one in methods for run in one.runs if sensor in run.learned})
        counts = f" after training on {markup.listed([f'{count:,}' for count in trained])}" if trained else ""
        described.append(f"{len(names):,} slides of {shown(sensor)}{counts}")
    settings, runs = {}, [run for one in methods for run in one.runs]
    for name in ("seed", "epochs"):
        values = {run.params[name] for run in runs if name in run.params and (name == "seed" or run.history)}
        if values:
            settings[name] = ", ".join(str(value) for value in sorted(values))
    shown_settings = "; ".join(f"{name} {values}" for name, values in settings.items())
    text = f"Evaluated on {markup.listed(described)}, none of which its model was trained on."
    return f"{text} Settings: {shown_settings}." if settings else text


def _source(methods: Sequence[Method]) -> str:
    """Return where the best method's first run comes from."""
    sensors = tables.sensors_of(methods)
    best = tables.leader([one for one in methods if one.plain] or methods, sensors[0]) if sensors else None
    if best is None:
        return ""
    run = best.of(sensors[0])[0]
    params = ", ".join(f"{name} = {json.dumps(value)}" for name, value in sorted(run.params.items()))
    described = markup.note(f"A run of {best.name}, the best on {shown(sensors[0])}, trained with {params}.")
    return described + provenance.section(run.dataset.manifest)
