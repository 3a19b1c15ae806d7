"""A calibrated classifier: probabilities, the answer unknown, and how both are measured with a material left out."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.models.minirocket import with_profile
from tacpipe.models.readout import statistics
from tacpipe.scores import calibration
from tacpipe.tasks.material import calibration as material_calibration
from tacpipe.tasks.material import model as material_prediction
from tacpipe.tasks.material.model import MaterialModel
from tacpipe.tasks.material.sensor_calibration import ClassDistance
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


def texture_slides(kinds: tuple[int, ...], count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Slides (slide, time, channel) whose spread differs by kind, and their kinds (slide,)."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(kinds, count)
    frames = rng.normal(20, 1, (len(labels), 30, 4)) + labels[:, None, None] * rng.normal(0, 1, (len(labels), 30, 4))
    return frames.astype(np.float32), labels


def test_the_nearest_class_is_the_slides_own_and_other_textures_are_far() -> None:
    fitted = ClassDistance.fit(*texture_slides((0, 2, 5), 30, 0))
    frames, labels = texture_slides((0, 2, 5), 20, 1)
    scores = fitted.scores(frames)
    assert (fitted.classes[scores.argmax(axis=1)] == labels).mean() > 0.95
    far_slides, _ = texture_slides((12,), 20, 2)
    assert calibration.auroc(scores.max(axis=1), fitted.scores(far_slides).max(axis=1)) > 0.95


def test_a_slide_far_from_all_training_slides_scores_lower_than_each_slide_of_a_learned_class() -> None:
    fitted = ClassDistance.fit(*texture_slides((0, 2, 5), 60, 0))
    learned = fitted.scores(texture_slides((0, 2, 5), 20, 1)[0]).max(axis=1)
    for kind in (100, 1000, 10_000):
        assert fitted.scores(texture_slides((kind,), 20, 2)[0]).max() < learned.min()


def test_no_direction_counts_more_in_the_distance_to_all_slides_than_in_the_distance_to_a_class() -> None:
    fitted = ClassDistance.fit(*texture_slides((0, 2, 5), 60, 0))
    assert np.linalg.norm(fitted.overall, 2) <= 1 + 1e-9  # else a slide far enough in that direction scores highest


def test_the_score_of_a_class_compares_distances_to_all_slides_to_its_mean_and_to_its_nearest_slide() -> None:
    learned, labels = texture_slides((0, 2, 5), 60, 0)
    fitted = ClassDistance.fit(learned, labels)

    def components(frames: np.ndarray) -> np.ndarray:
        features = np.hstack([statistics(frames), fitted.patterns.transform(with_profile(frames))])
        return (features - fitted.centre) @ fitted.projection  # (slide, component)

    frames, _ = texture_slides((2,), 1, 1)
    plain_training, (plain,) = components(learned), components(frames)
    training, slide = plain_training * fitted.gain, plain * fitted.gain
    means = np.stack([training[labels == kind].mean(axis=0) for kind in (0, 2, 5)])
    deviations = np.concatenate([training[labels == kind] - mean for kind, mean in zip((0, 2, 5), means, strict=True)])
    assert 0.5 < np.square(deviations).sum(axis=1).mean() / len(slide) < 1.2  # about the number of components
    to_all = slide @ np.linalg.inv(np.eye(len(slide)) + np.cov(means.T)) @ slide
    expected = [
        np.log(to_all * np.linalg.norm(plain))
        - np.log(np.square(slide - mean).sum())
        - np.log(np.square(slide - training[labels == kind]).sum(axis=1).min())
        - np.log(np.square(plain - plain_training[labels == kind]).sum(axis=1).min())
        for kind, mean in zip((0, 2, 5), means, strict=True)
    ]
    np.testing.assert_allclose(fitted.scores(frames)[0], expected, rtol=1e-6)


def test_training_slides_themselves_have_a_finite_score() -> None:
    frames, labels = texture_slides((0, 5), 10, 0)
    assert np.isfinite(ClassDistance.fit(frames, labels).scores(frames)).all()


def test_tensors_give_back_the_distance() -> None:
    frames, labels = texture_slides((0, 5), 10, 0)
    fitted = ClassDistance.fit(frames, labels)
    assert (ClassDistance.from_tensors(fitted.to_tensors()).scores(frames) == fitted.scores(frames)).all()
