"""The tables in which methods are next to each other."""

from __future__ import annotations

from collections.abc import Sequence

from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Table
from tacpipe.report.material import comparison, printed, wording
from tacpipe.report.material.accuracy import accuracy
from tacpipe.report.material.methods import Method, Run, ordered, shown
from tacpipe.report.material.predictions import MODEL, SWAPPED


def swaps(methods: Sequence[Method]) -> Table | None:
    """Return Table II: accuracy before and after classifiers are exchanged; None where none were."""
    held = [one for one in methods if any(SWAPPED in run.predictions.predicted for run in one.runs)]
    held = [one for one in held if (one.plain or comparison.control(one)) and not one.settings["frozen_sensor"]]
    sensors = sensors_of(held)
    rows: list[list[str | Cell]] = []
    for method in held:
        row: list[str | Cell] = [method.name]
        for sensor in sensors:
            runs = [run for run in method.of(sensor) if SWAPPED in run.predictions.predicted]
            lost = comparison.difference(runs, runs, sensor, (SWAPPED, MODEL))
            row += [wording.fraction(accuracy(runs, sensor, name)) for name in (MODEL, SWAPPED)]
            row.append(wording.points(lost.mean) if lost else NONE)
        rows.append([*row, str(len(method.runs))])
    if not rows:
        return None
    published = all(one.published for one in held)
    heads = ["", *(f"{shown(sensor)} {part}" for sensor in sensors for part in ("before", "after", "points")), "runs"]
    text = "accuracy (%) before and after the sensors' classifiers are exchanged"
    title = wording.form("Table II", text, published)
    if not published:
        return blocks.table(title, heads, rows)
    cells: list[str | Cell] = []
    for sensor in sensors:
        before, after = printed.ACCURACIES["RAEC joint"].get(sensor), printed.SWAPPED.get(sensor)
        described = [NONE] * 3 if before is None or after is None else [f"{before:.2f}", f"{after:.2f}"]
        cells += (
            described if len(described) == 3 else [*described, wording.points(((after or 0) - (before or 0)) / 100)]
        )
    rows.append(["paper: RAEC joint", *cells, NONE])
    return blocks.table(title, heads, rows, {len(rows) - 1: "quiet"})


def differences(methods: Sequence[Method]) -> Table | None:
    """Return which method is ahead on the same slides, and how sure that is; None where none can be paired."""
    rows: list[list[str | Cell]] = []
    for pair in comparison.pairs(methods):
        for sensor in sensors_of([pair.first, pair.second]):
            found = comparison.difference(pair.first.of(sensor), pair.second.of(sensor), sensor)
            if found:
                rows.append(
                    [
                        f"{shown(sensor)}: {pair.name}",
                        wording.points_within(found.mean, found.low, found.high),
                        f"{found.slides}",
                        f"{found.first_only} : {found.second_only}",
                        wording.p_value(found.mcnemar),
                        wording.p_value(found.paired),
                        f"{found.units} {found.unit}" if found.units else NONE,
                    ]
                )
    if not rows:
        return None
    heads = ["", "points", "slides", "only one right", "McNemar p", "paired t p", "paired over"]
    return blocks.table("Paired comparisons: the first method minus the second, on the same slides", heads, rows)


def about_run(run: Run) -> dict[str, str]:
    """Return more columns of the table of runs: slides learned from, epochs and seconds."""
    trained = " + ".join(f"{count}" for _, count in sorted(run.learned.items()))
    kept, epochs = _epochs(run)
    seconds = f"{float(run.config['seconds']):,.0f}" if "seconds" in run.config else NONE
    return {"slides learned from": trained or NONE, "kept epoch": kept, "epochs": epochs, "seconds": seconds}


def sensors_of(methods: Sequence[Method]) -> tuple[str, ...]:
    """Return the sensors that any of some methods was evaluated on."""
    return ordered({sensor for method in methods for sensor in method.sensors})


def leader(methods: Sequence[Method], sensor: str) -> Method | None:
    """Return the method that names most slides of a sensor right; of two that name as many, the first."""
    scores = [(found.fraction, one) for one in methods if (found := accuracy(one.of(sensor), sensor))]
    return max(scores, key=lambda score: score[0])[1] if scores else None


def _epochs(run: Run) -> list[str]:
    """Return the epoch whose weights were kept and the number of epochs."""
    if not run.history:
        return [NONE, NONE]
    kept = run.config.get("validation", {}).get("epoch", {})
    described = dict.fromkeys(kept[sensor] for sensor in ordered(set(kept)))  # one where sensors were learned jointly
    return [" / ".join(str(epoch) for epoch in described) or NONE, str(len(run.history))]
