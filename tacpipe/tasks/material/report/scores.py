"""Compute accuracies over slides, and differences between methods."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from tacpipe.comparison import engine
from tacpipe.comparison.engine import PairedRuns, observations, paired_runs
from tacpipe.comparison.runs import Question
from tacpipe.metrics.intervals import mcnemar, wilson
from tacpipe.metrics.pairing import Gain
from tacpipe.report import context
from tacpipe.report.blocks import NONE, Cell, fixed
from tacpipe.tasks.material.report import methods
from tacpipe.tasks.material.report.methods import ComparedRun, Method, has_usual_settings, question_on, runs_on
from tacpipe.tasks.material.report.predictions import LEVEL, MODEL


@dataclass(frozen=True)
class Accuracy:
    """Fraction of correctly classified slides, pooled over runs."""

    correct: int  # number of correct slides, summed over all runs
    evaluated: int
    slides: int  # number of distinct slides
    low: float  # 95 % Wilson interval over slides
    high: float
    sd: float  # standard deviation over runs; NaN for a single run
    runs: int

    @property
    def fraction(self) -> float:
        """Fraction of correctly classified slides."""
        return self.correct / self.evaluated


def accuracy(runs: Sequence[ComparedRun], sensor: str, predictor: str = MODEL) -> Accuracy | None:
    """Return the accuracy of a predictor on a sensor's slides; None if there are no predictions."""
    named_right = slides_named_right(runs, sensor, predictor)
    if not len(named_right):
        return None
    correct, evaluated, slides = int(named_right.sum()), len(named_right), named_right.index.unique("recording").size
    by_run = named_right.groupby("run").mean()
    low, high = wilson(round(correct / evaluated * slides), slides)
    return Accuracy(correct, evaluated, slides, low, high, float(by_run.std()), len(by_run))


def level_skill(runs: Sequence[ComparedRun], sensor: str, predictor: str = MODEL) -> float:
    """Return 1 - errors / errors of the mean level over runs with both; NaN if the mean level has no errors.

    1 is perfect, 0 is no better than the time-averaged channels.
    """
    comparable = [run for run in runs if {LEVEL, predictor} <= set(run.details.predictions.predicted)]
    result, level = (accuracy(comparable, sensor, name) for name in (predictor, LEVEL))
    if result is None or level is None or level.fraction == 1:
        return float("nan")
    return 1 - (1 - result.fraction) / (1 - level.fraction)


def slides_named_right(runs: Sequence[ComparedRun], sensor: str, predictor: str = MODEL) -> pd.Series:
    """Return 1 for each correctly classified slide and 0 for others, by run and recording."""
    questions = {question: None for run in runs if (question := methods.question_on(run, sensor))}
    parts = [observations(runs, question, predictor) for question in questions]
    table = pd.concat(parts) if parts else observations((), Question(), predictor)
    return table.set_index(["run", "recording"])["s0"] if len(table) else pd.Series(dtype=float)


@dataclass(frozen=True)
class MethodDifference:
    """Difference of two methods on the slides that both were evaluated on."""

    slides: int
    gain: Gain  # in percentage points
    first_only: int  # number of slides that only the first method classifies correctly
    second_only: int
    mcnemar: float  # p-value
    runs: PairedRuns

    @property
    def word(self) -> str:
        """``better`` or ``worse`` for the first method, or ``unclear``."""
        return "better" if self.gain.low > 0 else "worse" if self.gain.high < 0 else "unclear"


@dataclass(frozen=True)
class MethodPair:
    """Two methods that a table compares."""

    name: str
    first: Method
    second: Method


def compare_runs(
    first: Method, second: Method, sensor: str, predictors: tuple[str, str] = (MODEL, MODEL)
) -> MethodDifference | None:
    """Return the difference of ``first`` and ``second`` on slides of a sensor; None if they share none.

    For McNemar's test a slide is correct if at least half of a method's runs classify it correctly.
    """
    runs_by_method = [runs_on(method, sensor) for method in (first, second)]
    if not all(runs_by_method) or (question := question_on(runs_by_method[0][0], sensor)) is None:
        return None
    gain = engine.difference(first, second, question, predictors)
    if not gain.clusters:
        return None
    first_right, second_right = (
        slides_named_right(runs, sensor, name).groupby("recording").mean() >= 0.5
        for runs, name in zip(runs_by_method, predictors, strict=True)
    )
    first_right, second_right = first_right.align(second_right, join="inner")
    p = mcnemar(first_right.to_numpy(), second_right.to_numpy())
    only = int((first_right & ~second_right).sum()), int((second_right & ~first_right).sum())
    return MethodDifference(
        gain.clusters, gain, *only, p, paired_runs(runs_by_method[0], runs_by_method[1], question, predictors)
    )


def method_pairs(methods: Sequence[Method]) -> list[MethodPair]:
    """Return the pairs of methods that a table compares: a technique and the same method without it."""
    candidates = [candidate for candidate in methods if has_usual_settings(candidate.settings)]
    all_pairs = []
    for joint in (candidate for candidate in candidates if candidate.family == "RAEC joint"):
        twins = independent_method(methods, joint), permuted_method(methods, joint)
        all_pairs += [
            MethodPair(f"{joint.name} − {candidate.name}", joint, candidate) for candidate in twins if candidate
        ]
        all_pairs += [
            MethodPair(f"{candidate.name} − {joint.name}", candidate, joint)
            for candidate in candidates
            if candidate.family == "MiniRocket"
        ]
    return all_pairs


def is_control(method: Method) -> bool:
    """Return whether a method is the negative control: joint training on pairs of permuted materials."""
    settings = method.settings
    return (
        method.family == "RAEC joint" and settings["pairing"] == "permuted" and has_usual_settings(settings, "pairing")
    )


def main_method(methods: Sequence[Method], family: str = "RAEC joint") -> Method | None:
    """Return the method that represents a family: the unmodified one with the most runs; None if there is none."""
    candidates = [
        candidate for candidate in methods if has_usual_settings(candidate.settings) and candidate.family == family
    ]
    return max(candidates, key=lambda candidate: len(candidate.runs), default=None)


def independent_method(methods: Sequence[Method], joint: Method) -> Method | None:
    """Return the network that was trained on one sensor only and is most similar to a joint one, or None."""
    return nearest_method(
        joint,
        [method for method in methods if has_usual_settings(method.settings) and method.family == "RAEC independent"],
    )


def permuted_method(methods: Sequence[Method], joint: Method) -> Method | None:
    """Return the control that is most similar to a joint method, or None without controls."""
    return nearest_method(joint, [method for method in methods if is_control(method)])


def nearest_method(method: Method, candidates: Sequence[Method]) -> Method | None:
    """Return the candidate that shares the most settings with a method, or None without candidates.

    Ties are resolved by number of runs, then by name.
    """

    def shared(candidate: Method) -> int:
        return sum(candidate.settings.get(name) == value for name, value in method.settings.items())

    return max(candidates, key=lambda candidate: (shared(candidate), len(candidate.runs), candidate.name), default=None)


SESSIONS = (
    "Each material was recorded in one session, so these data cannot separate texture from session: a model that "
    "recognises a session by its drift or its mean level is also correct."
)


def caution(methods: Sequence[Method]) -> str:
    """Return a warning on what these slides cannot show, for every table of accuracies; empty if there is none."""
    if any(rows.simulated for rows in methods):
        return context.SIMULATED
    predictions = [result.predictions for rows in methods for result in rows.details]
    return SESSIONS if predictions and all(rows.one_session_each for rows in predictions) else ""


def format_percent(fraction: float) -> str:
    """Return a fraction in percent with one decimal, "–" for NaN.

    >>> format_percent(0.995), format_percent(float("nan"))
    ('99.5', '–')
    """
    return fixed(100 * fraction, 1)


def accuracy_cell(result: Accuracy | None) -> Cell:
    """Return a cell with an accuracy and its standard deviation over runs, above its counts and interval."""
    return count_cell(result.correct, result.evaluated, result.low, result.high, result.sd) if result else Cell(NONE)


def count_cell(correct: int, evaluated: int, low: float, high: float, sd: float) -> Cell:
    """Return a cell with a fraction in percent and its standard deviation, if any, above its counts and interval.

    >>> count_cell(190, 200, 0.91, 0.97, float("nan"))
    Cell(text='95.0', below='190/200 · 91.0 to 97.0', value=0.95, copy='')
    """
    spread = "" if math.isnan(sd) else f" ± {format_percent(sd)}"
    below = f"{correct}/{evaluated} · {format_percent(low)} to {format_percent(high)}"
    return Cell(f"{format_percent(correct / evaluated)}{spread}", below, correct / evaluated)
