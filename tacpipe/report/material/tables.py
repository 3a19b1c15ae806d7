"""The tables in which methods are next to each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.report import markup
from tacpipe.report.markup import NONE
from tacpipe.report.material import comparison, printed, wording
from tacpipe.report.material.accuracy import accuracy, skill
from tacpipe.report.material.methods import Method, Run, ordered, shown
from tacpipe.report.material.predictions import LAST, LEVEL, MODEL, SHUFFLED, SWAPPED

ORDER = ("X-LSTM", "RAEC independent", "RAEC joint", "mapping to known space")
BASELINES = {LEVEL: "mean level alone", SHUFFLED: "trained on shuffled labels"}


def accuracies(methods: Sequence[Method]) -> str:
    """Return accuracy and skill of each method and baseline; where the slides are the paper's, as its Table I has them."""
    plain = [one for one in methods if one.plain]
    published = all(one.published for one in plain)
    last = published or any(LAST in run.predictions.predicted for one in plain for run in one.runs)
    parts = ["", *(["last epoch"] if last else []), "skill", *(["paper"] if published else [])]
    sensors = sensors_of(plain)
    rows: list[list[str]] = []
    kinds: dict[int, str] = {}
    best = {sensor: top for sensor in sensors if (top := leader(plain, sensor))}
    for kind in [*ORDER, *sorted({one.kind for one in plain} - set(ORDER))]:
        same = [one for one in plain if one.kind == kind]
        for method in same:
            if method in best.values():
                kinds[len(rows)] = "best"
            rows.append([method.name, *_row(method, sensors, kind, parts), str(len(method.runs))])
        if not same and published:
            blank = [NONE] * (len(parts) - 1)
            rows.append([kind, *[cell for sensor in sensors for cell in [*blank, _paper(kind, sensor)]], "0"])
    source = reference(plain)
    for predictor, name in BASELINES.items():
        cells = []
        for sensor in sensors:
            found = accuracy(source.of(sensor), sensor, predictor)
            described = markup.decimals(skill(source.of(sensor), sensor, predictor)) if found else NONE
            values = {"": wording.fraction(found), "skill": described.replace("+nan", NONE)}
            cells += [values.get(part, NONE) for part in parts]
        kinds[len(rows)] = "quiet"
        rows.append([name, *cells, str(len(source.runs))])
    kinds[len(rows)] = "quiet"
    chance = wording.percent(1 / max(len(source.runs[0].config.get("classes", ())), 1))
    rows.append(["chance", *[cell for _ in sensors for cell in (chance, *[NONE] * (len(parts) - 1))], NONE])
    heads = ["", *(f"{shown(sensor)} {part}".strip() for sensor in sensors for part in parts), "runs"]
    return markup.table(wording.form("Table I", "accuracy (%)", published), heads, rows, kinds)


def elsewhere(methods: Sequence[Method]) -> str:
    """Return accuracies on other splits and layouts than most results have; empty where there are none."""
    others = [one for one in methods if not one.plain and one.differs_only("elsewhere")]
    sensors = sensors_of(others)
    rows = []
    for method in others:
        described = [method.of(sensor) for sensor in sensors]
        cells = [
            cell
            for sensor, runs in zip(sensors, described, strict=True)
            for cell in (
                wording.fraction(accuracy(runs, sensor)),
                wording.fraction(accuracy(runs, sensor, LEVEL)),
                markup.decimals(skill(runs, sensor)).replace("+nan", NONE),
            )
        ]
        rows.append([method.name, *cells, str(len(method.runs))])
    if not rows:
        return ""
    parts = ("", "mean level", "skill")
    heads = ["", *(f"{shown(sensor)} {part}".strip() for sensor in sensors for part in parts), "runs"]
    return markup.table("Other splits and layouts: accuracy (%)", heads, rows)


def swaps(methods: Sequence[Method]) -> str:
    """Return Table II: accuracy before and after classifiers are exchanged; empty where none were."""
    held = [one for one in methods if any(SWAPPED in run.predictions.predicted for run in one.runs)]
    held = [one for one in held if (one.plain or comparison.control(one)) and not one.settings["frozen_sensor"]]
    sensors = sensors_of(held)
    rows = []
    for method in held:
        row = [method.name]
        for sensor in sensors:
            runs = [run for run in method.of(sensor) if SWAPPED in run.predictions.predicted]
            lost = comparison.difference(runs, runs, sensor, (SWAPPED, MODEL))
            row += [wording.fraction(accuracy(runs, sensor, name)) for name in (MODEL, SWAPPED)]
            row.append(wording.points(lost.mean) if lost else NONE)
        rows.append([*row, str(len(method.runs))])
    if not rows:
        return ""
    published = all(one.published for one in held)
    heads = ["", *(f"{shown(sensor)} {part}" for sensor in sensors for part in ("before", "after", "points")), "runs"]
    text = "accuracy (%) before and after the sensors' classifiers are exchanged"
    title = wording.form("Table II", text, published)
    if not published:
        return markup.table(title, heads, rows)
    cells = []
    for sensor in sensors:
        before, after = printed.ACCURACIES["RAEC joint"].get(sensor), printed.SWAPPED.get(sensor)
        described = [NONE] * 3 if before is None or after is None else [f"{before:.2f}", f"{after:.2f}"]
        cells += (
            described if len(described) == 3 else [*described, wording.points(((after or 0) - (before or 0)) / 100)]
        )
    rows.append(["paper: RAEC joint", *cells, NONE])
    return markup.table(title, heads, rows, {len(rows) - 1: "quiet"})


def differences(methods: Sequence[Method]) -> str:
    """Return which method is ahead on the same slides, and how sure that is; empty where none can be paired."""
    rows = []
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
        return ""
    heads = ["", "points", "slides", "only one right", "McNemar p", "paired t p", "paired over"]
    return markup.table("Paired comparisons: the first method minus the second, on the same slides", heads, rows)


def every_run(methods: Sequence[Method]) -> str:
    """Return one row a run."""
    sensors = sensors_of(methods)
    rows = []
    for method in methods:
        for run in sorted(
            method.runs, key=lambda run: (str(run.config.get("fold", "")), str(run.params.get("seed", "")))
        ):
            trained = " + ".join(f"{count}" for _, count in sorted(run.learned.items()))
            rows.append(
                [
                    method.name,
                    str(run.config.get("fold", NONE)),
                    str(run.params.get("seed", NONE)),
                    trained or NONE,
                    *_accuracies_of(run, sensors),
                    *_epochs(run),
                    f"{float(run.config['seconds']):,.0f}" if "seconds" in run.config else NONE,
                ]
            )
    evaluated = [f"{shown(sensor)} {part}" for sensor in sensors for part in ("(%)", "slides")]
    heads = ["", "fold", "seed", "slides learned from", *evaluated, "kept epoch", "epochs", "seconds"]
    return f"<details><summary>All {len(rows)} runs</summary>{markup.table('Each run', heads, rows)}</details>"


def sensors_of(methods: Sequence[Method]) -> tuple[str, ...]:
    """Return the sensors that any of some methods was evaluated on."""
    return ordered({sensor for method in methods for sensor in method.sensors})


def leader(methods: Sequence[Method], sensor: str) -> Method | None:
    """Return the method that names most slides of a sensor right; of two that name as many, the first."""
    scores = [(found.fraction, one) for one in methods if (found := accuracy(one.of(sensor), sensor))]
    return max(scores, key=lambda score: score[0])[1] if scores else None


def reference(methods: Sequence[Method]) -> Method:
    """Return the method whose runs report on the baselines, which are nearly the same for all of a split.

    It has most baselines, and if it can be it is the one whose shuffled labels went through the strongest readout.
    """

    def place(one: Method) -> tuple[int, bool, int]:
        predicted = {(name, sensor) for run in one.runs for name in run.predictions.predicted for sensor in run.sensors}
        return sum(name in BASELINES for name, _ in predicted), one.kind == "MiniRocket", len(one.runs)

    return max(methods, key=place)


def _row(method: Method, sensors: Sequence[str], kind: str, parts: Sequence[str]) -> list[str]:
    """Return what the table of accuracies states of a method, a cell a sensor and part."""
    cells = []
    for sensor in sensors:
        runs = method.of(sensor)
        found = accuracy(runs, sensor)
        last = accuracy(runs, sensor, LAST)
        worth = skill(runs, sensor)
        described = {
            "": wording.fraction(found),
            "last epoch": wording.percent(last.fraction) if last else NONE,
            "skill": NONE if np.isnan(worth) else markup.decimals(worth),
            "paper": _paper(kind, sensor) if found else NONE,
        }
        cells += [described[part] for part in parts]
    return cells


def _paper(kind: str, sensor: str) -> str:
    value = printed.ACCURACIES.get(kind, {}).get(sensor)
    return NONE if value is None else f"{value:.2f}"


def _accuracies_of(run: Run, sensors: Sequence[str]) -> list[str]:
    cells = []
    for sensor in sensors:
        found = accuracy([run], sensor)
        cells += [wording.percent(found.fraction), str(found.evaluated)] if found else [NONE, NONE]
    return cells


def _epochs(run: Run) -> list[str]:
    """Return the epoch whose weights were kept and the number of epochs."""
    if not run.history:
        return [NONE, NONE]
    kept = run.config.get("validation", {}).get("epoch", {})
    described = dict.fromkeys(kept[sensor] for sensor in ordered(set(kept)))  # one where sensors were learned jointly
    return [" / ".join(str(epoch) for epoch in described) or NONE, str(len(run.history))]
