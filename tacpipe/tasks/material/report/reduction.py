"""Tables III and IV: what joint learning is worth where one sensor has fewer slides."""

from __future__ import annotations

from collections.abc import Sequence

from tacpipe.comparison.runs import Method
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Table
from tacpipe.tasks.material.report import printed, wording
from tacpipe.tasks.material.report.accuracy import accuracy
from tacpipe.tasks.material.report.methods import kept, of, plain, shown

NUMBERS = {"biotac": "III", "roboskin": "IV"}
SAME = 0.92  # numbers of slides in this ratio are as many
BATCH = 32  # slides, of the paper's batches
JOINT, ALONE, OURS = "RAEC joint", "RAEC independent", "MiniRocket"


def tables(methods: Sequence[Method]) -> list[Table]:
    """Return a table a reduced sensor, in the paper's form; none where no sensor was reduced or other data are shown.

    A sensor is reduced where it learns from a fraction of the batches, as in the paper, or where a split gave it fewer
    slides than the other. Where both were run, the paper's way counts.
    """
    chosen = [one for one in methods if plain(one.settings, "subsample_sensor", "few")]
    if not all(one.published for one in chosen):
        return []
    described = {
        str(one.settings[name]) for one in chosen if one.family == JOINT for name in ("subsample_sensor", "few_of")
    }
    return [_table(chosen, sensor) for sensor in NUMBERS if sensor in described]


def _table(methods: Sequence[Method], reduced: str) -> Table:
    columns = [(JOINT, "biotac"), (JOINT, "roboskin"), (ALONE, reduced)]
    whole = max(run.trained.get(reduced, 0) for one in methods for run in one.details)
    rows = []
    for ratio in printed.RATIOS:
        slides = kept(whole, BATCH, ratio)
        same = [
            one
            for one in methods
            if (one.settings["subsample_sensor"], one.settings["subsample_percent"]) == (reduced, ratio)
        ]
        fewer = [one for one in methods if one.settings["few"] and _as_many(one, slides, reduced)]
        row: list[str | Cell] = [f"{ratio} %", str(slides)]
        for (kind, sensor), paper in zip(columns, printed.REDUCED[reduced][ratio], strict=True):
            found = [one for one in same if one.family == kind] or [
                one for one in fewer if one.family == kind and (kind != JOINT or one.settings["few_of"] == reduced)
            ]
            row += [_cell(found, sensor), f"{paper:.2f}"]
        rows.append([*row, _cell([one for one in fewer if one.family == OURS], reduced)])
    heads = ["share kept", "slides"]
    for kind, sensor in columns:
        heads += [f"{kind.removeprefix('RAEC ')}, {shown(sensor)}", "paper"]
    title = (
        f"Table {NUMBERS[reduced]} in the paper's form: accuracy (%) where {shown(reduced)} has fewer training slides"
    )
    return blocks.table(title, [*heads, f"{OURS}, {shown(reduced)}"], rows)


def _cell(methods: Sequence[Method], sensor: str) -> str | Cell:
    """Return the accuracy of that of some methods that has most runs."""
    chosen = max(methods, key=lambda one: len(of(one, sensor)), default=None)
    return wording.fraction(accuracy(of(chosen, sensor), sensor)) if chosen else NONE


def _as_many(method: Method, slides: int, sensor: str) -> bool:
    """Return whether a method learned from about so many slides of a sensor."""
    described = [run.details.learned[sensor] for run in of(method, sensor) if sensor in run.details.learned]
    return bool(described) and SAME < max(described) / slides < 1 / SAME
