"""A calibrated classifier: probabilities, the answer unknown, and how both are measured with a material left out."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.tasks.material import calibration as material_calibration
from tacpipe.tasks.material import model as material_prediction
from tacpipe.tasks.material.model import MaterialModel
from tacpipe.tasks.task import CalibrationRequest
from tests.tasks.material.textures import MATERIALS, dataset, evaluated, slide, slides, trained

FOREIGN = 9  # a material that no model here learns
SENSORS = ("biotac", "roboskin")
ASKED = CalibrationRequest((10, 50, 90), False, 0.1, 0)


def foreign_slides(**attributes: Any) -> Any:
    """Slides of a material that the model does not know."""
    return dataset(*(slide(sensor, FOREIGN, trial, **attributes) for sensor in SENSORS for trial in range(4)))


def join_parts(known_slides: Any, unknown: Any) -> Any:
    return dataset(*known_slides.recordings.values(), *unknown.recordings.values())


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return trained(tmp_path_factory.mktemp("model"), slides(0, 8), slides(20, 5), use_validation=False)


@pytest.fixture(scope="module")
def model(plain: dict[str, bytes]) -> dict[str, bytes]:
    return material_calibration.calibrate(plain, ASKED, slides(0, 8), slides(20, 5))


def test_a_calibrated_model_names_the_same_and_adds_probabilities_and_answers(
    plain: dict[str, bytes], model: dict[str, bytes]
) -> None:
    requested = slides(40, 2)
    before, after = (
        material_prediction.predict(files, requested).recordings["predictions"].streams[""] for files in (plain, model)
    )
    assert before.equals(after)
    calibrated = material_prediction.predict(model, requested, probabilities=True).recordings["predictions"].streams[""]
    assert calibrated.select(before.column_names).equals(before)
    probabilities = np.column_stack([calibrated[f"probability_{kind:02d}"].to_numpy() for kind in MATERIALS])
    assert probabilities.sum(axis=1) == pytest.approx(1, abs=1e-5)
    assert [MATERIALS[at] for at in probabilities.argmax(axis=1)] == calibrated["material"].to_pylist()
    answered = zip(calibrated["answer"].to_pylist(), calibrated["material"].to_pylist(), strict=True)
    assert all(answer in ("unknown", str(material)) for answer, material in answered)


def test_evaluation_reports_calibration_and_unknown_next_to_the_accuracy_on_known_slides(
    model: dict[str, bytes],
) -> None:
    known_tree, _ = evaluated(model, slides(40, 5))
    tree, result = evaluated(model, join_parts(slides(40, 5), foreign_slides()))
    assert tree["model"] == known_tree["model"]  # slides of materials that the model does not know are counted apart
    for sensor in SENSORS:
        unknown = tree["unknown"][sensor]
        assert (unknown["false_unknown_n"], unknown["false_known_n"]) == (20, 4)
        assert (
            unknown["false_known_materials"] == 1 and "false_known_low" not in unknown
        )  # one material says nothing of others
        assert set(unknown["auroc"]) == {"probability", "distance"} and unknown["auroc"][unknown["rule"]] > 0.8
        calibration = tree["calibration"][sensor]
        assert calibration["n"] == 20
        assert sum(bin_tree["n"] for bin_tree in calibration["after"]["reliability"]) == 20
        assert calibration["after"]["log_loss"] < calibration["before"]["log_loss"]
    rows = list(csv.DictReader(result.files["answers.csv"].decode().splitlines()))
    assert len(rows) == 48 and {row["known"] for row in rows} == {"true", "false"}
    assert all(row["answer"] in ("unknown", row["named"]) for row in rows)


def test_at_most_the_asked_fraction_of_calibration_slides_is_unknown(model: dict[str, bytes]) -> None:
    loaded = MaterialModel.load(model)
    for sensor, sensor_slides in loaded.read(slides(20, 5)).items():
        assert sum(
            answer == "unknown" for answer in loaded.answers(sensor_slides.frames, sensor)
        ) <= ASKED.false_unknown * len(sensor_slides)


def test_slides_of_unknown_materials_whose_labels_are_text_are_evaluated_too(tmp_path: Path) -> None:
    def with_text_labels(shards: Any) -> Any:
        return dataset(
            *(
                slide(
                    attributes["sensor"],
                    attributes["material"],
                    attributes["trial"],
                    object=f"m{attributes['material']}",
                )
                for attributes in (shard.attributes for shard in shards.recordings.values())
            )
        )

    files = trained(
        tmp_path, with_text_labels(slides(0, 8)), with_text_labels(slides(20, 5)), use_validation=False, label="object"
    )
    calibrated = material_calibration.calibrate(
        files, ASKED, with_text_labels(slides(0, 8)), with_text_labels(slides(20, 5))
    )
    tree, _ = evaluated(calibrated, join_parts(with_text_labels(slides(40, 2)), with_text_labels(foreign_slides())))
    assert tree["unknown"]["biotac"]["false_known_n"] == 4


def test_slides_of_unknown_materials_alone_leave_no_accuracy_to_report(model: dict[str, bytes]) -> None:
    with pytest.raises(TacpipeError, match="no slide to evaluate"):
        evaluated(model, foreign_slides())


def test_a_model_that_is_not_calibrated_has_no_answers_and_refuses_other_materials(plain: dict[str, bytes]) -> None:
    with pytest.raises(TacpipeError, match="tacpipe calibrate"):
        material_prediction.predict(plain, slides(40, 1), probabilities=True)
    with pytest.raises(TacpipeError, match="not one of those the model names"):
        evaluated(plain, join_parts(slides(40, 1), foreign_slides()))


def test_validation_slides_that_the_model_learned_from_are_refused(tmp_path: Path) -> None:
    files = trained(tmp_path, slides(0, 8), slides(20, 5))
    with pytest.raises(TacpipeError, match="--no-use-validation"):
        material_calibration.calibrate(files, ASKED, slides(0, 8), slides(20, 5))


def test_too_few_slides_for_the_asked_fraction_are_refused(plain: dict[str, bytes]) -> None:
    request = CalibrationRequest((10, 50, 90), False, 0.01, 0)
    with pytest.raises(TacpipeError, match=r"20 validation slides cannot set a threshold .* takes 99 or more"):
        material_calibration.calibrate(plain, request, slides(0, 8), slides(20, 5))


def test_a_network_is_calibrated_as_any_architecture(tmp_path: Path) -> None:
    files = trained(tmp_path, slides(0, 8), slides(20, 5), architecture="x-lstm", scaling="standard")
    tree, _ = evaluated(
        material_calibration.calibrate(files, ASKED, slides(0, 8), slides(20, 5)),
        join_parts(slides(40, 2), foreign_slides()),
    )
    assert set(tree["calibration"]) == set(SENSORS)


def test_probabilities_of_arrays_are_those_of_the_table(model: dict[str, bytes]) -> None:
    loaded = MaterialModel.load(model)
    table = material_prediction.predict(model, slides(40, 1), probabilities=True).recordings["predictions"].streams[""]
    ((_, sensor_slides),) = list(loaded.read(slides(40, 1, ("roboskin",))).items())
    rows = [at for at, name in enumerate(table["sensor"].to_pylist()) if name == "roboskin"]
    expected = np.column_stack([table[f"probability_{kind:02d}"].to_numpy()[rows] for kind in MATERIALS])
    assert np.allclose(loaded.probabilities(sensor_slides.frames, "roboskin"), expected, atol=1e-5)
