"""The page's part on live sessions: there where a result has them, and nowhere else."""

from types import SimpleNamespace
from typing import Any

from tacpipe.tasks.forward.report import events

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
}


def context(live: dict[str, Any] | None) -> Any:
    return SimpleNamespace(runs=[SimpleNamespace(details=SimpleNamespace(metrics=SimpleNamespace(live=live)))])


def test_a_result_of_live_sessions_has_errors_and_rows() -> None:
    (fold,) = events.live_folds(context(LIVE))
    text = str(fold)
    for words in ("published live", "t+10", "1,419 of 1,489", "8.5"):
        assert words in text


def test_steps_stand_in_their_order() -> None:
    errors = {"live": {"t1": 1.0, "t10": 3.0, "t5": 2.0}}  # in the order of JSON keys
    (fold,) = events.live_folds(context({**LIVE, "mae": errors}))
    text = str(fold)
    assert text.index("t+1'") < text.index("t+5'") < text.index("t+10'")


def test_a_session_without_forecasts_has_its_rows() -> None:
    (fold,) = events.live_folds(context({**LIVE, "mae": {}, "latency": {"count": 0}}))
    assert "1,500" in str(fold) and "published live" not in str(fold)


def test_another_result_has_no_such_part() -> None:
    assert events.live_folds(context(None)) == []
