"""Read the content and origin of results, and collect the results of one task."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, cast

import numpy as np

from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import MODEL, ComparedRun, Method, Settings, TaskReport
from tacpipe.datasets.selection import PUBLISHED, is_simulated
from tacpipe.io.parquet import from_parquet
from tacpipe.metrics.calibration import COVERAGE_FILE
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.rows import TABLE_HEADS, table_of_rows
from tacpipe.report import charts
from tacpipe.report.blocks import Block, Cell, Chart, Charts, Fold, fold, notes, table
from tacpipe.report.charts import Curve, Spec
from tacpipe.store.records import Step
from tacpipe.training.following import Line, read_history

if TYPE_CHECKING:
    import pandas as pd

    from tacpipe.datasets.dataset import Dataset
    from tacpipe.tasks.task import ModelConfig


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
    def history(self) -> Sequence[Line]:
        """The lines of ``history.jsonl``, one per epoch; empty if training had no epochs."""
        return read_history(self.dataset.files.get("history.jsonl", b""))

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
        """Whether its recordings are those of the task's paper."""
        return is_published(self.dataset, self.SETS)


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


def is_published(result: Dataset, sets: Collection[str]) -> bool:
    """Return whether all recordings of a result belong to published ``sets``.

    The papers' numbers apply only to these data. `tacpipe ingest` sets the attribute ``published`` of a recording to
    its set.
    """
    set_names = [str(shard.attributes.get(PUBLISHED) or "") for shard in result.recordings.values()]
    return bool(set_names) and all(text and set(text.split(",")) <= set(sets) for text in set_names)


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


def loss_chart(
    runs: Mapping[str, Sequence[Sequence[float]]], quantity: str, order: Sequence[str] = (), *, log: bool = False
) -> Spec:
    """Return a chart with a thin line per run, which has one value per epoch, and the mean over the runs of each name.

    The mean ends with the shortest run. NaN breaks a line.
    """
    lines = []
    for name, curves in runs.items():
        if len(curves) > 1:
            lines += [Curve(name, range(1, len(curve) + 1), curve, thin=True) for curve in curves]
        length = min(map(len, curves))
        mean = np.mean([curve[:length] for curve in curves], axis=0)
        lines.append(Curve(name, range(1, length + 1), mean))
    is_single_epoch = all(
        len(curve) < 2 for curves in runs.values() for curve in curves
    )  # a single value does not make a line
    return charts.lines(lines, "epoch", quantity, order=order, log=log, points=is_single_epoch)


def read_coverage(results: Sequence[Dataset]) -> pd.DataFrame | None:
    """Return the rows of the coverage files of results, joined, or None if no result is of a calibrated model."""
    import pandas as pd

    files = [result.files[COVERAGE_FILE] for result in results if COVERAGE_FILE in result.files]
    return pd.concat([from_parquet(file).to_pandas() for file in files]) if files else None


def band_fold(
    levels: Sequence[int],
    drawn: Sequence[Chart],
    explained: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[str | Cell]],
    *more: Block,
    about: str = "",
) -> list[Fold]:
    """Return the fold on bands between the outer ``levels`` in percent: charts of coverage, a table, and ``more``.

    ``explained`` is the note between the charts and the table, with ``heads`` and ``rows``; ``about`` follows the
    title.
    """
    title = f"Bands from the {levels[0]} to the {levels[-1]} % quantile"
    return fold("Uncertainty", Charts(drawn), notes(explained), table(title, heads, rows), *more, about=about)


def without_gaps(values: Sequence[float | None]) -> list[float]:
    """Return one value per epoch, NaN for epochs without one, or an empty list if no epoch has one.

    >>> without_gaps([None, 1]), without_gaps([None, None])
    ([nan, 1.0], [])
    """
    if all(value is None for value in values):
        return []
    return [math.nan if value is None else float(value) for value in values]


def curves_of_methods(methods: Sequence[Method], read: Callable[[Any], list[float]]) -> dict[str, list[list[float]]]:
    """Return the curves that ``read`` returns for each method's results, by method name.

    Methods without curves are omitted.
    """
    by_method = {method.name: [curve for result in method.details if (curve := read(result))] for method in methods}
    return {name: curves for name, curves in by_method.items() if curves}


@dataclass(frozen=True)
class Context:
    """The results of one task with their comparisons, and related datasets."""

    task: TaskReport
    methods: Sequence[Method]
    comparisons: Sequence[Comparison]
    others: Sequence[Dataset] = ()  # datasets that are not results
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
