"""Report the effect of joint learning, in tables of the paper's form with its published numbers."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.metrics.intervals import wilson
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Fold, SmallPrint, Table, number, p_value, signed
from tacpipe.report.context import SHORTENED
from tacpipe.tasks.material.headline import HeldOutAccuracy, ZeroShotAccuracy
from tacpipe.tasks.material.report import figures, scores
from tacpipe.tasks.material.report.methods import (
    ComparedRun,
    Method,
    has_usual_settings,
    ordered_sensors,
    runs_on,
    sensor_title,
    sensors_of,
    slides_kept,
)
from tacpipe.tasks.material.report.predictions import MODEL, SWAPPED
from tacpipe.tasks.material.report.scores import Accuracy, MethodDifference, accuracy

ACCURACIES: Mapping[str, Mapping[str, float]] = {  # Table I
    "X-LSTM": {"biotac": 94.50, "roboskin": 90.00},
    "RAEC independent": {"biotac": 95.31, "roboskin": 91.14},
    "RAEC joint": {"biotac": 96.01, "roboskin": 93.23},
    "mapping to known space": {"biotac": 94.79, "roboskin": 91.67},
}
PRINTED_SWAPPED: Mapping[str, float] = {"biotac": 95.31, "roboskin": 93.23}  # Table II; before are those of RAEC joint
RATIOS = (90, 50, 25, 17, 11)
# Tables III and IV, by the sensor whose slides were reduced: joint BioTac, joint RoboSkin, that sensor independent
REDUCED: Mapping[str, Mapping[int, tuple[float, float, float]]] = {
    "biotac": {
        90: (94.27, 93.75, 93.75),
        50: (90.63, 93.23, 91.67),
        25: (83.33, 93.75, 86.46),
        17: (77.08, 91.67, 78.65),
        11: (70.31, 92.19, 69.79),
    },
    "roboskin": {
        90: (94.27, 91.15, 90.62),
        50: (96.88, 86.98, 82.29),
        25: (96.88, 73.96, 71.35),
        17: (94.28, 58.85, 57.81),
        11: (96.88, 45.31, 46.35),
    },
}
PRINTED_BASIS = (
    "The numbers of the paper are quoted as printed. Nearly all are whole numbers of 192 slides, so one of its "
    "runs has an uncertainty of about 3 points (two standard errors) at 95 %. The numbers for its reduced sets "
    "come from single runs."
)


MAX_DISTANCE_RATIO = 2.0  # latents of permuted pairs count as equally close as those of real pairs up to this factor
MAX_SWAP_LOSS = 0.2  # loss of accuracy with exchanged classifiers above which sensors are not aligned
MAX_EXTRA_SWAP_LOSS = 0.05  # additional loss of accuracy with exchanged classifiers compared with real pairs
NO_CONTROL = (
    "The results contain no run with permuted materials, so it was not tested whether only labels drive the alignment."
)


def joint_effects(methods: Sequence[Method]) -> list[str]:
    """Return sentences on the effect of joint learning and the result of its control; empty without a joint method."""
    main = scores.main_method(methods)
    if main is None:
        return []
    return [
        *_joint_gain(main, scores.independent_method(methods, main)),
        describe_control(main, scores.permuted_method(methods, main)),
    ]


def describe_control(joint: Method, permuted: Method | None) -> str:
    """Return sentences on whether the alignment of real pairs is better than that of pairs of permuted materials."""
    if permuted is None:
        return NO_CONTROL
    alignments = [_last_alignment(item) for item in (joint, permuted)]
    swaps = [_swapped_accuracy(item) for item in (joint, permuted)]
    if any(math.isnan(item) for item in alignments) or not swaps[0] or set(swaps[0]) - set(swaps[1]):
        return (
            "The run with permuted materials has neither a latent difference nor exchanged classifiers, so it cannot "
            "be evaluated."
        )
    costs: list[dict[str, float]] = []  # loss of accuracy by exchanging classifiers, by sensor
    for method, swapped in zip((joint, permuted), swaps, strict=True):
        before = {sensor: accuracy(runs_on(method, sensor), sensor) for sensor in swaps[0]}
        costs.append({name: own.fraction - swapped[name].fraction for name, own in before.items() if own})
    if max(costs[0].values()) > MAX_SWAP_LOSS:
        return (
            "Even real pairs are not aligned: with exchanged classifiers, the accuracy is "
            f"{100 * max(costs[0].values()):.1f} points lower than with the sensors' own, so there is nothing to "
            "compare the control with."
        )
    aligns_as_well = alignments[1] <= MAX_DISTANCE_RATIO * alignments[0]
    swaps_as_well = all(costs[1][sensor] - costs[0][sensor] <= MAX_EXTRA_SWAP_LOSS for sensor in costs[0])
    numbers = (
        f"latent difference {number(alignments[1]).text} against {number(alignments[0]).text}; classifiers exchanged: "
        + ", ".join(
            f"{sensor_title(sensor)} {scores.format_percent(swaps[1][sensor].fraction)} % against "
            f"{scores.format_percent(with_real_pairs.fraction)} %"
            for sensor, with_real_pairs in swaps[0].items()
        )
    )
    if aligns_as_well and swaps_as_well:
        return (
            "The alignment is driven by labels: pairs of permuted materials align as well, and exchanged "
            f"classifiers lose about as little accuracy ({numbers}), so neither shows that the sensors have more "
            "in common than labels."
        )
    half = "align as well but do not swap as well" if aligns_as_well else "swap as well but do not align as well"
    verdict = half if aligns_as_well or swaps_as_well else "neither align nor swap as well"
    return f"Pairs of permuted materials {verdict} as real ones ({numbers})."


def _joint_gain(joint: Method, independent: Method | None) -> list[str]:
    """Return the gain of joint learning, one sentence per sensor."""
    if independent is None:
        return ["The results contain no independently trained RAEC, so the effect of joint learning was not tested."]
    sentences = []
    for sensor in sensors_of([joint]):
        difference = scores.compare_runs(joint, independent, sensor)
        if difference:
            verb = {
                "better": f"helps RAEC on {sensor_title(sensor)}",
                "worse": f"hurts RAEC on {sensor_title(sensor)}",
                "unclear": f"makes no difference to RAEC on {sensor_title(sensor)} that these slides could show",
            }[difference.word]
            sentences.append(f"Joint learning {verb}: {_describe_difference(difference)}.")
    return sentences


def _describe_difference(difference: MethodDifference) -> str:
    """Return the gain of one method over another with its interval and the tests, as text."""
    tests = [f"McNemar p = {p_value(difference.mcnemar).text}"]
    if not math.isnan(difference.runs.p):
        tests.append(
            f"paired t over {difference.runs.units} {difference.runs.unit} p = {p_value(difference.runs.p).text}"
        )
    mean, low, high = (signed(bound, 1) for bound in (difference.gain.mean, difference.gain.low, difference.gain.high))
    return (
        f"{mean} points (95 % interval {low} to {high}) on the same {difference.slides} slides, {', '.join(tests)}"
    ).replace("= <", "<")


def _last_alignment(method: Method) -> float:
    """Return the latent difference after the last epoch, averaged over runs."""
    last = [curve[-1] for result in method.details if (curve := figures.alignment_by_epoch(result))]
    return float(np.mean(last)) if last else float("nan")


def _swapped_accuracy(method: Method) -> dict[str, Accuracy]:
    accuracies = {sensor: accuracy(runs_on(method, sensor), sensor, SWAPPED) for sensor in sensors_of([method])}
    return {sensor: result for sensor, result in accuracies.items() if result}


def swap_table(methods: Sequence[Method]) -> Table | None:
    """Return Table II, the accuracy before and after exchanging classifiers; None if they were not exchanged."""
    usual_methods = [item for item in methods if has_usual_settings(item.settings) or scores.is_control(item)]
    candidates = [
        item
        for item in usual_methods
        if not item.settings["frozen_sensor"]
        and any(SWAPPED in result.predictions.predicted for result in item.details)
    ]
    sensors = sensors_of(candidates)
    rows: list[list[str | Cell]] = []
    for method in candidates:
        row: list[str | Cell] = [method.name]
        for sensor in sensors:
            runs = [run for run in runs_on(method, sensor) if SWAPPED in run.details.predictions.predicted]
            lost = scores.compare_runs(method, method, sensor, (SWAPPED, MODEL))
            row += [scores.accuracy_cell(accuracy(runs, sensor, name)) for name in (MODEL, SWAPPED)]
            row.append(blocks.signed(lost.gain.mean, 1) if lost else NONE)
        rows.append([*row, str(len(method.runs))])
    if not rows:
        return None
    published = all(item.published for item in candidates)
    heads = [
        "",
        *(f"{sensor_title(sensor)} {part}" for sensor in sensors for part in ("before", "after", "points")),
        "runs",
    ]
    text = "accuracy (%) before and after the sensors' classifiers are exchanged"
    title = blocks.form("Table II", text, published)
    if not published:
        return blocks.table(title, heads, rows)
    printed_cells: list[str | Cell] = []
    for sensor in sensors:
        before, after = ACCURACIES["RAEC joint"].get(sensor, math.nan), PRINTED_SWAPPED.get(sensor, math.nan)
        printed_cells += [blocks.fixed(before, 2), blocks.fixed(after, 2), blocks.signed(after - before, 1)]
    rows.append(["paper: RAEC joint", *printed_cells, NONE])
    return blocks.table(title, heads, rows, {len(rows) - 1: "quiet"})


def difference_table(methods: Sequence[Method]) -> Table | None:
    """Return a table of paired differences between methods on the slides they share; None if no methods can be paired."""
    rows: list[list[str | Cell]] = []
    for pair in scores.method_pairs(methods):
        for sensor in sensors_of([pair.first, pair.second]):
            difference = scores.compare_runs(pair.first, pair.second, sensor)
            if difference:
                cells: list[str | Cell] = [
                    blocks.interval(difference.gain.mean, difference.gain.low, difference.gain.high, 1),
                    f"{difference.slides}",
                    f"{difference.first_only} : {difference.second_only}",
                    blocks.p_value(difference.mcnemar),
                    blocks.p_value(difference.runs.p),
                    f"{difference.runs.units} {difference.runs.unit}" if difference.runs.units else NONE,
                ]
                rows.append([f"{sensor_title(sensor)}: {pair.name}", *cells])
    if not rows:
        return None
    heads = ["", "points", "slides", "only one right", "McNemar p", "paired t p", "paired over"]
    return blocks.table("Paired comparisons: the first method minus the second, on the same slides", heads, rows)


def run_columns(run: ComparedRun) -> dict[str, str | Cell]:
    """Return additional columns of the table of runs: training slides and epochs."""
    result = run.details
    learned = " + ".join(f"{count}" for _, count in sorted(result.learned.items()))
    best_epochs = result.config.get("validation", {}).get("epoch", {}) if result.history else {}
    # a single value if sensors were learned jointly
    slide_counts = dict.fromkeys(best_epochs[sensor] for sensor in ordered_sensors(best_epochs))
    return {
        "slides learned from": learned or NONE,
        "kept epoch": " / ".join(str(epoch) for epoch in slide_counts) or NONE,
        "epochs": str(len(result.history) or NONE),
    }


TABLE_NUMBERS = {"biotac": "III", "roboskin": "IV"}
SAME_COUNT = 0.92  # numbers of slides count as equal above this ratio
BATCH = 32  # batch size of the paper
JOINT, ALONE, OURS = "RAEC joint", "RAEC independent", "MiniRocket"


def reduction_tables(methods: Sequence[Method]) -> list[Table]:
    """Return one table per reduced sensor in the form of the paper, if the data are the paper's.

    A sensor is reduced if it learns from a fraction of the batches, as in the paper, or if its split has fewer slides
    than the other's. If both were run, the paper's method is used.
    """
    candidates = [method for method in methods if has_usual_settings(method.settings, "subsample_sensor", "few")]
    if not all(method.published for method in candidates):
        return []
    joint_methods = [method for method in candidates if method.family == JOINT]
    reduced_sensors = {
        str(method.settings[name]) for method in joint_methods for name in ("subsample_sensor", "few_of")
    }
    return [_reduction_table(candidates, sensor) for sensor in TABLE_NUMBERS if sensor in reduced_sensors]


def _reduction_table(methods: Sequence[Method], reduced: str) -> Table:
    """Return the table of a reduced sensor: accuracies by fraction of its slides, next to those of the paper."""
    columns = [(JOINT, "biotac"), (JOINT, "roboskin"), (ALONE, reduced)]
    all_slides = max(run.trained.get(reduced, 0) for candidate in methods for run in candidate.details)
    rows = []
    for ratio in RATIOS:
        slides = slides_kept(all_slides, BATCH, ratio)
        comparable = [
            candidate
            for candidate in methods
            if (candidate.settings["subsample_sensor"], candidate.settings["subsample_percent"]) == (reduced, ratio)
        ]
        fewer = [
            candidate for candidate in methods if candidate.settings["few"] and _has_as_many(candidate, slides, reduced)
        ]
        row: list[str | Cell] = [f"{ratio} %", str(slides)]
        for (kind, sensor), paper in zip(columns, REDUCED[reduced][ratio], strict=True):
            same_kind = [candidate for candidate in comparable if candidate.family == kind] or [
                candidate
                for candidate in fewer
                if candidate.family == kind and (kind != JOINT or candidate.settings["few_of"] == reduced)
            ]
            row += [_reduction_cell(same_kind, sensor), f"{paper:.2f}"]
        rows.append([*row, _reduction_cell([candidate for candidate in fewer if candidate.family == OURS], reduced)])
    heads = ["share kept", "slides"]
    for kind, sensor in columns:
        epochs = {str(method.settings.get(SHORTENED, "")) for method in methods if method.family == kind} - {""}
        name = " ".join([kind.removeprefix("RAEC "), *(f"({text})" for text in sorted(epochs))])
        heads += [f"{name}, {sensor_title(sensor)}", "paper"]
    title = (
        f"Table {TABLE_NUMBERS[reduced]} in the paper's form: accuracy (%) where {sensor_title(reduced)} has fewer "
        f"training slides"
    )
    return blocks.table(title, [*heads, f"{OURS}, {sensor_title(reduced)}"], rows)


def _reduction_cell(methods: Sequence[Method], sensor: str) -> str | Cell:
    """Return the accuracy of the method with the most runs; a dash without methods."""
    method_with_most_runs = max(methods, key=lambda method: len(runs_on(method, sensor)), default=None)
    if method_with_most_runs is None:
        return NONE
    return scores.accuracy_cell(accuracy(runs_on(method_with_most_runs, sensor), sensor))


def _has_as_many(method: Method, slides: int, sensor: str) -> bool:
    """Return whether a method learned from approximately this number of a sensor's slides."""
    slide_counts = [run.details.learned[sensor] for run in runs_on(method, sensor) if sensor in run.details.learned]
    return bool(slide_counts) and SAME_COUNT < max(slide_counts) / slides < 1 / SAME_COUNT


ZERO_SHOT_NOTE = (
    "The labels and pairs of these materials were excluded from training for this sensor. The classifier of the "
    "other sensor predicts them from the latents, among all materials or only among the held-out ones. Only an "
    "accuracy above chance is evidence of information that the sensors have in common. Slides of one material "
    "are not independent, so the interval is over held-out materials, not over slides or runs. "
)


@dataclass(frozen=True)
class HeldOut:
    """Runs that differ only in seed, fold, and in the materials held out of a sensor's labels."""

    name: str
    kind: str
    main: bool  # True if nothing else distinguishes them
    sensor: str
    results: tuple[ZeroShotAccuracy, ...]  # accuracy on the held-out materials of each run
    materials: int  # number of materials held out in any run


def zero_shot_folds(methods: Sequence[Method]) -> list[Fold]:
    """Return sections on the classification of held-out materials across sensors; empty if none were held out."""
    rows: list[list[str | Cell]] = []
    for group in held_out_methods(methods):
        rows.append(
            [
                f"{group.name}, out of all",
                sensor_title(group.sensor),
                *_zero_shot_cells(group.results, group.sensor, group.materials),
            ]
        )
        among_held_out = [result["among_held_out"] for result in group.results if "among_held_out" in result]
        if among_held_out:
            cells = _zero_shot_cells(among_held_out, group.sensor, group.materials)
            rows.append([f"{group.name}, out of those held out", sensor_title(group.sensor), *cells])
    if not rows:
        return []
    heads = ["", "slides of", "accuracy (%)", "chance (%)", "runs"]
    table = blocks.table("Zero shot: accuracy on held-out materials", heads, rows)
    return blocks.fold(
        "Materials that one sensor was not trained on",
        table,
        SmallPrint(ZERO_SHOT_NOTE),
        *map(SmallPrint, zero_shot_sentences(methods)),
    )


def zero_shot_sentences(methods: Sequence[Method]) -> list[str]:
    """Return whether one sensor's classifier recognises materials that the other did not learn; by method and sensor."""
    sentences = []
    for group in held_out_methods(methods):
        correct, evaluated, low, high = _zero_shot_counts(group.results, group.sensor, group.materials)
        if not evaluated or not group.main:
            continue
        chance = group.results[0]["chance"][group.sensor]
        verdict = "which cannot be distinguished from chance"
        if low > chance:
            verdict = "above chance"
        elif high < chance:
            verdict = "below chance"
        sentences.append(
            f"Of {sensor_title(group.sensor)} slides of materials that it never learned, the other sensor's classifier "
            f"names {scores.format_percent(correct / evaluated)} % right ({group.kind}, {correct} of {evaluated}; "
            f"95 % interval {scores.format_percent(low)} to {scores.format_percent(high)} %), "
            f"{verdict} ({scores.format_percent(chance)} %)."
        )
    return sentences


def held_out_methods(methods: Sequence[Method]) -> list[HeldOut]:
    """Return the runs with held-out materials by sensor and group of methods that differ only in these materials."""
    groups: dict[str, list[Method]] = {}
    for method in methods:
        if any("zero_shot" in result.metrics for result in method.details):
            groups.setdefault(method.key_without("hold_out"), []).append(method)
    scored_methods = []
    for similar_methods in groups.values():
        runs: list[tuple[ZeroShotAccuracy, Method]] = []
        for method in similar_methods:
            scored = [result.metrics["zero_shot"] for result in method.details if "zero_shot" in result.metrics]
            runs += [(accuracies, method) for accuracies in scored]
        for sensor in dict.fromkeys(name for tree, _ in runs for name in tree["accuracy"]):
            evaluated = [(tree, method) for tree, method in runs if sensor in tree["accuracy"]]
            first = evaluated[0][1]
            sets = {str(method.settings["hold_out"]) for _, method in evaluated}
            name = first.name if len(sets) == 1 else f"{first.family} · {len(sets)} sets of materials in turn"
            trees = tuple(tree for tree, _ in evaluated)
            main = has_usual_settings(first.settings, "hold_out")
            scored_methods.append(HeldOut(name, first.family, main, sensor, trees, _count_held_out(sets, sensor)))
    return scored_methods


def _zero_shot_counts(results: Sequence[HeldOutAccuracy], sensor: str, materials: int) -> tuple[int, int, float, float]:
    """Return the correct and total number of slides, and the bounds of the accuracy's interval; NaN without slides.

    Slides of one material are not independent, even by chance and over several runs. So the number of trials is the
    number of held-out ``materials``.
    """
    correct = sum(result["correct"].get(sensor, 0) for result in results)
    evaluated = sum(result["n"].get(sensor, 0) for result in results)
    if not evaluated:
        return 0, 0, float("nan"), float("nan")
    return correct, evaluated, *wilson(round(correct / evaluated * materials), materials)


def _count_held_out(sets: Collection[str], sensor: str) -> int:
    """Return the number of materials held out of a sensor's labels by any of the settings, each like ``roboskin=17,18``."""
    parts = (part.strip().partition("=") for setting in sets for part in setting.split(";"))
    held_out = {material.strip() for name, _, described in parts if name == sensor for material in described.split(",")}
    return max(len(held_out - {""}), 1)


def _zero_shot_cells(results: Sequence[HeldOutAccuracy], sensor: str, materials: int) -> list[str | Cell]:
    """Return the cells for the held-out materials of one sensor: its accuracy, chance, and the number of runs."""
    correct, evaluated, low, high = _zero_shot_counts(results, sensor, materials)
    if not evaluated:
        return [NONE, NONE, str(len(results))]
    spread = (
        float(np.std([result["accuracy"][sensor] for result in results], ddof=1)) if len(results) > 1 else float("nan")
    )
    chance = float(np.mean([result["chance"][sensor] for result in results]))
    cell = scores.count_cell(correct, evaluated, low, high, spread)
    return [cell, scores.format_percent(chance), str(len(results))]
