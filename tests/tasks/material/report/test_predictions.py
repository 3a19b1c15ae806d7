"""The slides that count."""

import json
from typing import Any

import pandas as pd

from tacpipe.tasks.material import predictions
from tests.tasks.material.report.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}


def read(fake_result: Any, **config: Any) -> pd.DataFrame:
    content: Any = {**json.loads(fake_result.files["config.json"]), **config}
    return predictions.read_predictions(fake_result.recordings["predictions"].table(), content)


def test_slides_of_training_are_left_out() -> None:
    read_rows = read(result(wrong=BOTH))
    assert len(read_rows) == 40
    assert "biotac-seen" not in set(read_rows["recording"])


def test_materials_held_out_of_a_sensors_labels_do_not_count_for_it() -> None:
    read_rows = read(result(wrong=BOTH), held_out={"biotac": [], "roboskin": [2, 4]})
    materials = read_rows.groupby("sensor")["material"].agg(set)
    assert (materials["roboskin"], materials["biotac"]) == ({1, 3}, {1, 2, 3, 4})


def test_the_last_batch_does_not_count_where_the_model_leaves_it_out() -> None:
    read_rows = read(result(wrong=BOTH, drop_last=True, batch=8))  # 20 slides, and one of training
    assert read_rows["sensor"].value_counts().to_dict() == dict.fromkeys(BOTH, 16)


def test_a_predictor_that_says_nothing_of_a_sensor_has_no_names_there() -> None:
    read_rows = read(result(wrong=BOTH, also={"swapped": {"biotac": 0}}))
    biotac = read_rows[read_rows["sensor"] == "biotac"]
    assert read_rows[read_rows["sensor"] == "roboskin"]["swapped"].isna().all()
    assert (biotac["swapped"] == biotac["material"]).all()


def test_a_baseline_of_another_package_has_scores_too() -> None:
    fake_result = result(wrong=BOTH, also={"own_baseline": {"biotac": 3, "roboskin": 0}})
    config: Any = json.loads(fake_result.files["config.json"])
    table = fake_result.recordings["predictions"].table()
    rows = predictions.read_slides(table, config, ("model", "own_baseline"))
    sums = predictions.score_tables(rows[~rows["seen"]], BOTH, 4)["biotac"].sums
    assert {name: sum(right for right, _ in of_slides.values()) for name, of_slides in sums.items()} == {
        "model": 19,
        "own_baseline": 17,
        "chance": 5,
    }
