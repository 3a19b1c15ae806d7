"""A result on touch, what makes a method of such results, and what it is called."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from typing import Any

from tacpipe.channels import biotac_sp
from tacpipe.comparison.naming import distinct_names, marks
from tacpipe.comparison.runs import Method
from tacpipe.plugins import params as params_of
from tacpipe.report import contents
from tacpipe.report.contents import Tree
from tacpipe.tasks.touch.report import predictions
from tacpipe.tasks.touch.report.predictions import Predictions
from tacpipe.tasks.touch.result_names import PREDICTIONS

PAPERS = "pointnet"  # the architecture of the paper
DEFAULT = "tree-ensemble"  # the one that is trained where none is named
NAMES = {PAPERS: "PointNet"}
USUAL = ("split", "simulated")  # settings that no name states: parts of questions
_NO_METHOD = ("seed", "run_label", "baselines")  # runs of one method may differ in these; the label is shown as split


class Result(contents.Result):
    """One result on touch."""

    STAGE = "train.touch"
    SETS = ("vision2tactile",)

    @cached_property
    def predictions(self) -> Predictions:
        """What was predicted of each grasp that the model has not seen."""
        return predictions.read(self.dataset.recordings[PREDICTIONS])

    @property
    def architecture(self) -> str:
        """The kind of model."""
        stored = self.config.get("architecture", self.given.get("architecture", ""))
        return str(params_of.named(self.STAGE, {"architecture": stored})["architecture"])

    @property
    def split(self) -> str:
        """How grasps were parted into those of training and others, in words; empty where nobody stated."""
        return str(self.config.get("split", ""))

    @property
    def trained(self) -> int | None:
        """How many grasps the weights were fitted to."""
        found: int | None = self.config.get("counts", {}).get("train")
        return found

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All that makes its method: params but the seed, the split of its grasps, and whether these were simulated."""
        params = {name: value for name, value in self.params.items() if name not in _NO_METHOD}
        if self.architecture != PAPERS:  # the others take nothing more from it
            params["colour"] = str(params.pop("inputs", "")).startswith("rgb")
        if not str(params.get("inputs", "")).endswith("pose") and params.get("normalisation") != "wrist":
            params.pop("wrist", None)  # nothing reads it
        if not params.get("multi_target", True):  # trees are one model of all targets
            params.pop("targets", None)  # one network a target: others beside it change nothing
        return {**params, "architecture": self.architecture, "split": self.split, "simulated": self.simulated}


def names(results: Sequence[Result]) -> list[str]:
    """Return what the method of each result is called.

    A name states what a method does without, colour, and the settings in which it differs from most methods of its
    architecture.
    """
    keys = [json.dumps(one.settings, sort_keys=True) for one in results]
    runs, held = Counter(keys), {key: one.settings for key, one in zip(keys, results, strict=True)}
    found: dict[str, str] = {}
    for architecture in {one.architecture for one in results}:
        same = {key: one for key, one in held.items() if one["architecture"] == architecture}
        usual = _usual([(one, runs[key]) for key, one in same.items()])
        named = distinct_names([(architecture, one) for one in same.values()], usual)
        found |= {
            key: " · ".join([*_called(one), *marks(differing)])
            for (key, one), (_, differing) in zip(same.items(), named, strict=True)
        }
    return [found[key] for key in keys]


def splits(results: Sequence[Result]) -> list[tuple[str, bool]]:
    """Return how the grasps of results were parted, and whether they were simulated: what is a question of its own.

    Recorded grasps come before simulated ones, then what the default method was run on, then the most targets and runs.
    """
    found: dict[tuple[str, bool], list[Result]] = {}
    for one in results:
        found.setdefault((one.split, one.simulated), []).append(one)

    def place(key: tuple[str, bool]) -> tuple[bool, bool, int, int, str]:
        same = found[key]
        targets = {target for one in same for target in one.predictions.targets}
        return key[1], all(one.architecture != DEFAULT for one in same), -len(targets), -len(same), key[0]

    return sorted(found, key=place)


def groups(methods: Sequence[Method]) -> list[list[Method]]:
    """Return methods that were trained and evaluated on grasps parted in the same way, in the order of `splits`."""
    order = splits([one for method in methods for one in method.details])
    return [[one for one in methods if (one.settings["split"], one.settings["simulated"]) == key] for key in order]


def default(methods: Sequence[Method]) -> Method:
    """Return the method that represents the project's own: the default with most runs, or else that with most runs."""
    return max(methods, key=lambda one: (one.settings["architecture"] == DEFAULT, len(one.runs)))


def main(methods: Sequence[Method]) -> list[Method]:
    """Return one method an architecture: that with most runs, of several one that reads colour, then the shortest name."""

    def place(one: Method) -> tuple[int, bool, int, str]:
        return -len(one.runs), not one.settings.get("colour", True), len(one.name), one.name

    chosen: dict[str, Method] = {}
    for one in sorted(methods, key=place):
        chosen.setdefault(one.settings["architecture"], one)
    return sorted(chosen.values(), key=lambda one: one.name)


def targets(*methods: Method) -> tuple[str, ...]:
    """Return what any run of some methods predicts, in the order of tables."""
    held = {target for method in methods for one in method.details for target in one.predictions.targets}
    return tuple(target for target in biotac_sp.TARGETS if target in held)


def _called(settings: Tree) -> list[str]:
    """Return what a kind of model is called by what it reads; marks that distinguish methods of a kind come behind."""
    architecture, coloured = str(settings["architecture"]), settings.get("colour", True)
    if architecture == "trees":
        return ["trees on geometry and colour" if coloured else "trees on geometry"]
    return [NAMES.get(architecture, architecture), *([] if coloured else ["without colour"])]


def _usual(alike: Sequence[tuple[Tree, int]]) -> list[tuple[str, Any]]:
    """Return the setting that most methods have, or of several such that of most runs, by name, given methods and runs.

    All splits are usual, and so are simulated grasps: these have headings of their own. What is called by its colour has no
    mark of it.
    """
    found = []
    for name in sorted({name for settings, _ in alike for name in settings}):
        held = [(settings[name], runs) for settings, runs in alike if name in settings]
        values = [value for value, _ in held]
        weights = [(values.count(one), sum(runs for value, runs in held if value == one)) for one in values]
        kept = values if name in (*USUAL, "colour") else [values[weights.index(max(weights))]]
        found += [(name, value) for value in kept]
    return found
