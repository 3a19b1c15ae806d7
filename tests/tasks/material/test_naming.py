"""Classes whose labels are text, or of another label than material."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.tasks.material import model as material_prediction
from tacpipe.tasks.material import predictions
from tacpipe.tasks.material.headline import UNKNOWN, Naming
from tacpipe.tasks.material.model import MaterialModel
from tacpipe.tasks.material.params import StoredNaming
from tacpipe.tasks.material.report import pictures
from tests.fake_recordings import FakeDataset, FakeShard
from tests.report import parts
from tests.tasks.material.textures import MATERIALS, dataset, evaluated, slide, slides, trained

WORDS = {1: "cork", 2: "felt", 3: "foam, soft", 4: "über-rubber"}  # in the order of their numbers, as sorted


def worded(first: int, count: int, key: str = "material") -> Any:
    """The slides ``first`` to ``first + count``, whose classes have words for names."""
    with_words = slides(first, count, ("biotac",), material=None)
    for shard in with_words.recordings.values():
        shard.attributes[key] = WORDS[int(shard.name.split("-m")[1][:2])]
    return with_words


def numbered(first: int, count: int) -> Any:
    return slides(first, count, ("biotac",))


@pytest.mark.parametrize(
    ("label", "number"), [("foam", 1), (True, 2), (None, UNKNOWN)], ids=["text", "true", "nothing"]
)
def test_any_label_is_a_class_and_none_is_unknown(label: Any, number: int) -> None:
    naming = Naming.from_labels("grit", [True, "foam", "a", None])
    assert naming.names == ("a", "foam", "true")
    assert naming.number(label) == number
    assert naming.names_for(np.array([number])).tolist() == [naming.names[number] if number >= 0 else ""]


def test_whole_numbers_stay_their_own_names_and_are_written_as_before() -> None:
    naming = Naming.from_labels("material", [20, 3])
    stored: StoredNaming = {}
    naming.add_to_config(stored)
    assert (naming.number(20), naming.name(20), stored) == (20, "20", {})
    assert Naming.from_labels("material", [0.5, -1, 3]).names == ("-1", "0.5", "3")


def test_a_label_that_no_model_knows_is_refused_with_those_that_it_does() -> None:
    with pytest.raises(TacpipeError, match=r"tin is not one of cork, felt"):
        Naming("material", ("cork", "felt")).number("tin")


@pytest.mark.parametrize("key", ["material", "object"])
def test_words_give_the_predictions_of_numbers_in_words(tmp_path: Path, key: str) -> None:
    by_number = trained(tmp_path / "n", numbered(0, 4), numbered(4, 1), architecture="minirocket")
    by_word = trained(tmp_path / "w", worded(0, 4, key), worded(4, 1, key), architecture="minirocket", label=key)
    (first, numbered_result), (second, worded_result) = (
        evaluated(by_number, numbered(5, 2)),
        evaluated(by_word, worded(5, 2, key)),
    )
    assert first == second
    tables = [result.recordings["predictions"].streams[""] for result in (numbered_result, worded_result)]
    for column in ("material", "model", "mean_level"):
        assert [WORDS[number] for number in tables[0].column(column).to_pylist()] == tables[1].column(
            column
        ).to_pylist()
    assert "score_cork" in tables[1].column_names and "score_01" in tables[0].column_names
    assert "cork" in worded_result.files["confusion.csv"].decode()
    predicted = material_prediction.predict(by_word, worded(5, 2, key)).recordings["predictions"].streams[""]
    assert predicted.column("material").to_pylist() == tables[1].column("model").to_pylist()


def test_arrays_are_named_in_words_too(tmp_path: Path) -> None:
    model = MaterialModel.load(trained(tmp_path, worded(0, 4), worded(4, 1), architecture="minirocket"))
    ((sensor, sensor_slides),) = model.read(dataset(worded(5, 1).recordings["biotac-m02-t005"])).items()
    frames = sensor_slides.frames
    assert model.predict(frames, sensor).tolist() == ["felt"]
    assert model.names == tuple(WORDS.values())
    assert model.probabilities(frames, sensor).shape == (1, len(WORDS))


def test_slides_of_an_unknown_word_are_refused_by_evaluation_and_read_by_prediction(tmp_path: Path) -> None:
    model = trained(tmp_path, worded(0, 3), worded(3, 1), architecture="minirocket")
    strange = dataset(slide("biotac", 2, 9, material="tin"))
    with pytest.raises(TacpipeError, match=r"biotac-m02-t009.*tin.*cork"):
        evaluated(model, strange)
    assert material_prediction.predict(model, strange).recordings["predictions"].streams[""].num_rows == 1


@pytest.mark.long
def test_networks_and_held_out_classes_go_by_their_words(tmp_path: Path) -> None:
    both = [dataset(*worded(*span).recordings.values(), *_skin(*span)) for span in ((0, 4), (4, 2), (6, 2))]
    files = trained(tmp_path, both[0], both[1], architecture="raec", hold_out="roboskin=cork,über-rubber")
    tree, result = evaluated(files, both[2])
    assert tree["zero_shot"]["n"]["roboskin"] == 4
    table = result.recordings["predictions"].streams[""]
    read = predictions.read_predictions(table, MaterialModel.load(files).config)
    assert set(read[read["sensor"] == "roboskin"]["material"]) == {"felt", "foam, soft"}
    with pytest.raises(UsageError, match=r"hold_out names roboskin=tin.*cork"):
        trained(tmp_path / "other", both[0], both[1], architecture="raec", hold_out="roboskin=tin")


def test_a_report_has_the_words(tmp_path: Path) -> None:
    files = trained(tmp_path, worded(0, 4), worded(4, 1), architecture="minirocket")
    _, result = evaluated(files, worded(5, 3))
    shards = {"predictions": FakeShard("predictions", result.recordings["predictions"].streams[""])}
    given: Any = FakeDataset(shards, result.files, {})
    (method,) = parts.methods("material", given)
    counts, names = pictures.count_confusions(method, "biotac")
    assert names == sorted(WORDS.values()) and counts.sum() == 3 * len(MATERIALS)


def _skin(first: int, count: int) -> list[Any]:
    sensor_slides = slides(first, count, ("roboskin",))
    for shard in sensor_slides.recordings.values():
        shard.attributes["material"] = WORDS[shard.attributes["material"]]
    return list(sensor_slides.recordings.values())
