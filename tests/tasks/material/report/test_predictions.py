"""Which slides count."""

from __future__ import annotations

import json
from typing import Any

from tacpipe.tasks.material.report import predictions
from tacpipe.tasks.material.report.predictions import Predictions
from tests.tasks.material.report.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}


def read(given: Any, **config: Any) -> Predictions:
    told = {**json.loads(given.files["config.json"]), **config}
    return predictions.read_predictions(given.recordings["predictions"].table(), told)


def test_slides_of_training_are_left_out() -> None:
    found = read(result(wrong=BOTH))
    assert len(found.recordings) == 40
    assert "biotac-seen" not in found.recordings


def test_materials_held_out_of_a_sensors_labels_do_not_count_for_it() -> None:
    found = read(result(wrong=BOTH), held_out={"biotac": [], "roboskin": [2, 4]})
    assert set(found.of("roboskin").materials.tolist()) == {1, 3}
    assert set(found.of("biotac").materials.tolist()) == {1, 2, 3, 4}


def test_the_last_batch_does_not_count_where_the_model_leaves_it_out() -> None:
    found = read(result(wrong=BOTH, drop_last=True, batch=8))  # of 20 slides and one of training
    assert [len(found.of(sensor).recordings) for sensor in BOTH] == [16, 16]


def test_a_predictor_that_says_nothing_of_a_sensor_has_no_names_there() -> None:
    found = read(result(wrong=BOTH, also={"swapped": {"biotac": 0}}))
    assert (found.of("roboskin").predicted["swapped"] == predictions.NOTHING).all()
    assert (found.of("biotac").predicted["swapped"] == found.of("biotac").materials).all()
    assert found.latents is None


def test_latents_keep_their_order() -> None:
    found = read(result(wrong=BOTH, epochs=3))
    assert found.latents is not None and found.latents.shape == (40, 40)
    assert found.latents[:, 0].std() > found.latents[:, 39].std()  # as the fakes make them
