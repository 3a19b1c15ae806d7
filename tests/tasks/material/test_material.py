"""Models of the task from params to metrics, on small slides."""

import json
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load as load_tensors

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.models.readout import StatisticsClassifier, View
from tacpipe.plugins import given_params, registry
from tacpipe.scores import headline
from tacpipe.scores.intervals import wilson
from tacpipe.tasks.material import evaluation as material_evaluation
from tacpipe.tasks.material import headline as headlines
from tacpipe.tasks.material import model as material_prediction
from tacpipe.tasks.material import slides as slides_of
from tacpipe.tasks.material.classifier import BASELINES, CONFIG, LAST, WEIGHTS
from tacpipe.tasks.material.model import MaterialModel
from tacpipe.training import following
from tests.tasks.material.textures import MATERIALS, dataset, evaluated, slide, slides, trained
from tests.training.followers import Seen, interrupted

RAEC = {"architecture": "raec", "epochs": 3}


def predictions(result: Any) -> dict[str, list[Any]]:
    columns: dict[str, list[Any]] = result.recordings["predictions"].tables.to_pydict()
    return columns


@pytest.mark.parametrize(
    "changed", [{}, {"architecture": "statistics"}, RAEC, {"architecture": "x-lstm"}, {**RAEC, "joint": False}]
)
def test_every_unseen_slide_of_every_sensor_is_counted(tmp_path: Path, changed: dict[str, Any]) -> None:
    metrics, result = evaluated(trained(tmp_path, **changed), slides(8, 3))
    rows = predictions(result)
    assert metrics["model"]["n"] == {"biotac": 12, "roboskin": 12}
    assert metrics["counts"]["slides"] == {"biotac": 12, "roboskin": 12}
    for predictor in ("model", "mean_level", "permuted_labels"):
        for sensor in ("biotac", "roboskin"):
            right = sum(
                named == truth
                for named, truth, felt in zip(rows[predictor], rows["material"], rows["sensor"], strict=True)
                if felt == sensor
            )
            assert metrics[predictor]["correct"][sensor] == right
            assert metrics[predictor]["accuracy"][sensor] == right / 12
            low, high = metrics[predictor]["low"][sensor], metrics[predictor]["high"][sensor]
            assert (low, high) == wilson(right, 12)
    assert metrics["chance"]["accuracy"] == {"biotac": 0.25, "roboskin": 0.25}
    assert "seen" not in metrics


def test_the_strong_classifier_names_textures_that_it_can_tell_apart(tmp_path: Path) -> None:
    metrics, _ = evaluated(trained(tmp_path), slides(8, 3))
    assert metrics["model"]["accuracy"] == {"biotac": 1.0, "roboskin": 1.0}
    assert metrics["permuted_labels"]["accuracy"]["biotac"] < 0.7


def test_statistics_are_compared_with_the_same_readout_of_the_level_alone_and_without_it(tmp_path: Path) -> None:
    metrics, result = evaluated(trained(tmp_path, architecture="statistics"), slides(8, 3))
    training, unseen = (slides_of.read(slides(*numbers), labelled=True) for numbers in ((0, 8), (8, 3)))
    kinds: dict[str, View] = {"model": "all", "level_only": "level", "level_removed": "level_removed"}
    for sensor, sensor_slides in unseen.items():
        for name, view in kinds.items():
            readout = StatisticsClassifier.fit(training[sensor].frames, training[sensor].materials, view=view)
            assert metrics[name]["correct"][sensor] == int(
                (readout.predict(sensor_slides.frames) == sensor_slides.materials).sum()
            )
    for sensor_headline in headline.read(result.files[headline.FILE]):
        assert headlines.BASELINES["level_only"] in {baseline.name for baseline in sensor_headline.baselines}


@pytest.mark.long
def test_a_network_learns_textures_given_time(tmp_path: Path) -> None:
    time = {"epochs": 40, "hidden": 16, "latents": 8, "align_from": 5, "learning_rate": 0.01, "scaling": "standard"}
    metrics, _ = evaluated(trained(tmp_path, architecture="raec", **time), slides(8, 3))
    assert metrics["model"]["low"]["biotac"] > 0.25


def test_labels_dealt_out_anew_leave_nothing_to_learn(tmp_path: Path) -> None:
    metrics, _ = evaluated(trained(tmp_path, labels="permuted"), slides(8, 6))
    low, _ = wilson(metrics["model"]["correct"]["biotac"], metrics["model"]["n"]["biotac"])
    assert low < 0.25


def test_slides_that_the_model_has_seen_are_reported_apart(tmp_path: Path) -> None:
    metrics, result = evaluated(trained(tmp_path), slides(5, 4))
    assert metrics["model"]["n"]["biotac"] == 4
    assert metrics["seen"]["model"]["n"]["biotac"] == 12
    assert sum(predictions(result)["seen"]) == 24


def test_the_confusions_add_up_to_the_unseen_slides(tmp_path: Path) -> None:
    _, result = evaluated(trained(tmp_path), slides(5, 4))
    lines = result.files["confusion.csv"].decode().splitlines()[1:]
    assert sum(int(line.split(",")[-1]) for line in lines) == 8


def test_dropping_the_last_batch_counts_whole_batches_only(tmp_path: Path) -> None:
    metrics, _ = evaluated(trained(tmp_path, **RAEC, drop_last=True), slides(8, 3))
    assert metrics["model"]["n"] == {"biotac": 8, "roboskin": 8}
    assert metrics["model"]["correct"]["biotac"] == round(8 * metrics["model"]["accuracy"]["biotac"])


def test_scores_and_latents_of_a_network_lie_beside_what_it_names(tmp_path: Path) -> None:
    _, result = evaluated(trained(tmp_path, **RAEC), slides(8, 1))
    rows = predictions(result)
    scores = np.array([rows[f"score_{kind:02d}"] for kind in MATERIALS])
    assert rows["model"] == [MATERIALS[i] for i in scores.argmax(axis=0)]
    assert np.isfinite([rows[f"z{number:02d}"] for number in range(1, 7)]).all()


def test_a_loaded_model_says_what_evaluate_says(tmp_path: Path) -> None:
    files = trained(tmp_path, **RAEC)
    _, result = evaluated(files, slides(8, 1))
    rows, loaded = predictions(result), MaterialModel.load(files)
    frames = np.column_stack(
        [slide("biotac", 2, 8).table("slide").column(f"channel{number:02d}").to_numpy() for number in range(1, 6)]
    )
    assert loaded.predict(frames, "biotac").tolist() == [rows["model"][rows["recording"].index("biotac-m02-t008")]]
    predicted = predictions(material_prediction.predict(files, slides(8, 1, material=None)))
    assert predicted["material"] == rows["model"]


@pytest.mark.parametrize("select", ["best", "last"])
def test_both_the_best_and_the_last_weights_are_kept(tmp_path: Path, select: str) -> None:
    files = trained(tmp_path, **{**RAEC, "epochs": 6}, select=select)
    history = [json.loads(line) for line in files["history.jsonl"].splitlines()]
    assert len(history) == 6
    assert (LAST in files) == (select == "best")
    config = json.loads(files[CONFIG])
    best = max(
        history, key=lambda line: (sum(sensor_line["accuracy"] for sensor_line in line["val"].values()), line["epoch"])
    )
    assert config["validation"]["epoch"] == dict.fromkeys(("biotac", "roboskin"), best["epoch"])
    assert ("last_epoch" in evaluated(files, slides(8, 1))[0]) == (select == "best")


@cache
def uninterrupted() -> dict[str, bytes]:
    """A joint run of 36 steps that nobody ended."""
    with tempfile.TemporaryDirectory() as folder:
        return trained(Path(folder), **{**RAEC, "epochs": 12})


@pytest.mark.long
@pytest.mark.parametrize("batches", [1, 16, 34])
def test_a_joint_run_killed_at_any_epoch_ends_with_the_same_weights(tmp_path: Path, batches: int) -> None:
    with interrupted(tmp_path / "killed", batches=batches):
        trained(tmp_path / "killed", **{**RAEC, "epochs": 12})
    resumed = trained(tmp_path / "killed", **{**RAEC, "epochs": 12})
    assert resumed[WEIGHTS] == uninterrupted()[WEIGHTS]
    assert resumed[LAST] == uninterrupted()[LAST]
    assert resumed["history.jsonl"] == uninterrupted()["history.jsonl"]


def test_mapping_to_a_known_space_leaves_the_known_sensor_as_it_was(tmp_path: Path) -> None:
    start = trained(tmp_path / "known", **RAEC, joint=False)
    mapped = trained(tmp_path / "mapped", **RAEC, frozen_sensor="roboskin", init=start, reconstruction_weight=0.01)
    before, after = load_tensors(start[WEIGHTS]), load_tensors(mapped[WEIGHTS])
    for name, value in before.items():
        if name.startswith("roboskin."):
            assert torch.equal(after[name], value)
    assert torch.equal(after["biotac.classifier.weight"], before["roboskin.classifier.weight"])
    assert not torch.equal(after["biotac.to_latents.weight"], before["biotac.to_latents.weight"])
    assert "swapped" not in evaluated(mapped, slides(8, 1))[0]


def test_slides_of_the_model_that_a_mapping_began_with_count_as_seen(tmp_path: Path) -> None:
    start = trained(tmp_path / "known", slides(20, 6), **RAEC, joint=False)
    mapped = trained(tmp_path / "mapped", **RAEC, frozen_sensor="roboskin", init=start)
    metrics, _ = evaluated(mapped, slides(20, 2))
    assert metrics["seen"]["counts"]["slides"] == {"biotac": 8, "roboskin": 8}
    assert metrics["counts"]["slides"] == {"biotac": 0, "roboskin": 0}


def test_materials_held_out_are_named_by_the_other_sensors_classifier_alone(tmp_path: Path) -> None:
    metrics, _ = evaluated(trained(tmp_path, **RAEC, hold_out="roboskin=3,4"), slides(8, 3))
    assert metrics["model"]["n"] == {"biotac": 12, "roboskin": 6}
    zero = metrics["zero_shot"]
    assert zero["n"] == {"roboskin": 6}
    assert zero["chance"] == {"roboskin": 0.25}
    assert zero["among_held_out"]["chance"] == {"roboskin": 0.5}
    assert zero["among_held_out"]["n"] == {"roboskin": 6}


def test_swapped_names_go_through_the_permutation_that_sensors_were_aligned_by(tmp_path: Path) -> None:
    files = trained(tmp_path, **RAEC, pairing="permuted")
    partners = {
        int(first_class): partner_class for first_class, partner_class in json.loads(files[CONFIG])["partners"].items()
    }
    assert sorted(partners.values()) == list(MATERIALS)
    _, result = evaluated(files, slides(8, 2))
    rows, loaded = predictions(result), MaterialModel.load(files)
    latents = np.array([rows[f"z{number:02d}"] for number in range(1, 7)], np.float32).T
    for sensor, partner in (("biotac", "roboskin"), ("roboskin", "biotac")):
        at = [i for i, sensor_name in enumerate(rows["sensor"]) if sensor_name == sensor]
        best_classes = loaded.best_classes(loaded.readers[sensor].scores_by(loaded.readers[partner], latents[at]))
        original = (
            {partner_class: first_class for first_class, partner_class in partners.items()}
            if sensor == "biotac"
            else partners
        )
        assert [rows["swapped"][i] for i in at] == [original[int(one)] for one in best_classes]


def test_one_sensor_alone_is_trained_where_only_it_is_asked_for(tmp_path: Path) -> None:
    files = trained(tmp_path, **RAEC, sensors="roboskin")
    assert list(json.loads(files[CONFIG])["sensors"]) == ["roboskin"]
    assert evaluated(files, slides(8, 1, ("roboskin",)))[0]["model"]["n"] == {"roboskin": 4}
    assert evaluated(files, slides(8, 1))[0]["model"]["n"] == {"roboskin": 4}
    with pytest.raises(TacpipeError, match="No recording is of the sensor roboskin; there are biotac"):
        evaluated(files, slides(8, 1, ("biotac",)))


def test_the_strong_classifier_needs_no_validation_slides_and_learns_from_those_there_are(tmp_path: Path) -> None:
    without_validation = trained(tmp_path, validation=dataset())
    with_validation = trained(tmp_path)
    assert without_validation[WEIGHTS] != with_validation[WEIGHTS]
    assert without_validation[WEIGHTS] == trained(tmp_path, use_validation=False)[WEIGHTS]


def test_baselines_can_be_left_out(tmp_path: Path) -> None:
    files = trained(tmp_path, **RAEC, baselines=False)
    assert BASELINES not in files
    assert "mean_level" not in evaluated(files, slides(8, 1))[0]


def test_networks_are_trained_by_the_loop_that_all_tasks_share(tmp_path: Path) -> None:
    follower = Seen()
    with following.in_workspace(tmp_path, follower):
        trained(tmp_path, **RAEC, baselines=False)
    assert [network.epochs for network, _ in follower.networks] == [3]


def same_but(**attributes: Any) -> Any:
    return dataset(*slides(0, 2).recordings.values(), slide("roboskin", 1, 9, **attributes))


@pytest.mark.parametrize(
    "training, changed, sentence",
    [
        (slides(0, 2, ("biotac",), material=1), {}, "All training slides are of material 1"),
        (same_but(material=None), {}, "roboskin-m01-t009 of the sensor roboskin has no label material"),
        (same_but(sensor=None), {}, "no label sensor"),
        (same_but(rate_hz=50.0), {}, "has 50 frames a second, not 100 as roboskin-m01-t000"),
        (same_but(material=9), RAEC, "biotac has no training slide of material 9"),
        (same_but(layout="authors"), {}, "has the layout authors, not time"),
        (same_but(sensor="biotac"), {}, "has 60 channels, among them channel06, not the same 5"),
    ],
)
def test_slides_that_cannot_be_learned_from_are_refused(
    tmp_path: Path, training: Any, changed: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        trained(tmp_path, training, **changed)


@pytest.mark.parametrize(
    "changed, sentence",
    [
        (
            {"architecture": "cnn"},
            "architecture is 'cnn'; it must be one of minirocket, raec, spectra, statistics, x-lstm",
        ),
        ({"labels": "none"}, "labels is 'none'"),
        ({**RAEC, "select": "first"}, "select is 'first'"),
        ({**RAEC, "frozen_sensor": "biotac"}, "needs both --frozen-sensor"),
        ({**RAEC, "hold_out": "roboskin=9"}, "hold_out names roboskin=9"),
        ({**RAEC, "hold_out": "roboskin=x"}, "hold_out names roboskin=x"),
        ({"hold_out": "roboskin=3"}, "hold-out belongs to the architecture raec, spectra or x-lstm"),
        ({"sensors": "digit"}, "No recording is of the sensor digit"),
        ({**RAEC, "scaling": "cube"}, "scaling is 'cube'; it must be one of none, standard, spread, log"),
    ],
)
def test_params_that_make_no_sense_are_refused(tmp_path: Path, changed: dict[str, Any], sentence: str) -> None:
    with pytest.raises((TacpipeError, UsageError), match=sentence):
        trained(tmp_path, **changed)


def test_networks_need_validation_slides(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="No recording of biotac has the role val"):
        trained(tmp_path, validation=dataset(), **RAEC)


def test_recordings_of_an_unknown_layout_are_refused_when_judged(tmp_path: Path) -> None:
    files = trained(tmp_path)
    with pytest.raises(TacpipeError, match="does not know the sensor digit; it was trained on biotac, roboskin"):
        material_evaluation.evaluate(files, dataset(slide("biotac", 1, 8, sensor="digit")))
    with pytest.raises(TacpipeError, match="has 60 channels, among them channel06"):
        material_evaluation.evaluate(files, dataset(slide("roboskin", 1, 8, sensor="biotac")))
    with pytest.raises(TacpipeError, match="of material 7, "):
        material_evaluation.evaluate(files, dataset(slide("biotac", 7, 8)))
    with pytest.raises(TacpipeError, match="of the task forward"):
        MaterialModel.load({CONFIG: b'{"task": "forward"}'})


def test_slides_of_another_shape_are_refused_by_a_loaded_model(tmp_path: Path) -> None:
    loaded = MaterialModel.load(trained(tmp_path))
    with pytest.raises(TacpipeError, match=r"Slides of biotac are \(slide, 40, 5\), not \(1, 40, 4\)"):
        loaded.predict(np.zeros((40, 4)), "biotac")
    with pytest.raises(UsageError, match="biotac, roboskin"):
        loaded.predict(np.zeros((40, 5)))
    with pytest.raises(TacpipeError, match="not finite"):
        loaded.predict(np.full((40, 5), np.nan), "biotac")


def test_the_published_code_with_its_quirks_is_a_preset() -> None:
    stage = registry.load("train.material")
    quirks = given_params.build("train.material", stage, preset="authors")
    assert (quirks.pairing, quirks.shuffle, quirks.drop_last, quirks.unpool) == ("fixed", False, True, "last")
    assert (quirks.architecture, quirks.select, quirks.scaling, quirks.epochs) == ("raec", "last", "none", 2000)
    with pytest.raises(UsageError, match=r"no preset huge for train\.material; it has quick, paper, authors"):
        given_params.build("train.material", stage, preset="huge")


def test_the_published_quirks_train_and_are_judged_on_whole_batches(tmp_path: Path) -> None:
    quirks = {"pairing": "fixed", "shuffle": False, "drop_last": True, "unpool": "last", "select": "last", "seed": 1}
    files = trained(tmp_path, **RAEC, **quirks)
    metrics, _ = evaluated(files, slides(8, 3))
    assert metrics["model"]["n"] == {"biotac": 8, "roboskin": 8}
    assert json.loads(files[CONFIG])["shapes"]["roboskin"]["unpool"] == "last"
    metrics_of_few, _ = evaluated(trained(tmp_path / "few", validation=slides(6, 1), **RAEC, **quirks), slides(8, 1))
    assert metrics_of_few["model"]["n"] == {"biotac": 4, "roboskin": 4}
