"""The slides that count."""

import json
from typing import Any

from tacpipe.tasks.material.report import predictions
from tacpipe.tasks.material.report.predictions import SlidePredictions
from tests.tasks.material.report.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}


def read(fake_result: Any, **config: Any) -> SlidePredictions:
    content: Any = {**json.loads(fake_result.files["config.json"]), **config}
    return predictions.read_predictions(fake_result.recordings["predictions"].table(), content)


def test_slides_of_training_are_left_out() -> None:
    read_rows = read(result(wrong=BOTH))
    assert len(read_rows.recordings) == 40
    assert "biotac-seen" not in read_rows.recordings


def test_materials_held_out_of_a_sensors_labels_do_not_count_for_it() -> None:
    read_rows = read(result(wrong=BOTH), held_out={"biotac": [], "roboskin": [2, 4]})
    assert set(read_rows.of("roboskin").materials.tolist()) == {1, 3}
    assert set(read_rows.of("biotac").materials.tolist()) == {1, 2, 3, 4}


def test_the_last_batch_does_not_count_where_the_model_leaves_it_out() -> None:
    read_rows = read(result(wrong=BOTH, drop_last=True, batch=8))  # 20 slides, and one of training
    assert [len(read_rows.of(sensor).recordings) for sensor in BOTH] == [16, 16]


def test_a_predictor_that_says_nothing_of_a_sensor_has_no_names_there() -> None:
    read_rows = read(result(wrong=BOTH, also={"swapped": {"biotac": 0}}))
    assert (read_rows.of("roboskin").predicted["swapped"] == predictions.NOTHING).all()
    assert (read_rows.of("biotac").predicted["swapped"] == read_rows.of("biotac").materials).all()
    assert read_rows.latents is None


def test_latents_keep_their_order() -> None:
    read_rows = read(result(wrong=BOTH, epochs=3))
    assert read_rows.latents is not None and read_rows.latents.shape == (40, 40)
    assert read_rows.latents[:, 0].std() > read_rows.latents[:, 39].std()  # the fakes order them so
