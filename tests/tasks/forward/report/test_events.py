"""The page's part on live sessions: there where a result has them, and nowhere else."""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from tacpipe.tasks.forward.report import events
from tests.report.parts import cells

LIVE = {
    "mae": {"live": {"t1": 2.5, "t10": 40.0}, "persistence": {"t1": 2.75, "t10": 41.0}},
    "rows": {"published": 1500, "equal": 1419, "compared": 1489, "differ_after_late_samples": 70, "skipped": 3},
    "latency": {
        "count": 1489,
        "median_ms": 6.25,
        "p99_ms": 8.5,
        "largest_ms": 22.0,
        "above_10_ms": 3,
        "above_20_ms": 1,
    },
    "alarms": {
        "slip alarm, slips": {
            "live": {"events": 13, "led": 1, "median_lead_ms": None, "false_alarms_per_hour": 41.5},
        }
    },
}


def context(live: dict[str, Any] | None) -> Any:
    return SimpleNamespace(runs=[SimpleNamespace(details=SimpleNamespace(metrics=SimpleNamespace(live=live)))])


def test_a_result_of_live_sessions_has_errors_rows_and_alarms() -> None:
    (fold,) = events.live_folds(context(LIVE))
    text = str(fold)
    for words in ("published live", "t+10", "1,419 of 1,489", "slip alarm, slips", "8.5", "41.5"):
        assert words in text


def test_steps_stand_in_their_order() -> None:
    errors = {"live": {"t1": 1.0, "t10": 3.0, "t5": 2.0}}  # in the order of JSON keys
    (fold,) = events.live_folds(context({**LIVE, "mae": errors}))
    text = str(fold)
    assert text.index("t+1'") < text.index("t+5'") < text.index("t+10'")


def test_a_session_without_forecasts_or_alarms_has_its_rows() -> None:
    (fold,) = events.live_folds(context({**LIVE, "mae": {}, "alarms": {}, "latency": {"count": 0}}))
    assert "1,500" in str(fold) and "published live" not in str(fold)


def test_another_result_has_no_such_part() -> None:
    assert events.live_folds(context(None)) == []


NAMES = ("events", "led", "median_lead_ms", "false_alarms", "minutes")


def run(**measures: tuple[int, int, float | None, int, float]) -> Any:
    """A run with what the alarm was worth by predictor."""
    tree = {name: dict(zip(NAMES, values, strict=True)) for name, values in measures.items()}
    return SimpleNamespace(details=SimpleNamespace(metrics=SimpleNamespace(slips=tree)))


def method(name: str, *runs: Any) -> Any:
    return SimpleNamespace(name=name, runs=list(runs))


def slip_context(*methods: Any) -> Any:
    return SimpleNamespace(methods=list(methods))


def test_runs_add_up_and_the_median_lead_is_weighted_by_slips_that_were_led() -> None:
    scores = events.slip_scores(
        method("gru", run(model=(10, 6, 120.0, 3, 4.0)), run(model=(30, 2, 40.0, 5, 12.0))), "model"
    )
    assert scores is not None
    assert (scores["events"], scores["led"], scores["false_alarms"], scores["minutes"]) == (40, 8, 8, 16.0)
    assert scores["led_percent"] == pytest.approx(20)
    assert scores["median_lead_ms"] == pytest.approx((6 * 120 + 2 * 40) / 8)
    assert scores["false_alarms_per_hour"] == pytest.approx(30)


def test_without_a_slip_that_was_led_there_is_no_lead_and_without_minutes_no_rate() -> None:
    scores = events.slip_scores(method("gru", run(model=(4, 0, None, 0, 0.0))), "model")
    assert scores is not None and scores["led_percent"] == 0
    assert math.isnan(scores["median_lead_ms"]) and math.isnan(scores["false_alarms_per_hour"])


def test_a_run_whose_recordings_do_not_state_slips_counts_for_nothing() -> None:
    single_run = method("gru", run(model=(10, 6, 120.0, 3, 4.0)))
    assert events.slip_scores(method("gru", *single_run.runs, run()), "model") == events.slip_scores(
        single_run, "model"
    )
    assert events.slip_scores(single_run, "ridge") is None
    assert events.slip_scores(method("gru", run()), "model") is None


def test_the_table_has_methods_and_baselines_the_best_first_and_no_interval_of_slips_that_are_alike() -> None:
    best = method("taxelwise", run(model=(10, 6, 120.0, 1200, 4.0), persistence=(10, 1, 20.0, 3, 4.0)))
    (fold,) = events.slip_folds(slip_context(method("gru", run(model=(10, 4, 60.0, 3, 4.0))), best))
    table, note = fold.blocks
    assert "without an interval" in note.text  # type: ignore[union-attr]
    assert [str(row.cells[0]) for row in table.rows] == ["taxelwise", "gru", "persistence"]  # type: ignore[union-attr]
    assert cells(table, "taxelwise") == ["10", "6", "60", "120", "1,200", "4", "18,000"]  # type: ignore[arg-type]


def test_results_of_recordings_without_slips_have_no_such_part() -> None:
    assert events.slip_folds(slip_context(method("gru", run()))) == []
