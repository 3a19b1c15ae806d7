"""Read forecast results as runs of methods, from their error sums."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

from tacpipe.comparison import runs
from tacpipe.comparison.runs import Question, Settings
from tacpipe.report import context
from tacpipe.report.context import drop_duplicates
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.metrics import ERRORS_FILE, ErrorSums
from tacpipe.tasks.forward.params import ForwardConfig

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


_NO_METHOD = ("seed", "actions", "architecture", "baselines")  # params that do not define a method


class ForwardResult(context.ReportResult[ForwardConfig]):
    """One result of forecasts."""

    STAGE = "train.forward"
    SETS = ("xela-flat",)

    @cached_property
    def errors(self) -> ErrorSums:
        """The error sums of recordings that the model was not trained on."""
        return ErrorSums.from_parquet(self.dataset.files[ERRORS_FILE])

    @property
    def actions(self) -> str:
        """The model's information on the future motion: planned, none or shuffled."""
        return str(self.given.get("actions", "planned"))

    @property
    def timeline(self) -> str:
        """The meaning of rows: a ``uniform`` grid, ``logged`` rows or ``fresh`` frames."""
        return str(self.config.get("timeline", "uniform"))

    @property
    def settings(self) -> Settings:
        """The settings that define its method, without seed and split."""
        params = {name: value for name, value in self.params.items() if name not in _NO_METHOD}
        codec = self.config["codec"]["name"]
        return {**params, "codec": codec, "actions": self.actions, "timeline": self.timeline}

    def name(self, usual: str) -> str:
        """Return the name of its method, with its timeline if it is not the ``usual`` one, and a shortened schedule."""
        parts = [str(self.config["architecture"]).replace("_", " "), str(self.config["codec"]["name"])]
        if self.actions != "planned":
            parts.append("no actions" if self.actions == "none" else f"{self.actions} actions")
        if self.timeline != usual:
            parts.append(self.timeline)
        if self.epochs_of_paper:
            parts.append(self.epochs_of_paper)
        return " · ".join(parts)


Method = runs.Method[ForwardResult]
ComparedRun = runs.ComparedRun[ForwardResult]


def main_timeline(runs: Sequence[ForwardResult]) -> str:
    """Return the timeline of most runs; in a tie, the alphabetically last, which prefers uniform."""
    count = Counter(run.timeline for run in runs)
    return max(count, key=lambda name: (count[name], name))


ORACLES = ("codec", "codec_anchored")  # predictors that use the true future


def read_runs(results: Sequence[Dataset]) -> list[ComparedRun]:
    """Return the runs of results with error sums of recordings that the model was not trained on."""
    files = {"metrics.json", "config.json", ERRORS_FILE}
    all_results = [ForwardResult(result) for result in drop_duplicates(results) if files <= set(result.files)]
    runs = [result for result in all_results if result.errors.recordings]
    if not runs:
        return []
    steps = shown_steps(runs)
    usual = main_timeline(runs)
    return [_run(result, steps, usual) for result in runs]


def name_with_codec(predictor: str, codec: str) -> str:
    """Return the name of a predictor among several representations, with the codec's name if it depends on the codec.

    >>> name_with_codec("ridge", "PCA-20"), name_with_codec("codec_persistence", "PCA-20")
    ('ridge', 'codec_persistence PCA-20')
    """
    return f"{predictor} {codec}" if predictor.startswith("codec") else predictor


def shown_steps(runs: Sequence[ForwardResult]) -> tuple[int, ...]:
    """Return the steps to report, which all runs predict."""
    return headline.headline_steps(sorted(set.intersection(*(set(run.errors.steps) for run in runs))))


def _run(run: ForwardResult, steps: Sequence[int], usual: str) -> ComparedRun:
    """Return a result as a run of its method, with the errors of each predictor by question.

    ``usual`` is the timeline that is not named.
    """
    config = run.config
    elsewhere = run.timeline != usual
    timeline = f"{run.timeline} timeline" if elsewhere else ""
    questions = {}
    for known_objects, scored in run.errors.tables(steps, headline.unit_of_model(config)).items():
        part = ", ".join(filter(None, (headline.PARTS[known_objects], timeline)))
        question = Question(part, place=2 * elsewhere + (known_objects is False))
        sums = {name_with_codec(name, str(config["codec"]["name"])): own for name, own in scored.sums.items()}
        questions[question] = replace(scored, sums=sums)
    return ComparedRun(
        run.dataset,
        headline.TASK,
        run.name(usual),
        run.settings,
        questions,
        family=str(config["architecture"]).replace("_", " "),
        seed=run.given.get("seed"),
        published=run.published,
        control=run.actions == "shuffled",
        details=run,
    )
