"""Predictions for grasps without a reading."""

from __future__ import annotations

from pathlib import Path

import pytest

from tacpipe.errors import TacpipeError
from tacpipe.tasks.touch import model as touch_prediction
from tests.tasks.touch.handmade import cloud, dataset, evaluated, recording, recordings, trained

FAST = {"architecture": "trees", "targets": "pdc_th,e_mf"}


def test_grasps_without_reading_are_told_what_evaluate_tells(tmp_path: Path) -> None:
    files = trained(tmp_path, **FAST)
    table = touch_prediction.predict(files, recordings(6, 2, felt=False)).recordings["predictions"].streams[""]
    assert table.column_names == ["recording", "pdc_th", *(f"e_mf_{n:02d}" for n in range(1, 25))]
    assert table.column("recording").to_pylist() == ["ball-006", "ball-007", "melon-006", "melon-007"]
    evaluated_table = evaluated(files, recordings(6, 2))[1].recordings["predictions"].streams["model"]
    assert table.drop_columns(["recording"]).equals(evaluated_table)


def test_what_is_not_what_the_model_reads_is_refused(tmp_path: Path) -> None:
    files = trained(tmp_path, **FAST)
    with pytest.raises(TacpipeError, match="no grasp to predict"):
        touch_prediction.predict(files, dataset())
    with pytest.raises(TacpipeError, match="melon-003 has a cloud without colours"):
        touch_prediction.predict(files, dataset(recording(3, "melon", cloud=cloud(3, 0.05, coloured=False))))
