"""The paper's own tables and figures in its form: what one setting of its network changes, on one target."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from tacpipe.comparison.runs import Method
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Block, Cell, Chart, Note
from tacpipe.report.charts import Dot
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.report import printed, scores, tables, wording
from tacpipe.tasks.touch.report.methods import PAPERS
from tacpipe.tasks.touch.report.scores import Score

TARGET = "pdc_th"  # on which the paper compares settings


@dataclass(frozen=True)
class Form:
    """A table of the paper: which setting varies, its values, and what was printed."""

    number: str  # of the table or figure in the paper
    title: str
    setting: str
    names: Mapping[object, str]  # what a row is called, by the setting's value
    printed: Mapping[object, tuple[float, float]] = field(default_factory=dict)  # mean and sd of the RMSE
    printed_s: Mapping[object, int] = field(default_factory=dict)  # seconds per epoch
    drawn: bool = False  # whether the paper has a figure and no table
    also: tuple[str, ...] = ()  # settings that only some of the values have


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
        printed.HEADS,
    ),
    Form(
        "Table II",
        "number of points",
        "points",
        {count: f"{count} points" for count in printed.POINTS},
        printed.POINTS,
        printed.EPOCH_S,
    ),
    Form(
        "Figure 9",
        "what the network is given",
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
        printed.NORMALISATIONS,
        also=("wrist",),
    ),
    Form(
        "Table IV",
        "random rotation in training",
        "rotation_deg",
        {angle: f"±{angle}°" if angle else "none" for angle in printed.ROTATIONS},
        printed.ROTATIONS,
    ),
)
ORDER = (
    "The paper prints no numbers of Figure 9: it ranks pose before contacts before the cloud alone, finds colour worse than "
    "none but for RGBPose, and chooses that (0.01859 without normalisation)."
)

ESTIMATED = (
    "How the wrist was turned was not recorded: where it is read here, it is estimated from the two contacts and the "
    "line of sight, and states nothing that these do not."
)


def parts(methods: Sequence[Method]) -> list[Block]:
    """Return the tables of which at least two rows were run; none where there is none."""
    described = [one for form in FORMS for one in _table(form, methods)]
    published = all(one.published for one in methods)
    return [*described, *([Note(printed.SCALES)] if published and described else [])]


def family(methods: Sequence[Method], form: Form) -> dict[object, Method]:
    """Return the methods of a table by their setting: of the paper's network, alike but for it.

    Of several such families the one with most rows is given, then that with most runs.
    """
    alike: dict[str, dict[object, Method]] = {}
    for method in methods:
        value = method.settings.get(form.setting)
        if method.settings["architecture"] == PAPERS and value in form.names and of(method):
            alike.setdefault(method.key_without(form.setting, *form.also), {}).setdefault(value, method)

    def place(one: Mapping[object, Method]) -> tuple[int, int]:
        return len(one), sum(len(method.runs) for method in one.values())

    return max(alike.values(), key=place, default={})


def of(method: Method) -> Score | None:
    """Return how a method does on what the paper compares settings on."""
    return scores.score(tables.predictions(method), TARGET, True)


def _table(form: Form, methods: Sequence[Method]) -> list[Block]:
    found = family(methods, form)
    if len(found) < 2:
        return []
    published = all(one.published for one in found.values())
    described = {value: of(found[value]) if value in found else None for value in form.names}
    least = min((one.each.mean, name) for value, name in form.names.items() if (one := described[value]))[1]
    shown = {value: name for value, name in form.names.items() if published or described[value]}
    rows: list[list[str | Cell]] = [
        [name, *tables.cells(described[value]), *(_printed(form, value) if published else [])]
        for value, name in shown.items()
    ]
    kinds = {number: "best" for number, name in enumerate(shown.values()) if name == least}
    baselines = tables.baseline_rows(list(found.values()), TARGET, True)
    heads_printed = ["paper: RMSE"] * bool(form.printed) + ["paper: s per epoch"] * bool(form.printed_s)
    heads_printed = heads_printed if published else []
    blank = [NONE] * len(heads_printed)
    kinds |= dict.fromkeys(range(len(rows), len(rows) + len(baselines)), "quiet")
    rows += [[name, *tables.cells(one), *blank] for name, one in baselines]
    heads = ["", *tables.ROWS, *heads_printed]
    simulated = any(one.simulated for one in found.values())
    title = f"{blocks.form(form.number, form.title, published)}{' (simulated)' if simulated else ''}"
    notes = [
        wording.basis(list(found.values())),
        wording.caution(list(found.values())),
        ORDER if form.drawn and published else "",
    ]
    notes += [ESTIMATED] if any(one.settings.get("wrist") == "estimated" for one in found.values()) else []
    drawn = [_chart(form, described, dict(baselines))] if form.drawn else []
    table = blocks.table(f"{title}; {headlines.TARGETS[TARGET]}, known objects", heads, rows, kinds)
    return [table, *drawn, Note(" ".join(one for one in notes if one))]


def _printed(form: Form, value: object) -> list[str | Cell]:
    cells: list[str | Cell] = [blocks.with_sd(*form.printed[value], digits=5)] if form.printed else []
    return [*cells, *([str(form.printed_s[value])] if form.printed_s else [])]


def _chart(form: Form, described: Mapping[object, Score | None], baselines: Mapping[str, Score | None]) -> Chart:
    dots = [
        Dot(name, one.each.mean, one.each.mean - sd, one.each.mean + sd, kind)
        for found, kind in (
            ({form.names[value]: one for value, one in described.items()}, "model"),
            (baselines, "baseline"),
        )
        for name, one in found.items()
        if one
        for sd in [0.0 if math.isnan(one.each.sd) else one.each.sd]
    ]
    caption = "Mean and standard deviation over runs; grey: baselines on the same grasps."
    return Chart("Error by what the network is given", charts.ranking(dots, "RMSE (fraction of the range)"), caption)
