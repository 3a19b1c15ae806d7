"""A result of an evaluation as a run, the runs of a method, and what that method is called."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from tacpipe.channels import biotac_sp
from tacpipe.comparison.naming import distinct_names
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.report import contents, provenance
from tacpipe.report.touch import predictions
from tacpipe.report.touch.predictions import Predictions
from tacpipe.tasks.touch.result_names import PREDICTIONS

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Tree = Mapping[str, Any]

PAPERS_SETS = ("vision2tactile",)  # whose paper's tables and figures stand next to ours
PAPERS = "pointnet"  # the architecture of the paper
DEFAULT = "tree-ensemble"  # the one that is trained where none is named
NAMES = {PAPERS: "PointNet"}
_NO_METHOD = ("seed", "run_label", "baselines")  # runs of one method may differ in these; the label is shown as split


@dataclass(frozen=True)
class Run:
    """One result: a model trained once and evaluated once."""

    dataset: Dataset
    config: Tree
    history: Sequence[Tree]
    predictions: Predictions

    @classmethod
    def read(cls, dataset: Dataset) -> Run:
        """Return the run that a result holds."""
        found = predictions.read(dataset.recordings[PREDICTIONS])
        return cls(dataset, contents.tree(dataset, "config.json"), contents.history(dataset), found)

    @cached_property
    def params(self) -> Tree:
        """What the model was trained with, as far as it counts for its architecture."""
        found: Tree = self.config.get("params", {})
        return params_of.counting(registry.load("train.touch"), found)

    @property
    def architecture(self) -> str:
        """The kind of model."""
        stored = self.config.get("architecture", self.config.get("params", {}).get("architecture", ""))
        return str(params_of.named("train.touch", {"architecture": stored})["architecture"])

    @property
    def split(self) -> str:
        """How grasps were parted into those of training and others, in words; empty where nobody stated."""
        return str(self.config.get("split", ""))

    @property
    def trained(self) -> int | None:
        """How many grasps the weights were fitted to."""
        found: int | None = self.config.get("counts", {}).get("train")
        return found

    @property
    def simulated(self) -> bool:
        """Whether its grasps were simulated."""
        return provenance.simulated(self.dataset)

    @property
    def published(self) -> bool:
        """Whether its grasps are those of the paper."""
        return provenance.published(self.dataset, PAPERS_SETS)


@dataclass(frozen=True)
class Method:
    """Runs that differ in seed or fold alone."""

    name: str
    settings: Tree  # what makes it this method
    runs: tuple[Run, ...]

    @property
    def architecture(self) -> str:
        """The kind of model."""
        return str(self.settings["architecture"])

    @property
    def split(self) -> str:
        """How grasps were parted."""
        return str(self.settings["split"])

    @property
    def simulated(self) -> bool:
        """Whether its grasps were simulated."""
        return bool(self.settings["simulated"])

    @property
    def published(self) -> bool:
        """Whether all its runs were evaluated on grasps of the paper."""
        return all(run.published for run in self.runs)

    @property
    def targets(self) -> tuple[str, ...]:
        """What any of its runs predicts, in the order of tables."""
        held = {target for run in self.runs for target in run.predictions.targets}
        return tuple(target for target in biotac_sp.TARGETS if target in held)

    def key_without(self, *names: str) -> str:
        """Return what methods share that differ in these settings alone."""
        return _key({name: value for name, value in self.settings.items() if name not in names})


@dataclass(frozen=True)
class Group:
    """Methods that were trained and evaluated on grasps parted in the same way: these can be compared."""

    split: str
    simulated: bool
    methods: tuple[Method, ...]

    @property
    def targets(self) -> tuple[str, ...]:
        """What any of its methods predicts, in the order of tables."""
        return tuple(one for one in biotac_sp.TARGETS if any(one in method.targets for method in self.methods))

    @property
    def default(self) -> Method:
        """The method that represents the project's own: the default with most runs, or else that with most runs."""
        return max(self.methods, key=lambda one: (one.architecture == DEFAULT, len(one.runs)))

    @property
    def main(self) -> list[Method]:
        """One method an architecture: that with most runs, of several one that reads colour, then the shortest name."""

        def place(one: Method) -> tuple[int, bool, int, str]:
            return -len(one.runs), not one.settings.get("colour", True), len(one.name), one.name

        chosen: dict[str, Method] = {}
        for one in sorted(self.methods, key=place):
            chosen.setdefault(one.architecture, one)
        return sorted(chosen.values(), key=lambda one: one.name)


def grouped(runs: Sequence[Run]) -> list[Method]:
    """Return the methods of runs, sorted by name.

    A method is all params but the seed, the split of its grasps, and whether these were simulated. Its name states what it
    does without, colour, and the settings in which it differs from most methods of its architecture.
    """
    found: dict[str, tuple[Tree, list[Run]]] = {}
    for run in runs:
        settings = _settings(run)
        found.setdefault(_key(settings), (settings, []))[1].append(run)
    made = []
    for architecture in dict.fromkeys(str(settings["architecture"]) for settings, _ in found.values()):
        same = [one for one in found.values() if one[0]["architecture"] == architecture]
        names = distinct_names([(architecture, settings) for settings, _ in same], _usual(same))
        made += [
            Method(" · ".join([*_called(settings), *marks]), settings, tuple(held))
            for (_, marks), (settings, held) in zip(names, same, strict=True)
        ]
    return sorted(made, key=lambda method: method.name)


def groups(methods: Sequence[Method]) -> list[Group]:
    """Return methods by how their grasps were parted.

    Recorded grasps come before simulated ones, then what the default method was run on, then the most targets and runs.
    """
    found: dict[tuple[str, bool], list[Method]] = {}
    for one in methods:
        found.setdefault((one.split, one.simulated), []).append(one)
    made = [Group(split, simulated, tuple(same)) for (split, simulated), same in found.items()]

    def place(one: Group) -> tuple[bool, bool, int, int, str]:
        runs = sum(len(method.runs) for method in one.methods)
        return one.simulated, one.default.architecture != DEFAULT, -len(one.targets), -runs, one.split

    return sorted(made, key=place)


def _called(settings: Tree) -> list[str]:
    """Return what a kind of model is called by what it reads; marks that distinguish methods of a kind come behind."""
    architecture, coloured = str(settings["architecture"]), settings.get("colour", True)
    if architecture == "trees":
        return ["trees on geometry and colour" if coloured else "trees on geometry"]
    return [NAMES.get(architecture, architecture), *([] if coloured else ["without colour"])]


def _settings(run: Run) -> dict[str, Any]:
    params = {name: value for name, value in run.params.items() if name not in _NO_METHOD}
    if run.architecture != PAPERS:  # the others take nothing more from it
        params["colour"] = str(params.pop("inputs", "")).startswith("rgb")
    if not str(params.get("inputs", "")).endswith("pose") and params.get("normalisation") != "wrist":
        params.pop("wrist", None)  # nothing reads it
    if not params.get("multi_target", True):  # trees are one model of all targets
        params.pop("targets", None)  # one network a target: others beside it change nothing
    return {**params, "architecture": run.architecture, "split": run.split, "simulated": run.simulated}


def _usual(alike: Sequence[tuple[Tree, Sequence[Run]]]) -> list[tuple[str, Any]]:
    """Return the setting that most methods have, or of several such that of most runs, by name.

    All splits are usual, and so are simulated grasps: these have headings of their own. What is called by its colour has no
    mark of it.
    """
    found = []
    for name in sorted({name for settings, _ in alike for name in settings}):
        values = [settings[name] for settings, _ in alike if name in settings]
        weights = [(values.count(one), _runs_with(alike, name, one)) for one in values]
        kept = values if name in ("split", "simulated", "colour") else [values[weights.index(max(weights))]]
        found += [(name, value) for value in kept]
    return found


def _runs_with(alike: Sequence[tuple[Tree, Sequence[Run]]], name: str, value: object) -> int:
    return sum(len(runs) for settings, runs in alike if settings.get(name) == value)


def _key(settings: Tree) -> str:
    return json.dumps(settings, sort_keys=True)
