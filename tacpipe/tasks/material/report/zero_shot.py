"""Materials that one sensor was never trained on, named by the other sensor's classifier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.comparison.runs import Method
from tacpipe.metrics.proportions import wilson
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Fold, Note
from tacpipe.report.contents import Tree
from tacpipe.tasks.material.report import wording
from tacpipe.tasks.material.report.methods import plain, shown

ALL, AMONG = "zero_shot", "among_held_out"
NOTE = (
    "The sensor's own labels and pairs of these materials were kept from training; the other sensor's classifier names them "
    "from its latents, out of all materials or out of the held-out ones alone. Above chance here, and here alone, is "
    "evidence of something that the sensors share. Slides of one material are right or wrong together, so the interval "
    "counts materials and runs, not slides. "
)


@dataclass(frozen=True)
class Untold:
    """Runs that differ in seed, fold, and in which materials they held out of a sensor's labels."""

    name: str
    kind: str
    main: bool  # whether nothing else sets them apart
    sensor: str
    trees: tuple[Tree, ...]  # what metrics report on the held-out materials, one a run
    materials: int  # that a run held out


def folds(methods: Sequence[Method]) -> list[Fold]:
    """Return how often held-out materials are named right across sensors; nothing where none were held out."""
    rows: list[list[str | Cell]] = []
    for one in untold(methods):
        rows.append([f"{one.name}, out of all", shown(one.sensor), *_cells(one.trees, one.sensor, one.materials)])
        among = [tree[AMONG] for tree in one.trees if AMONG in tree]
        if among:
            cells = _cells(among, one.sensor, one.materials)
            rows.append([f"{one.name}, out of those held out", shown(one.sensor), *cells])
    if not rows:
        return []
    heads = ["", "slides of", "accuracy (%)", "chance (%)", "runs"]
    described = blocks.table("Zero shot: accuracy on held-out materials", heads, rows)
    return blocks.fold("Materials that one sensor never saw", described, Note(NOTE), *map(Note, sentences(methods)))


def sentences(methods: Sequence[Method]) -> list[str]:
    """Return whether one sensor's classifier names what the other never learned, a sentence a method and sensor."""
    described = []
    for one in untold(methods):
        correct, evaluated, low, high = _counts(one.trees, one.sensor, one.materials)
        if not evaluated or not one.main:
            continue
        chance = _at(one.trees[0], "chance", one.sensor)
        unsure = "which cannot be distinguished from chance"
        word = "above chance" if low > chance else "below chance" if high < chance else unsure
        described.append(
            f"Of {shown(one.sensor)} slides of materials that it never learned, the other sensor's classifier names "
            f"{wording.percent(correct / evaluated)} % right ({one.kind}, {correct} of {evaluated}; 95 % interval "
            f"{wording.percent(low)} to {wording.percent(high)} %), {word} ({wording.percent(chance)} %)."
        )
    return described


def untold(methods: Sequence[Method]) -> list[Untold]:
    """Return the runs that held materials out, those together that differ in which, by sensor."""
    alike: dict[str, list[Method]] = {}
    for method in methods:
        if any(ALL in one.metrics for one in method.details):
            alike.setdefault(method.key_without("hold_out"), []).append(method)
    found = []
    for same in alike.values():
        runs = [(one.metrics[ALL], method) for method in same for one in method.details if ALL in one.metrics]
        for sensor in dict.fromkeys(name for tree, _ in runs for name in tree["accuracy"]):
            held = [(tree, method) for tree, method in runs if sensor in tree["accuracy"]]
            first = held[0][1]
            sets = {str(method.settings["hold_out"]) for _, method in held}
            name = first.name if len(sets) == 1 else f"{first.family} · {len(sets)} sets of materials in turn"
            trees = tuple(tree for tree, _ in held)
            main = plain(first.settings, "hold_out")
            found.append(Untold(name, first.family, main, sensor, trees, _held_out(first, sensor)))
    return found


def _counts(trees: Sequence[Tree], sensor: str, materials: int) -> tuple[int, int, float, float]:
    """Return how many slides were named right, of how many, and the interval of that share.

    Slides of one material lie together and are right or wrong together, also by chance; so a run counts as no more trials
    than it has held-out ``materials``.
    """
    correct, evaluated = (sum(int(_at(tree, name, sensor)) for tree in trees) for name in ("correct", "n"))
    if not evaluated:
        return 0, 0, float("nan"), float("nan")
    trials = materials * len(trees)
    return correct, evaluated, *wilson(round(correct / evaluated * trials), trials)


def _held_out(method: Method, sensor: str) -> int:
    """Return how many materials were held out of a sensor's labels, from a setting like ``roboskin=17,18``."""
    parts = (part.strip().partition("=") for part in str(method.settings["hold_out"]).split(";"))
    return max(
        sum(bool(one.strip()) for name, _, described in parts if name == sensor for one in described.split(",")), 1
    )


def _cells(trees: Sequence[Tree], sensor: str, materials: int) -> list[str | Cell]:
    """Return what runs state of the held-out materials of one sensor."""
    correct, evaluated, low, high = _counts(trees, sensor, materials)
    if not evaluated:
        return [NONE, NONE, str(len(trees))]
    spread = (
        float(np.std([_at(tree, "accuracy", sensor) for tree in trees], ddof=1)) if len(trees) > 1 else float("nan")
    )
    chance = float(np.mean([_at(tree, "chance", sensor) for tree in trees]))
    described = wording.counted(correct, evaluated, low, high, spread)
    return [described, wording.percent(chance), str(len(trees))]


def _at(tree: Tree, name: str, sensor: str) -> float:
    """Return a number of a result, stated for all sensors or by sensor."""
    value = tree.get(name, float("nan"))
    return float(value[sensor] if isinstance(value, Mapping) else value)
