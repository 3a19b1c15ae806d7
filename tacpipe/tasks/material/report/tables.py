"""The tables in which methods are next to each other."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tacpipe.comparison.runs import Method, Run
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Table
from tacpipe.tasks.material.report import comparison, printed, wording
from tacpipe.tasks.material.report.accuracy import accuracy
from tacpipe.tasks.material.report.methods import of, ordered, plain, sensors_of, shown
from tacpipe.tasks.material.report.predictions import MODEL, SWAPPED


def swaps(methods: Sequence[Method]) -> Table | None:
    """Return Table II: accuracy before and after classifiers are exchanged; None where none were."""
    held = [one for one in methods if plain(one.settings) or comparison.control(one)]
    held = [one for one in held if any(SWAPPED in each.predictions.predicted for each in one.details)]
    held = [one for one in held if not one.settings["frozen_sensor"]]
    sensors = sensors_of(held)
    rows: list[list[str | Cell]] = []
    for method in held:
        row: list[str | Cell] = [method.name]
        for sensor in sensors:
            runs = [run for run in of(method, sensor) if SWAPPED in run.details.predictions.predicted]
            lost = comparison.difference(method, method, sensor, (SWAPPED, MODEL))
            row += [wording.fraction(accuracy(runs, sensor, name)) for name in (MODEL, SWAPPED)]
            row.append(blocks.signed(lost.gain.mean, 1) if lost else NONE)
        rows.append([*row, str(len(method.runs))])
    if not rows:
        return None
    published = all(one.published for one in held)
    heads = ["", *(f"{shown(sensor)} {part}" for sensor in sensors for part in ("before", "after", "points")), "runs"]
    text = "accuracy (%) before and after the sensors' classifiers are exchanged"
    title = blocks.form("Table II", text, published)
    if not published:
        return blocks.table(title, heads, rows)
    printed_cells: list[str | Cell] = []
    for sensor in sensors:
        before, after = (one.get(sensor, math.nan) for one in (printed.ACCURACIES["RAEC joint"], printed.SWAPPED))
        printed_cells += [*(blocks.fixed(value, 2) for value in (before, after)), blocks.signed(after - before, 1)]
    rows.append(["paper: RAEC joint", *printed_cells, NONE])
    return blocks.table(title, heads, rows, {len(rows) - 1: "quiet"})


def differences(methods: Sequence[Method]) -> Table | None:
    """Return which method is ahead on the same slides, and how sure that is; None where none can be paired."""
    rows: list[list[str | Cell]] = []
    for pair in comparison.pairs(methods):
        for sensor in sensors_of([pair.first, pair.second]):
            found = comparison.difference(pair.first, pair.second, sensor)
            if found:
                cells: list[str | Cell] = [
                    blocks.interval(found.gain.mean, found.gain.low, found.gain.high, 1),
                    f"{found.slides}",
                    f"{found.first_only} : {found.second_only}",
                    blocks.p_value(found.mcnemar),
                    blocks.p_value(found.runs.p),
                    f"{found.runs.units} {found.runs.unit}" if found.runs.units else NONE,
                ]
                rows.append([f"{shown(sensor)}: {pair.name}", *cells])
    if not rows:
        return None
    heads = ["", "points", "slides", "only one right", "McNemar p", "paired t p", "paired over"]
    return blocks.table("Paired comparisons: the first method minus the second, on the same slides", heads, rows)


def about_run(run: Run) -> dict[str, str | Cell]:
    """Return more columns of the table of runs: slides learned from, epochs and seconds."""
    result = run.details
    learned = " + ".join(f"{count}" for _, count in sorted(result.learned.items()))
    kept = result.config.get("validation", {}).get("epoch", {}) if result.history else {}
    described = dict.fromkeys(kept[sensor] for sensor in ordered(kept))  # one where sensors were learned jointly
    seconds = f"{float(result.config['seconds']):,.0f}" if "seconds" in result.config else NONE
    return {
        "slides learned from": learned or NONE,
        "kept epoch": " / ".join(str(epoch) for epoch in described) or NONE,
        "epochs": str(len(result.history) or NONE),
        "seconds": seconds,
    }
