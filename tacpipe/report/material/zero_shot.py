"""Materials that one sensor was never trained on, named by the other sensor's classifier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tacpipe.proportions import wilson
from tacpipe.report import markup
from tacpipe.report.markup import NONE
from tacpipe.report.material import wording
from tacpipe.report.material.methods import Method, Tree, shown

ALL, AMONG = "zero_shot", "among_held_out"
NOTE = (
    "The sensor's own labels and pairs of these materials were kept from training; the other sensor's classifier names them "
    "from its latents, out of all materials or out of the held-out ones alone. Above chance here, and here alone, is "
    "evidence of something that the sensors share. Slides of one material are right or wrong together, so the interval "
    "counts materials and runs, not slides. "
)


def table(methods: Sequence[Method]) -> str:
    """Return how often held-out materials are named right across sensors; empty where none were held out."""
    rows = []
    for method in methods:
        trees = [run.metrics[ALL] for run in method.runs if ALL in run.metrics]
        for sensor in dict.fromkeys(name for tree in trees for name in tree["accuracy"]):
            held = [tree for tree in trees if sensor in tree["accuracy"]]
            rows.append([f"{method.name}, out of all", shown(sensor), *_cells(held, sensor, _held_out(method, sensor))])
            among = [tree[AMONG] for tree in held if AMONG in tree]
            if among:
                rows.append(
                    [
                        f"{method.name}, out of those held out",
                        shown(sensor),
                        *_cells(among, sensor, _held_out(method, sensor)),
                    ]
                )
    if not rows:
        return ""
    heads = ["", "slides of", "accuracy (%)", "chance (%)", "runs"]
    caution = wording.caution(any(method.simulated for method in methods))
    told = markup.table("Zero shot: accuracy on held-out materials", heads, rows)
    return f"<h3>Materials that one sensor never saw</h3>{told}{markup.note(NOTE + caution)}"


def sentences(methods: Sequence[Method]) -> list[str]:
    """Return whether one sensor's classifier names what the other never learned, a sentence a method and sensor."""
    told = []
    for method in methods:
        trees = [run.metrics[ALL] for run in method.runs if ALL in run.metrics]
        if not method.differs_only("hold_out"):
            continue
        for sensor in dict.fromkeys(name for tree in trees for name in tree["accuracy"]):
            held = [tree for tree in trees if sensor in tree["accuracy"]]
            correct, judged, low, high = _counts(held, sensor, _held_out(method, sensor))
            if not judged:
                continue
            chance = _at(held[0], "chance", sensor)
            unsure = "which cannot be told from chance"
            word = "above chance" if low > chance else "below chance" if high < chance else unsure
            told.append(
                f"Of {shown(sensor)} slides of materials that it never learned, the other sensor's classifier names "
                f"{wording.percent(correct / judged)} % right ({method.kind}, {correct} of {judged}; 95 % interval "
                f"{wording.percent(low)} to {wording.percent(high)} %), {word} ({wording.percent(chance)} %)."
            )
    return told


def _counts(trees: Sequence[Tree], sensor: str, materials: int) -> tuple[int, int, float, float]:
    """Return how many slides were named right, of how many, and the interval of that share.

    Slides of one material lie together and are right or wrong together, also by chance; so a run counts as no more trials
    than it has held-out ``materials``.
    """
    correct, judged = (sum(int(_at(tree, name, sensor)) for tree in trees) for name in ("correct", "n"))
    if not judged:
        return 0, 0, float("nan"), float("nan")
    trials = materials * len(trees)
    return correct, judged, *wilson(round(correct / judged * trials), trials)


def _held_out(method: Method, sensor: str) -> int:
    """Return how many materials were held out of a sensor's labels, from a setting like ``roboskin=17,18``."""
    parts = (part.strip().partition("=") for part in str(method.settings["hold_out"]).split(";"))
    return max(sum(bool(one.strip()) for name, _, told in parts if name == sensor for one in told.split(",")), 1)


def _cells(trees: Sequence[Tree], sensor: str, materials: int) -> list[str]:
    """Return what runs say of the held-out materials of one sensor."""
    correct, judged, low, high = _counts(trees, sensor, materials)
    if not judged:
        return [NONE, NONE, str(len(trees))]
    spread = (
        float(np.std([_at(tree, "accuracy", sensor) for tree in trees], ddof=1)) if len(trees) > 1 else float("nan")
    )
    chance = float(np.mean([_at(tree, "chance", sensor) for tree in trees]))
    told = wording.counted(correct, judged, low, high, spread)
    return [told, wording.percent(chance), str(len(trees))]


def _at(tree: Tree, name: str, sensor: str) -> float:
    """Return a number of a result, told for all sensors or by sensor."""
    value = tree.get(name, float("nan"))
    return float(value[sensor] if isinstance(value, Mapping) else value)
