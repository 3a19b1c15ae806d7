"""Which results are runs of the same method, and which method is the paper's."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.report.forward import error_sums
from tacpipe.report.forward.error_sums import ErrorSums

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Tree = Mapping[str, Any]

ACTIONS = ("planned", "none", "shuffled")
_PAPER_WIDTH = {"pca": 20, "autoencoder": 8}  # latents the paper keeps
_NO_METHOD = ("seed", "actions", "architecture", "baselines")  # baselines are fitted next to the model
_PREFERRED = ("pca", "autoencoder", "raw")  # the paper's own order of what forecasts best


@dataclass(frozen=True)
class Run:
    """One result: a model trained once and evaluated once."""

    dataset: Dataset
    config: Tree
    metrics: Tree
    errors: ErrorSums

    @classmethod
    def read(cls, dataset: Dataset) -> Run:
        """Return the run that the files of a result hold."""
        config, metrics = (json.loads(dataset.files[name]) for name in ("config.json", "metrics.json"))
        return cls(dataset, config, metrics, error_sums.read(dataset.files[error_sums.FILE]))


@dataclass(frozen=True)
class Method:
    """Runs that differ in seed or split alone."""

    name: str
    runs: tuple[Run, ...]

    @property
    def config(self) -> Tree:
        """What the runs have in common, and the first one's seed."""
        return self.runs[0].config

    @property
    def codec(self) -> Tree:
        """Kind, width and name of the representation."""
        found: Tree = self.config["codec"]
        return found

    @property
    def actions(self) -> str:
        """What the model is informed of the motion to come: ``planned``, ``none`` or ``shuffled``."""
        return actions(self.config)

    @property
    def timeline(self) -> str:
        """What rows represent: a ``uniform`` grid, ``logged`` rows or ``fresh`` frames."""
        return timeline(self.config)

    @property
    def recurrent(self) -> bool:
        """Whether the model is the paper's encoder and decoder."""
        return str(self.config["architecture"]).startswith("recurrent")

    def key_without(self, what: str) -> str:
        """Return what methods share that differ in their ``actions`` or in their ``timeline`` alone."""
        return _key(self.config, params=True, without=what)


def comparable(dataset: Dataset) -> bool:
    """Return whether a result holds what a comparison reads: only those of the task ``forward`` do."""
    return all(name in dataset.files for name in ("metrics.json", "config.json", error_sums.FILE))


def grouped(runs: Sequence[Run]) -> list[Method]:
    """Return the methods of runs, sorted by name.

    A method is architecture, representation, actions, timeline and all params but the seed. Its name states a timeline
    that is not that of most runs, and the params in which it differs from others that are the same but for these.
    """
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(_key(run.config, params=True), []).append(run)
    alike: dict[str, list[Tree]] = {}
    for same in found.values():
        alike.setdefault(_key(same[0].config, params=False), []).append(_params(same[0].config))
    usual = main_timeline(runs)
    made = []
    for same in found.values():
        config = same[0].config
        described = _differing(_params(config), alike[_key(config, params=False)])
        made.append(Method(name(config, usual, described), tuple(same)))
    return sorted(made, key=lambda method: method.name)


def main_timeline(runs: Sequence[Run]) -> str:
    """Return the timeline of most runs; where two have as many, the last in the alphabet, which puts uniform first."""
    count = Counter(timeline(run.config) for run in runs)
    return max(count, key=lambda name: (count[name], name))


def papers(methods: Sequence[Method]) -> Method | None:
    """Return the method nearest to what the paper found best: the recurrent model of 20 principal components."""
    found = [one for one in methods if one.recurrent and one.actions == "planned" and one.codec["of"] == "levels"]
    return min(found, key=_distance, default=None)


def paper_row(codec: Tree) -> str | None:
    """Return what Table 1 of the paper calls a representation; None where it has none such.

    >>> paper_row({"kind": "autoencoder", "of": "levels", "frames": 2, "latents": 8})
    'AE-C2'
    >>> paper_row({"kind": "pca", "of": "levels", "frames": 1, "latents": 8})
    """
    if codec["of"] != "levels":
        return None
    if codec["kind"] == "raw":
        return "raw"
    if codec["latents"] != _PAPER_WIDTH.get(codec["kind"]):
        return None
    return "PCA" if codec["kind"] == "pca" else f"AE-C{codec['frames']}"


def reference(methods: Sequence[Method]) -> Method:
    """Return the method whose runs report on the baselines: with most baselines, then most runs, better with a plan."""

    def place(one: Method) -> tuple[int, int, int, str]:
        baselines = {
            name for run in one.runs for name in run.errors.predictors if not name.startswith(("model", "codec"))
        }
        return -len(baselines), -len(one.runs), ACTIONS.index(one.actions), one.name

    return min(methods, key=place)


def _distance(method: Method) -> tuple[int, int, int, str]:
    """Return how far a recurrent method is from the paper's, for sorting."""
    kind = method.codec["kind"]
    off = abs(int(method.codec["latents"]) - _PAPER_WIDTH.get(kind, int(method.codec["latents"])))
    return _PREFERRED.index(kind), off, -len(method.runs), method.name


def actions(config: Tree) -> str:
    """Return what a model is informed of the motion to come: one of `ACTIONS`."""
    return str(config["params"].get("actions", "planned"))


def timeline(config: Tree) -> str:
    """Return what rows represent: a ``uniform`` grid, ``logged`` rows or ``fresh`` frames."""
    return str(config.get("timeline", "uniform"))


def _params(config: Tree) -> dict[str, Any]:
    """Return the params that make a model what it is, those apart that have a word of their own in a method's name."""
    found = params_of.counting(registry.load("train.forward"), config["params"])
    return {name: value for name, value in found.items() if name not in _NO_METHOD}


def _key(config: Tree, *, params: bool, without: str = "") -> str:
    """Return what names a method, seed and split left out."""
    described = {
        "architecture": config["architecture"],
        "codec": config["codec"]["name"],
        "actions": actions(config),
        "timeline": timeline(config),
        "params": _params(config) if params else {},
    }
    return json.dumps({name: value for name, value in described.items() if name != without}, sort_keys=True)


def _differing(params: Tree, alike: Sequence[Tree]) -> dict[str, Any]:
    """Return those params that are not the same in all of ``alike``."""
    return {name: value for name, value in sorted(params.items()) if any(one.get(name) != value for one in alike)}


def settings(config: Tree) -> dict[str, Any]:
    """Return all that makes a method, without seed and split."""
    codec = config["codec"]["name"]
    return {**_params(config), "codec": codec, "actions": actions(config), "timeline": timeline(config)}


def name(config: Tree, usual: str, params: Tree) -> str:
    """Return what a method is called, with a timeline that is not the ``usual`` one and some ``params``."""
    parts = [str(config["architecture"]).replace("_", " "), str(config["codec"]["name"])]
    if actions(config) != "planned":
        parts.append("no actions" if actions(config) == "none" else f"{actions(config)} actions")
    if timeline(config) != usual:
        parts.append(timeline(config))
    return " · ".join([*parts, *(f"{name} {value}" for name, value in params.items())])
