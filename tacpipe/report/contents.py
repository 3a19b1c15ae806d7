"""The files of a result, read when they are asked for; each task adds what its own hold."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.report import provenance

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Tree = Mapping[str, Any]
CALIBRATION = ("quantiles", "known")  # what `tacpipe calibrate` adds to a model's configuration
GROWS = "trained_on"  # which names the recordings of the calibration too


class Result:
    """One result: a model trained once and evaluated once."""

    STAGE: ClassVar[str] = ""  # that trained the model
    SETS: ClassVar[Collection[str]] = ()  # published sets whose paper's tables and figures are next to ours

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset

    @cached_property
    def config(self) -> Tree:
        """What the model was trained and evaluated with."""
        return tree(self.dataset, "config.json")

    @cached_property
    def metrics(self) -> Tree:
        """All errors of the result by name."""
        return tree(self.dataset, "metrics.json")

    @cached_property
    def history(self) -> Sequence[Tree]:
        """What ``history.jsonl`` states, one line an epoch; empty where nothing was trained by epochs."""
        lines = self.dataset.files.get("history.jsonl", b"").splitlines()
        return [json.loads(line) for line in lines if line.strip()]

    @cached_property
    def params(self) -> Tree:
        """What the model was trained with, as far as it counts for its architecture."""
        return params_of.counting(registry.load(self.STAGE), self.given)

    @property
    def given(self) -> Tree:
        """The params that are stored with the model."""
        found: Tree = self.config.get("params", {})
        return found

    @property
    def simulated(self) -> bool:
        """Whether any of its recordings was simulated."""
        return provenance.simulated(self.dataset)

    @property
    def published(self) -> bool:
        """Whether its recordings are those of the task's paper."""
        return provenance.published(self.dataset, self.SETS)


def tree(result: Dataset, name: str) -> Tree:
    """Return what a JSON file of a result holds; empty where there is none of the name."""
    found: Tree = json.loads(result.files[name]) if name in result.files else {}
    return found


def counted_once(results: Sequence[Dataset]) -> list[Dataset]:
    """Return results without those whose model was evaluated on the same recordings once it was calibrated too.

    Both hold the same predictions, so that one training would count as two.
    """
    keys = [_key(one) for one in results]
    calibrated = {key for key, one in zip(keys, results, strict=True) if _is_calibrated(one)}
    return [one for key, one in zip(keys, results, strict=True) if _is_calibrated(one) or key not in calibrated]


def _is_calibrated(result: Dataset) -> bool:
    return any(name in tree(result, "config.json") for name in CALIBRATION)


def _key(result: Dataset) -> str:
    """Return what is the same of a model and its calibrated copy, and what they were evaluated on."""
    config = {key: value for key, value in tree(result, "config.json").items() if key not in (*CALIBRATION, GROWS)}
    given = {name: one for name, one in result.manifest.get("inputs", {}).items() if name != "model"}
    return json.dumps([config, given], sort_keys=True)
