"""What makes a method of forecasting, and which method is the paper's."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

from tacpipe.report import contents
from tacpipe.report.contents import Tree
from tacpipe.tasks.forward.params import Recurrent
from tacpipe.tasks.forward.report import error_sums
from tacpipe.tasks.forward.report.error_sums import ErrorSums

if TYPE_CHECKING:
    from tacpipe.comparison.runs import Method
    from tacpipe.datasets.dataset import Dataset

ACTIONS = ("planned", "none", "shuffled")
_PAPER_WIDTH = {"pca": 20, "autoencoder": 8}  # latents the paper keeps
_NO_METHOD = ("seed", "actions", "architecture", "baselines")  # baselines are fitted next to the model
_PREFERRED = ("pca", "autoencoder", "raw")  # the paper's own order of what forecasts best


class Result(contents.Result):
    """One result of forecasts."""

    STAGE = "train.forward"
    SETS = ("xela-flat",)

    @cached_property
    def errors(self) -> ErrorSums:
        """The error sums of recordings that the model has not seen."""
        return error_sums.read(self.dataset.files[error_sums.FILE])

    @property
    def actions(self) -> str:
        """What the model is informed of the motion to come: one of `ACTIONS`."""
        return str(self.given.get("actions", "planned"))

    @property
    def timeline(self) -> str:
        """What rows represent: a ``uniform`` grid, ``logged`` rows or ``fresh`` frames."""
        return str(self.config.get("timeline", "uniform"))

    @property
    def rate_hz(self) -> float:
        """Rows a second; 0 where a row has no fixed duration."""
        return float(self.config.get("rate_hz") or 0)

    @property
    def settings(self) -> dict[str, Any]:
        """All that makes its method, without seed and split."""
        params = {name: value for name, value in self.params.items() if name not in _NO_METHOD}
        codec = self.config["codec"]["name"]
        return {**params, "codec": codec, "actions": self.actions, "timeline": self.timeline}

    @property
    def part_of_schedule(self) -> str:
        """The epochs of the paper's network, where they are fewer than the paper's, as "12 of 50 epochs"; else empty."""
        epochs, published = int(self.given.get("epochs", 0)), int(str(Recurrent.PRESETS["paper"]["epochs"]))
        shortened = self.config["architecture"] == "recurrent" and 0 < epochs < published
        return f"{epochs} of {published} epochs" if shortened else ""

    def name(self, usual: str) -> str:
        """Return what its method is called, with a timeline that is not the ``usual`` one and a shortened schedule."""
        parts = [str(self.config["architecture"]).replace("_", " "), str(self.config["codec"]["name"])]
        if self.actions != "planned":
            parts.append("no actions" if self.actions == "none" else f"{self.actions} actions")
        if self.timeline != usual:
            parts.append(self.timeline)
        if self.part_of_schedule:
            parts.append(self.part_of_schedule)
        return " · ".join(parts)


def comparable(dataset: Dataset) -> bool:
    """Return whether a result holds what a comparison reads: only those of the task ``forward`` do."""
    return all(name in dataset.files for name in ("metrics.json", "config.json", error_sums.FILE))


def main_timeline(runs: Sequence[Result]) -> str:
    """Return the timeline of most runs; where two have as many, the last in the alphabet, which puts uniform first."""
    count = Counter(run.timeline for run in runs)
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
    found: Tree = method.details[0].config["codec"]
    return found


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
