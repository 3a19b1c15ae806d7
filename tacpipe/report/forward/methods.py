"""What makes a method of forecasting, and which method is the paper's."""

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
    from tacpipe.comparison.runs import Method
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


def comparable(dataset: Dataset) -> bool:
    """Return whether a result holds what a comparison reads: only those of the task ``forward`` do."""
    return all(name in dataset.files for name in ("metrics.json", "config.json", error_sums.FILE))


def main_timeline(runs: Sequence[Run]) -> str:
    """Return the timeline of most runs; where two have as many, the last in the alphabet, which puts uniform first."""
    count = Counter(timeline(run.config) for run in runs)
    return max(count, key=lambda name: (count[name], name))


def recurrent(method: Method) -> bool:
    """Return whether a method is the paper's encoder and decoder, with the plan."""
    return method.settings["actions"] == "planned" and method.family.startswith("recurrent")


def papers(methods: Sequence[Method]) -> Method | None:
    """Return the method nearest to what the paper found best: the recurrent model of 20 principal components."""
    found = [one for one in methods if recurrent(one) and codec(one)["of"] == "levels"]
    return min(found, key=_distance, default=None)


def codec(method: Method) -> Tree:
    """Return kind, width and name of a method's representation."""
    found: Tree = method.runs[0].details.config["codec"]
    return found


def key_without(method: Method, what: str) -> str:
    """Return what methods share that differ in one setting alone."""
    described = {**method.settings, "architecture": method.family}
    return json.dumps({name: value for name, value in described.items() if name != what}, sort_keys=True, default=str)


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


def _distance(method: Method) -> tuple[int, int, int, str]:
    """Return how far a recurrent method is from the paper's, for sorting."""
    found = codec(method)
    kind = found["kind"]
    off = abs(int(found["latents"]) - _PAPER_WIDTH.get(kind, int(found["latents"])))
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


def settings(config: Tree) -> dict[str, Any]:
    """Return all that makes a method, without seed and split."""
    codec = config["codec"]["name"]
    return {**_params(config), "codec": codec, "actions": actions(config), "timeline": timeline(config)}


def name(config: Tree, usual: str) -> str:
    """Return what a method is called, with a timeline that is not the ``usual`` one."""
    parts = [str(config["architecture"]).replace("_", " "), str(config["codec"]["name"])]
    if actions(config) != "planned":
        parts.append("no actions" if actions(config) == "none" else f"{actions(config)} actions")
    if timeline(config) != usual:
        parts.append(timeline(config))
    return " · ".join(parts)
