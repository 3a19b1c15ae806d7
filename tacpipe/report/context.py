"""Read the content and origin of results, and define what a task adds to the page of its results."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, cast

import numpy as np

from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import MODEL, ComparedRun, Method, Settings, TaskResults
from tacpipe.datasets.selection import PUBLISHED, is_simulated
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.model import ModelConfig
from tacpipe.plugins.rows import TABLE_HEADS, table_of_rows
from tacpipe.report.blocks import Block, Cell, Fold, notes, table
from tacpipe.store.records import Step

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


Config = TypeVar("Config", bound="ModelConfig")
CALIBRATION = ("quantiles", "known")  # parts of a model's configuration that `tacpipe calibrate` adds
# setting of a method that has fewer epochs than that of the paper (`ReportResult.epochs_of_paper`)
SHORTENED = "shortened"
GROWS = "trained_on"  # a part that also contains the recordings of the calibration


class ReportResult(Generic[Config]):
    """One result: a model trained once and evaluated once."""

    STAGE: ClassVar[str] = ""  # stage that trained the model
    SETS: ClassVar[Collection[str]] = ()  # published sets whose paper's tables and figures are shown next to ours

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset

    @cached_property
    def config(self) -> Config:
        """The configuration of the model's training and evaluation."""
        config: Config = read_json(self.dataset, "config.json")
        return config

    @cached_property
    def params(self) -> Settings:
        """The training params that the model's architecture uses."""
        return cast("Settings", params_of.used_params(registry.load(self.STAGE), self.given))

    @property
    def given(self) -> Settings:
        """The params that are stored with the model."""
        config: ModelConfig = self.config
        return config.get("params", {})

    @property
    def epochs_of_paper(self) -> str:
        """The epochs of a paper's network, such as "150 of 2,000 epochs", if fewer than the paper's; else ""."""
        tagged_params = {"architecture": str(self.config.get("architecture")), **self.given}
        presets = params_of.presets_of(params_of.kind_of(registry.load(self.STAGE), tagged_params))
        epochs, paper_epochs = self.params.get("epochs"), presets.get("paper", {}).get("epochs")
        are_fewer = isinstance(epochs, int) and isinstance(paper_epochs, int) and 0 < epochs < paper_epochs
        return f"{epochs:,} of {paper_epochs:,} epochs" if are_fewer else ""

    @property
    def simulated(self) -> bool:
        """Whether any of its recordings was simulated."""
        return is_simulated(self.dataset)

    @property
    def published(self) -> bool:
        """Whether all its recordings belong to sets of the task's paper, whose numbers apply only to them.

        `tacpipe ingest` sets the attribute ``published`` of a recording to its set.
        """
        set_names = [str(shard.attributes.get(PUBLISHED) or "") for shard in self.dataset.recordings.values()]
        return bool(set_names) and all(text and set(text.split(",")) <= set(self.SETS) for text in set_names)


def read_json(result: Dataset, name: str) -> Any:
    """Return the content of a JSON file of a result, or an empty value if there is no such file."""
    return json.loads(result.files[name]) if name in result.files else {}


def drop_duplicates(results: Sequence[Dataset]) -> list[Dataset]:
    """Return the results without uncalibrated ones that also exist calibrated on the same recordings.

    Both contain the same predictions, so one training would count twice.
    """
    keys = [_result_key(result) for result in results]
    calibrated = {key for key, result in zip(keys, results, strict=True) if _is_calibrated(result)}
    return [
        result for key, result in zip(keys, results, strict=True) if _is_calibrated(result) or key not in calibrated
    ]


def _is_calibrated(result: Dataset) -> bool:
    return any(name in read_json(result, "config.json") for name in CALIBRATION)


def _result_key(result: Dataset) -> str:
    """Return a key that is equal for a model and its calibrated copy evaluated on the same recordings."""
    config = {key: value for key, value in read_json(result, "config.json").items() if key not in (*CALIBRATION, GROWS)}
    inputs = {name: value for name, value in result.manifest["inputs"].items() if name != "model"}
    return json.dumps([config, inputs], sort_keys=True)


SIMULATED = "These recordings were simulated, so the results are not evidence about real sensors."


def provenance_blocks(result: Dataset) -> list[Block]:
    """Return the chain of stages that produced a dataset, with params, digests, and the rows that were read."""
    manifest = result.manifest
    last: Step = {
        "stage": manifest["stage"],
        "version": manifest["version"],
        "params": manifest["params"],
        "fitted": None,
    }
    rows = []
    for step in (*manifest["chain"], last):
        current_params = params_of.with_current_names(step["stage"], step["params"])
        params = ", ".join(f"{key} = {json.dumps(value)}" for key, value in current_params.items())
        fitted = ", ".join(f"{name} {digest[:12]}" for name, digest in (step["fitted"] or {}).items())
        rows.append([step["stage"], str(step["version"]), params, fitted])
    dataset_digests = [("this result", manifest["digest"])]
    for argument, datasets in manifest["inputs"].items():
        dataset_digests += [(argument, dataset["dataset"]) for dataset in datasets]
    digests = [[name, digest] for name, digest in dataset_digests if digest]
    counted = [row for dataset in result.chain_rows for row in table_of_rows(dataset["stages"])]
    uncounted = sum(dataset["uncounted"] for dataset in result.chain_rows)
    return [
        table("Stages, the oldest first", ["stage", "version", "params", "fitted"], rows, words=True),
        *([table("Rows that were read", TABLE_HEADS, counted, words=True)] if counted else []),
        *([notes(f"The rows of {uncounted} results were not counted.")] if uncounted else []),
        table("Digests of datasets", ["", "digest"], digests, words=True),
    ]


class TaskReport(TaskResults):
    """How results of one task are read, compared and reported.

    A task's report is a subclass that overrides `read`, so that its results are compared, and the methods that add to
    the page. An instance of this class reports results by their headlines and the numbers in ``metrics.json``.
    """

    def uses(self, dataset: Dataset) -> bool:
        """Return whether the page can use a dataset that is not a result."""
        return False

    def columns(
        self, context: Context, comparison: Comparison
    ) -> Sequence[tuple[str, Callable[[ComparisonRow], Cell]]]:
        """Return additional columns for the table of all methods, as pairs of a head and a function from row to cell."""
        return []

    def sentence(self, context: Context) -> tuple[str, str] | None:
        """Return the first sentence of the section and its verdict, or None for how the best method compares."""
        return None

    def folds(self, context: Context) -> Sequence[Fold]:
        """Return the parts of the task's section after the comparison."""
        return []

    def caveats(self, context: Context) -> Sequence[str]:
        """Return sentences about the limits of the numbers."""
        return []

    def run_columns(self, run: ComparedRun) -> dict[str, str | Cell]:
        """Return additional columns for the table of runs, by head."""
        return {}


@dataclass(frozen=True)
class Context:
    """The results of one task with their comparisons."""

    task: TaskReport
    methods: Sequence[Method]
    comparisons: Sequence[Comparison]
    bare: Sequence[Dataset] = ()  # results without anything to compare
    traces: int = 0  # number of recordings that are drawn completely
    runs: Sequence[ComparedRun] = field(default=())

    @cached_property
    def parts(self) -> dict[str, list[Comparison]]:
        """The comparisons by part of the recordings."""
        by_part: dict[str, list[Comparison]] = {}
        for comparison in self.comparisons:
            by_part.setdefault(comparison.question.part, []).append(comparison)
        return by_part

    @property
    def simulated(self) -> bool:
        """Whether any run was evaluated on simulated recordings."""
        return any(run.simulated for run in self.runs)

    @property
    def published(self) -> bool:
        """Whether all runs were evaluated on the recordings of the task's paper."""
        return bool(self.runs) and all(run.published for run in self.runs)

    def winner(self, part: str) -> Method | None:
        """Return the method with the best mean rank over the targets of a part, or None if none has a rank for all targets.

        Ties are broken by name.
        """
        ranks: dict[str, list[int]] = {}
        for method in self.parts[part]:
            for index, row in enumerate(method.models):
                ranks.setdefault(row.name, []).append(index)
        target_count = max(map(len, ranks.values()), default=0)
        mean_ranks = {
            name: float(np.mean(method_ranks))
            for name, method_ranks in ranks.items()
            if len(method_ranks) == target_count
        }
        best = min(mean_ranks, key=lambda name: (mean_ranks[name], name), default=None)
        return next((method for method in self.methods if method.name == best), None)

    def row(self, comparison: Comparison, method: Method | None) -> ComparisonRow | None:
        """Return the row of a method in a comparison, or None if it has none."""
        return next(
            (row for row in comparison.rows if method and row.method is method and row.name == method.name), None
        )


def median_run(method: Method, comparison: Comparison) -> ComparedRun:
    """Return a method's run with the median score in a comparison, or the lower of the two middle ones."""
    measure, question = comparison.measure, comparison.question
    runs = method.of(question)

    def by_score(run: ComparedRun) -> tuple[float, str]:
        return measure.score_of(run.questions[question].sums[MODEL].values()), str(run.seed)

    return sorted(runs, key=by_score)[(len(runs) - 1) // 2]
