"""Accuracies of pooled runs against those worked out by hand: a sensor has 20 slides, 5 of each of 4 materials."""

from __future__ import annotations

import math
from typing import Any

import pytest

from tacpipe.comparison.runs import ComparedRun
from tacpipe.metrics.intervals import wilson
from tacpipe.tasks.material.report import methods, scores
from tests.tasks.material.report.material_fakes import result


def runs(*results: Any) -> list[ComparedRun]:
    return methods.read_runs(results)


def test_runs_on_the_same_slides_are_pooled_but_claim_no_more_slides() -> None:
    measured = scores.accuracy(runs(*(result(wrong={"biotac": wrong}, fold=wrong) for wrong in (2, 6))), "biotac")
    assert measured is not None
    assert (measured.correct, measured.evaluated, measured.slides, measured.runs) == (32, 40, 20, 2)
    assert measured.fraction == 0.8
    assert measured.sd == pytest.approx(0.2 / math.sqrt(2))  # deviation of 0.9 and 0.7
    assert (measured.low, measured.high) == wilson(16, 20)


def test_runs_on_other_slides_add_theirs() -> None:
    evaluated_runs = runs(*(result(wrong={"biotac": 2}, first=first) for first in (1, 100)))
    measured = scores.accuracy(evaluated_runs, "biotac")
    assert measured is not None
    assert measured.slides == 40
    assert (measured.low, measured.high) == wilson(36, 40)


def test_a_single_run_has_no_spread_and_another_sensor_no_accuracy() -> None:
    measured = scores.accuracy(runs(result(wrong={"biotac": 2})), "biotac")
    assert measured is not None and math.isnan(measured.sd)
    assert scores.accuracy(runs(result(wrong={"biotac": 2})), "roboskin") is None
    assert scores.accuracy(runs(result(wrong={"biotac": 2})), "biotac", "swapped") is None


def test_each_slide_has_the_share_of_runs_that_named_it_right() -> None:
    measured = scores.slides_named_right(runs(*(result(wrong={"biotac": wrong}) for wrong in (0, 1))), "biotac")
    by_slide = measured.groupby("recording").mean()
    assert by_slide["biotac-m01-t001"] == 0.5
    assert by_slide.sum() == 19.5


def test_skill_is_the_share_of_the_mean_levels_mistakes_that_is_avoided() -> None:
    evaluated_runs = runs(result(wrong={"biotac": 2}, also={"mean_level": {"biotac": 8}}), result(wrong={"biotac": 20}))
    assert scores.level_skill(evaluated_runs, "biotac") == pytest.approx(0.75)  # the second run has no mean level
    assert scores.level_skill(evaluated_runs, "biotac", "mean_level") == 0
    perfect = runs(result(wrong={"biotac": 2}, also={"mean_level": {"biotac": 0}}))
    assert math.isnan(scores.level_skill(perfect, "biotac"))
