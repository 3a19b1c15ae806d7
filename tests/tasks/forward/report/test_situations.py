"""Errors by situation, pooled over the runs of a method."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tacpipe.tasks.forward.report.skill import situation_folds, skill_in_situation


def run(**measured: tuple[int, float, float, float]) -> Any:
    """A run with windows, errors of persistence and of the model, and skill by situation."""
    tree = {
        name.replace("_", " "): {
            "windows": windows,
            "mae_counts": {"persistence": {"mean": persistence}, "model": {"mean": model}},
            "skill": {"mean": {"mean": skill, "low": skill - 0.1, "high": skill + 0.1}},
        }
        for name, (windows, persistence, model, skill) in measured.items()
    }
    return SimpleNamespace(details=SimpleNamespace(metrics=SimpleNamespace(situations=tree)))


def test_several_runs_are_weighted_by_their_windows_and_one_has_its_interval() -> None:
    first, second = (
        run(closing=(100, 40.0, 30.0, 0.2), slipping=(50, 80.0, 60.0, 0.3)),
        run(closing=(300, 20.0, 20.0, 0.0)),
    )
    method: Any = SimpleNamespace(name="mixed", runs=[first, second])
    pooled = skill_in_situation(method, "closing")
    assert pooled is not None
    assert pooled["windows"] == 400
    assert (pooled["persistence"], pooled["model"]) == pytest.approx((25.0, 22.5))
    assert pooled["skill"] == pytest.approx(0.05)
    assert pooled["part"] == pytest.approx((4000 + 6000) / (4000 + 6000 + 4000))
    assert np.isnan(pooled["low"])
    single = skill_in_situation(SimpleNamespace(name="mixed", runs=[first]), "slipping")  # type: ignore[arg-type]
    assert single is not None and (single["low"], single["high"]) == pytest.approx((0.2, 0.4))
    assert skill_in_situation(method, "releasing") is None


def test_results_without_situations_have_no_table() -> None:
    empty: Any = SimpleNamespace(methods=[SimpleNamespace(name="gru", runs=[run()])])
    assert situation_folds(empty) == []
    full: Any = SimpleNamespace(methods=[SimpleNamespace(name="mixed", runs=[run(closing=(100, 40.0, 30.0, 0.2))])])
    (fold,) = situation_folds(full)
    assert fold.title == "By situation"
    table: Any = fold.blocks[0]
    assert [getattr(cell, "text", cell) for cell in table.rows[0].cells][:4] == ["closing", "mixed", "100", "100.0 %"]
