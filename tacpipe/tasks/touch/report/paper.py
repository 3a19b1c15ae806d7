"""Compare methods in tables of the paper's form (RA-L 2020), with the published numbers next to ours."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Block, Cell, Chart, SmallPrint, Table
from tacpipe.report.charts import Dot
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.headline import MODEL, OBJECT_MEAN
from tacpipe.tasks.touch.params import DEFAULT, PAPER
from tacpipe.tasks.touch.report import predictions
from tacpipe.tasks.touch.report.methods import (
    BASELINES,
    Method,
    baseline_name,
    caution,
    describe_training,
    one_per_architecture,
    predicted_targets,
)
from tacpipe.tasks.touch.report.predictions import GraspPredictions, Score

HEADS: Mapping[object, tuple[float, float]] = {  # Table I
    "fc1": (0.02598, 0.00043),
    "fc2": (0.02586, 0.00084),
    "fc3": (0.02570, 0.00076),
    "fc4": (0.02744, 0.00069),
    "fc5": (0.02652, 0.00092),
    "fc6": (0.02660, 0.00062),
}
POINT_COUNTS: Mapping[object, tuple[float, float]] = {  # Table II
    250: (0.03010, 0.00105),
    500: (0.02790, 0.00115),
    750: (0.02717, 0.00134),
}
EPOCH_S: Mapping[object, int] = {250: 8, 500: 14, 750: 21}  # Table II, seconds per epoch
NORMALISATIONS: Mapping[object, tuple[float, float]] = {  # Table III
    "none": (0.01859, 0.00065),
    "sphere": (0.01183, 0.00073),
    "minmax": (0.01141, 0.00076),
    "wrist": (0.02260, 0.00100),
}
ROTATIONS: Mapping[object, tuple[float, float]] = {  # Table IV
    0: (0.01141, 0.00076),
    45: (0.02026, 0.00073),
    90: (0.02545, 0.00094),
    135: (0.02788, 0.00109),
    180: (0.02671, 0.00073),
}


@dataclass(frozen=True)
class Final:
    """RMSE on the test set and on novel objects, in fractions of the target's range and in device counts."""

    test: float
    test_counts: int
    novel: float
    novel_counts: int
    change: int  # in percent


TEST_AND_NOVEL: Mapping[str, Final] = {  # Figures 10 and 11
    "pdc_th": Final(0.05496, 49, 0.08289, 74, 51),
    "pdc_mf": Final(0.06170, 43, 0.10650, 74, 73),
    "e_th": Final(0.06099, 213, 0.08724, 305, 43),
    "e_mf": Final(0.05922, 195, 0.10317, 340, 74),
}
TRAINED_ON = (
    "The columns of the paper are for RGBPose, trained on 9,000 grasps of its 12 objects (12,000 for novel "
    "ones). Ours are for the inputs and training grasps of these runs. The error of a constant differs between "
    "the two sets."
)
SCALES = (
    "In the paper, the RMSE of one network on the pressure of the thumb is 0.01141 in cross-validation (Tables "
    "III and IV) and 0.05496 in testing (Figure 10), which cannot be on the same scale. As a fraction of the "
    "largest reading, 3,400 counts, the former is 39 counts; as a fraction of the range of 900, it is 10, and "
    "the latter is 49. Tables I to IV are quoted as printed. Our errors are fractions of the range."
)


ROWS = ("RMSE over runs", "counts", "R²", "skill", "grasps", "runs")  # rows of a table in the form of the paper


def tables_by_object(methods: Sequence[Method]) -> list[Table]:
    """Return tables of errors and skill by object, with one method per architecture; empty if there are no objects."""
    return [object_table for method in one_per_architecture(methods) if (object_table := _table_by_object(method))]


def score_cells(result: Score | None) -> list[str | Cell]:
    """Return the cells of a score in the rows `ROWS`."""
    if result is None:
        return [NONE] * len(ROWS)
    error = blocks.with_sd(result.each.mean, result.each.sd)
    counts = f"{predictions.to_counts(result.target, result.each.mean):.0f}"
    return [
        error,
        counts,
        blocks.fixed(result.r2, 2),
        blocks.interval(*result.skill),
        f"{result.grasps:,}",
        str(result.runs),
    ]


def baseline_rows(methods: Sequence[Method], target: str, known_objects: bool | None) -> list[tuple[str, Score | None]]:
    """Return title and score of the mandatory baselines, then of the further predictors in the methods' results.

    The score is None if there are no predictions of the target.
    """
    runs_by_method = {method.name: predictions_of_runs(method) for method in methods}
    all_runs = [run for runs in runs_by_method.values() for run in runs]
    other_predictors = {name for run in all_runs for name in run.predicted} - {MODEL}
    rows = []
    for predictor in dict.fromkeys([*BASELINES, *sorted(other_predictors)]):
        holding = [
            runs for runs in runs_by_method.values() if any(target in run.predicted.get(predictor, ()) for run in runs)
        ]
        most_runs = max(holding, key=len, default=[])  # all methods of a split have the same baselines
        rows.append((baseline_name(predictor), predictions.score(most_runs, target, known_objects, predictor)))
    return rows


def predictions_of_runs(method: Method) -> list[GraspPredictions]:
    """Return the predictions of each run of a method."""
    return [result.predictions for result in method.details]


def _table_by_object(method: Method) -> Table | None:
    """Return a table of a method's errors by object above the errors of the object's mean; None without unseen grasps."""
    predicted, runs = predicted_targets(method), predictions_of_runs(method)
    rows: list[list[str | Cell]] = []
    kinds: dict[int, str] = {}
    for known_objects in (True, False):
        names = {str(name) for run in runs for name in run.of(known_objects).objects}
        for name in sorted(names):
            object_runs = [run.rows(run.objects == name) for run in runs]
            row = [cell for target in predicted for cell in _object_cells(object_runs, target, known_objects)]
            grasp_count = len({str(recording) for run in object_runs for recording in run.of(known_objects).recordings})
            if not known_objects:
                kinds[len(rows)] = "quiet"
            rows.append([name if known_objects else f"{name} (novel)", f"{grasp_count:,}", *row])
    if not rows:
        return None
    heads = ["", "grasps", *(part for target in predicted for part in (headlines.TARGETS[target], "skill"))]
    return blocks.table(f"By object, {method.name}: RMSE above that of the object's mean", heads, rows, kinds)


def _object_cells(runs: Sequence[GraspPredictions], target: str, known_objects: bool) -> list[str | Cell]:
    """Return the RMSE on an object with that of the object mean, if any, below it, and the skill over the constant."""
    result, mean = (predictions.score(runs, target, known_objects, predictor) for predictor in (MODEL, OBJECT_MEAN))
    if result is None:
        return [NONE, NONE]
    below = blocks.fixed(mean.rmse, 4) if mean and known_objects else ""
    return [Cell(blocks.fixed(result.rmse, 4), below, result.rmse), blocks.signed(result.skill.mean)]


TARGET = "pdc_th"  # target for which the paper compares settings


@dataclass(frozen=True)
class Form:
    """A table of the paper: the varied setting, its values, and the published numbers."""

    number: str  # number of the table or figure
    title: str
    setting: str
    names: Mapping[object, str]  # setting's value -> row name
    printed: Mapping[object, tuple[float, float]] = field(default_factory=dict)  # mean and sd of the RMSE
    printed_s: Mapping[object, int] = field(default_factory=dict)  # seconds per epoch
    drawn: bool = False  # True if the paper has a figure instead of a table
    also: tuple[str, ...] = ()  # settings that only some values have


FORMS = (
    Form(
        "Table I",
        "number of hidden layers of the head",
        "head",
        {
            "fc1": "FC1: 1024",
            "fc2": "FC2: 1024-512",
            "fc3": "FC3: 1024-512-256",
            "fc4": "FC4: … 128",
            "fc5": "FC5: … 64",
            "fc6": "FC6: … 32",
        },
        HEADS,
    ),
    Form(
        "Table II",
        "number of points",
        "points",
        {count: f"{count} points" for count in POINT_COUNTS},
        POINT_COUNTS,
        EPOCH_S,
    ),
    Form(
        "Figure 9",
        "inputs of the network",
        "inputs",
        {
            "xyz": "XYZ",
            "rgb": "RGB",
            "xyzcont": "XYZCont",
            "rgbcont": "RGBCont",
            "xyzpose": "XYZPose",
            "rgbpose": "RGBPose",
        },
        drawn=True,
        also=("wrist",),
    ),
    Form(
        "Table III",
        "normalisation of a cloud",
        "normalisation",
        {"none": "none", "sphere": "unit sphere", "minmax": "min-max", "wrist": "wrist frame"},
        NORMALISATIONS,
        also=("wrist",),
    ),
    Form(
        "Table IV",
        "random rotation in training",
        "rotation_deg",
        {angle: f"±{angle}°" if angle else "none" for angle in ROTATIONS},
        ROTATIONS,
    ),
)
ORDER = (
    "The paper gives no numbers for Figure 9. It ranks pose before contacts before the cloud without either, "
    "finds that colour is worse than no colour except for RGBPose, and chooses RGBPose (0.01859 without "
    "normalisation)."
)

ESTIMATED = (
    "The wrist rotation was not recorded. If it is an input here, it is estimated from the two contacts and the "
    "line of sight, and adds no information."
)


def setting_tables(methods: Sequence[Method]) -> list[Block]:
    """Return the tables with at least two evaluated rows."""
    tables = [block for form in FORMS for block in _setting_table(form, methods)]
    published = all(block.published for block in methods)
    return [*tables, *([SmallPrint(SCALES)] if published and tables else [])]


def methods_by_value(methods: Sequence[Method], form: Form) -> dict[object, Method]:
    """Return the methods of a table by value of its setting: variants of the paper's network that differ only in it.

    If there are several such families, the one with the most rows, then with the most runs, is returned.
    """
    families: dict[str, dict[object, Method]] = {}
    for method in methods:
        value = method.settings.get(form.setting)
        if method.settings["architecture"] == PAPER and value in form.names and score_on_target(method):
            families.setdefault(method.key_without(form.setting, *form.also), {}).setdefault(value, method)

    def size(by_value: Mapping[object, Method]) -> tuple[int, int]:
        return len(by_value), sum(len(method.runs) for method in by_value.values())

    return max(families.values(), key=size, default={})


def score_on_target(method: Method) -> Score | None:
    """Return the score of a method on the target for which the paper compares settings, or None without predictions."""
    return predictions.score(predictions_of_runs(method), TARGET, True)


def _setting_table(form: Form, methods: Sequence[Method]) -> list[Block]:
    """Return the table of a setting of the paper's network, with a chart and notes; empty for fewer than two values."""
    by_value = methods_by_value(methods, form)
    if len(by_value) < 2:
        return []
    published = all(item.published for item in by_value.values())
    scores = {value: score_on_target(by_value[value]) if value in by_value else None for value in form.names}
    errors = {form.names[value]: score.each.mean for value, score in scores.items() if score}
    best_name = min(errors, key=lambda name: (errors[name], name))
    shown_names = {value: name for value, name in form.names.items() if published or scores[value]}
    rows: list[list[str | Cell]] = [
        [name, *score_cells(scores[value]), *(_printed_setting(form, value) if published else [])]
        for value, name in shown_names.items()
    ]
    kinds = {number: "best" for number, name in enumerate(shown_names.values()) if name == best_name}
    baselines = baseline_rows(list(by_value.values()), TARGET, True)
    heads_printed = ["paper: RMSE"] * bool(form.printed) + ["paper: s per epoch"] * bool(form.printed_s)
    heads_printed = heads_printed if published else []
    blank = [NONE] * len(heads_printed)
    kinds |= dict.fromkeys(range(len(rows), len(rows) + len(baselines)), "quiet")
    rows += [[name, *score_cells(item), *blank] for name, item in baselines]
    heads = ["", *ROWS, *heads_printed]
    simulated = any(item.simulated for item in by_value.values())
    title = f"{blocks.form(form.number, form.title, published)}{' (simulated)' if simulated else ''}"
    notes = [
        describe_training(list(by_value.values())),
        caution(list(by_value.values())),
        ORDER if form.drawn and published else "",
    ]
    notes += [ESTIMATED] if any(item.settings.get("wrist") == "estimated" for item in by_value.values()) else []
    figures = [_setting_chart(form, scores, dict(baselines))] if form.drawn else []
    table = blocks.table(f"{title}; {headlines.TARGETS[TARGET]}, known objects", heads, rows, kinds)
    return [table, *figures, SmallPrint(" ".join(item for item in notes if item))]


def _printed_setting(form: Form, value: object) -> list[str | Cell]:
    cells: list[str | Cell] = [blocks.with_sd(*form.printed[value], digits=5)] if form.printed else []
    return [*cells, *([str(form.printed_s[value])] if form.printed_s else [])]


def _setting_chart(form: Form, scores: Mapping[object, Score | None], baselines: Mapping[str, Score | None]) -> Chart:
    """Return a chart of the errors by value of a setting, next to those of the baselines."""
    named_scores = [(form.names[value], scored, "model") for value, scored in scores.items()]
    named_scores += [(name, scored, "baseline") for name, scored in baselines.items()]
    dots = []
    for name, scored, kind in named_scores:
        if scored:
            mean, sd = scored.each.mean, 0.0 if math.isnan(scored.each.sd) else scored.each.sd
            dots.append(Dot(name, mean, mean - sd, mean + sd, kind))
    caption = "Mean and standard deviation over runs; grey: baselines on the same grasps."
    return Chart("Error by inputs of the network", charts.ranking(dots, "RMSE (fraction of the range)"), caption)


TITLE = "Figures 10 and 11", "known objects (test) and novel objects"
PARTS = ("RMSE over runs", "R²", "skill")


def generalisation_tables(methods: Sequence[Method]) -> list[Block]:
    """Return tables of the paper's network and of the default method, for those that predicted two or more targets."""
    best_pairs = []
    for architecture in (PAPER, DEFAULT):
        pairs = _pairs([block for block in methods if block.settings["architecture"] == architecture])
        best_pairs.append(max(pairs, key=_pair_order, default=None))
    return [block for pair in best_pairs if pair for block in _generalisation_table(*pair)]


def _pairs(methods: Sequence[Method]) -> list[tuple[Method, Method]]:
    """Return pairs of methods, evaluated on known and on novel objects, that are equal or differ only in split.

    For novel objects the paper trains a new network on all grasps of known objects.
    """
    known_methods, novel_methods = (
        [method for method in methods if len(_scored_targets(method, known_objects)) > 1]
        for known_objects in (True, False)
    )
    return [
        (first, second)
        for first, second in itertools.product(known_methods, novel_methods)
        if first.key_without("split") == second.key_without("split")
    ]


def _pair_order(pair: tuple[Method, Method]) -> tuple[int, int, bool]:
    """Return the sort key of a pair: number of targets, then runs, then whether both are the same method."""
    known_method, novel = pair
    common = set(_scored_targets(known_method, True)) & set(_scored_targets(novel, False))
    return len(common), len(known_method.runs) + len(novel.runs), known_method is novel


def _scored_targets(method: Method, known_objects: bool) -> list[str]:
    """Return the targets that a method predicted for known or for novel objects."""
    return [
        target
        for target in predicted_targets(method)
        if predictions.score(predictions_of_runs(method), target, known_objects)
    ]


def _generalisation_table(known_method: Method, novel: Method) -> list[Block]:
    """Return the table of methods' errors on known and on novel objects, next to the baselines' and the paper's."""
    published = known_method.published and novel.published
    rows: list[list[str | Cell]] = []
    pairs: list[tuple[Score | None, Score | None]] = []
    kinds: dict[int, str] = {}
    for target, name in headlines.TARGETS.items():
        test_score = predictions.score(predictions_of_runs(known_method), target, True)
        novel_score = predictions.score(predictions_of_runs(novel), target, False)
        if test_score is None and novel_score is None:
            continue
        pairs.append((test_score, novel_score))
        rows.append([name, *_pair_cells(test_score, novel_score), *(_printed_target(target) if published else [])])
        test_baselines = baseline_rows([known_method], target, True)
        novel_baselines = baseline_rows([novel], target, False)
        for (title, test_baseline), (_, novel_baseline) in zip(test_baselines, novel_baselines, strict=False):
            kinds[len(rows)] = "quiet"
            rows.append(
                [
                    f"· {title.partition(':')[0]}",
                    *_pair_cells(test_baseline, novel_baseline),
                    *([NONE] * 3 if published else []),
                ]
            )
    heads = ["", *(f"test: {part}" for part in PARTS), *(f"novel: {part}" for part in PARTS), "change (%)"]
    heads += ["paper: test", "paper: novel", "change (%)"] if published else []
    simulated = known_method.simulated or novel.simulated
    distinct_methods = [known_method] if known_method is novel else [known_method, novel]
    grasp_counts = [max(item.grasps for item in described if item) for described in zip(*pairs, strict=True)]
    evaluated = f"Evaluated on {grasp_counts[0]:,} grasps of known and {grasp_counts[1]:,} of novel objects."
    note = f"{describe_training(distinct_methods)} {evaluated} {TRAINED_ON if published else ''} {caution(distinct_methods)}"
    title = f"{blocks.form(*TITLE, published)}{' (simulated)' if simulated else ''}; {known_method.name}"
    return [blocks.table(title, heads, rows, kinds), SmallPrint(note)]


def _pair_cells(test: Score | None, novel: Score | None) -> list[str | Cell]:
    change = NONE
    if test and novel and test.each.mean > 0:
        change = f"{round(100 * (novel.each.mean / test.each.mean - 1)):+d}".replace("-", "−")
    return [*_part_cells(test), *_part_cells(novel), change]


def _part_cells(result: Score | None) -> list[str | Cell]:
    """Return the cells of a score in the columns `PARTS`."""
    error, counts, *more_cells = score_cells(result)[: len(PARTS) + 1]
    return [_above_counts(error, str(counts)) if result else NONE, *more_cells]


def _printed_target(target: str) -> list[str | Cell]:
    """Return the cells of the paper's errors on a target: test, novel, and the change."""
    paper_errors = TEST_AND_NOVEL[target]
    pairs = ((paper_errors.test, paper_errors.test_counts), (paper_errors.novel, paper_errors.novel_counts))
    return [
        *(_above_counts(f"{percentage:.5f}", str(counts)) for percentage, counts in pairs),
        f"+{paper_errors.change}",
    ]


def _above_counts(error: str | Cell, counts: str) -> Cell:
    text, value = (error, None) if isinstance(error, str) else (error.text, error.value)
    return Cell(text, f"{counts} counts", value)
