"""The report of slip results: folds are pooled, and controls are marked."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from tacpipe.comparison.runs import Method
from tacpipe.tasks.slip import evaluation
from tacpipe.tasks.slip.metrics import QUESTIONS
from tacpipe.tasks.slip.params import SlipBoosting
from tacpipe.tasks.slip.report import ALARM_HEADS, SlipReport, alarm_table, area_table, pooled_metrics
from tests.fake_recordings import FakeDataset, dataset
from tests.tasks.slip.slip_recordings import stored, trained, trials

SMALL = SlipBoosting(trees=10, leaves=4, leaf=10, learning_rate=0.3)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """Two folds of one method, and a control of shuffled labels."""
    folder = tmp_path_factory.mktemp("workspace")
    files = trained(SMALL, dataset(*trials(12)), None, folder / "a")
    shuffled = trained(dataclasses.replace(SMALL, labels="shuffled"), dataset(*trials(12)), None, folder / "b")
    return [
        stored(evaluation.evaluate(model, dataset(*trials(6, first, simulated=first == 200))))
        for model, first in ((files, 100), (files, 200), (shuffled, 100))
    ]


def test_runs_have_the_areas_of_the_metrics_and_the_control_is_marked(results: list[Any]) -> None:
    without_windows: Any = FakeDataset()
    runs = SlipReport("slip").read([*results, without_windows])
    assert [run.control for run in runs] == [False, False, True]
    assert [run.simulated for run in runs] == [False, True, False]
    assert [question.target for question in runs[0].questions] == [*QUESTIONS.values()]
    errors = next(iter(runs[0].questions.values()))
    metrics = json.loads(results[0].files["metrics.json"])
    for predictor in ("model", "time_only", "constant"):
        score = errors.measure.score_of(errors.sums[predictor].values())
        assert score == pytest.approx(metrics[predictor]["auc"]["before"]["value"], abs=1e-5)


def test_the_metrics_of_folds_are_those_of_all_their_recordings(results: list[Any]) -> None:
    runs = SlipReport("slip").read(results[:2])
    pooled = pooled_metrics(Method("boosting", "", {}, {}, tuple(runs)))
    assert pooled["counts"]["recordings"] == 12
    assert pooled["counts"]["slips"] == 6
    areas = area_table(pooled)
    assert list(areas.heads) == [*("windows", "model", "best feature", "constant", "time only")]
    alarms = alarm_table(pooled)
    assert len(alarms.rows) == 3
    assert all(len(row.cells) == len(ALARM_HEADS) + 1 for row in alarms.rows)


def test_a_recording_that_two_folds_test_counts_where_its_object_is_new(results: list[Any]) -> None:
    evaluated = dataclasses.replace(evaluation.EvaluatedSlips.from_result(results[0]), known_objects=frozenset())
    objects = frozenset(track.object for track in evaluated.tracks)
    trained = dataclasses.replace(
        evaluated, known_objects=objects, levels={track.name: {} for track in evaluated.tracks}
    )
    for pooled in (trained.pooled([evaluated]), evaluated.pooled([trained])):
        assert len(pooled.tracks) == len(evaluated.tracks)
        assert pooled.levels == evaluated.levels


def test_the_report_needs_no_torch(tmp_path: Path) -> None:
    from tests.conftest import run_python

    lines = "import sys, tacpipe.tasks.slip.report; print('torch' in sys.modules)"
    assert run_python(tmp_path, "-c", lines, check=True).stdout == "False\n"
