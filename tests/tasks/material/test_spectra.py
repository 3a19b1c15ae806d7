"""Models of spectra from params to metrics: a sensor names materials that only another one was told of."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.tasks.material import network_training
from tacpipe.tasks.material.classifier import BASELINES, CONFIG, WEIGHTS
from tacpipe.tasks.material.model import MaterialModel
from tests.tasks.material.textures import Slide, dataset, evaluated, params

# Two waves, in periods a metre, by which each of eight materials is known.
WAVES = {kind + 1: (60.0 + 25 * kind, 270.0 - 25 * ((3 * kind) % 8)) for kind in range(8)}
LOOKS = {"biotac": (300, 8, 100.0, 0.025), "roboskin": (75, 60, 50.0, 0.05)}  # frames, channels, rate, speed
SPECTRA = {"architecture": "spectra"}


def slide(felt: str, kind: int, trial: int, speed_m_s: float = 0.0, **attributes: Any) -> Slide:
    """A slide over two waves; its recording tells the speed if one is given."""
    rng = np.random.default_rng([kind, trial, len(felt)])
    frames, channels, rate_hz, usual_m_s = LOOKS[felt]
    at_m = np.arange(frames)[:, None] * (speed_m_s or usual_m_s) / rate_hz
    values = 50 + rng.normal(0, 1, (frames, channels))
    for per_m in WAVES[kind]:
        values += 9 * rng.uniform(0.7, 1.3) * np.sin(2 * np.pi * per_m * at_m + rng.uniform(0, 2 * np.pi, channels))
    about = {"quantity": "tactile", "unit": "count"}
    schema = pa.schema([pa.field(f"channel{number:02d}", pa.float32(), metadata=about) for number in range(channels)])
    table = pa.Table.from_arrays([pa.array(item.astype(np.float32)) for item in values.T], schema=schema)
    predicted = {"sensor": felt, "material": kind, "trial": trial, "rate_hz": rate_hz, **attributes}
    predicted |= {"speed_m_s": speed_m_s} if speed_m_s else {}
    return Slide({"slide": table}, f"{felt}-m{kind:02d}-t{trial:03d}", predicted)


def slides(first: int, count: int, **attributes: Any) -> Any:
    """The slides ``first`` to ``first + count`` of each sensor and material."""
    return dataset(
        *(
            slide(felt, kind, trial, **attributes)
            for felt in LOOKS
            for kind in WAVES
            for trial in range(first, first + count)
        )
    )


def trained(folder: Path, training: Any = None, validation: Any = None, **changed: Any) -> dict[str, bytes]:
    spectra_params = params(**{**SPECTRA, **changed})
    return network_training.train(spectra_params, training or slides(0, 5), validation or dataset(), folder)


def predictions(result: Any) -> dict[str, list[Any]]:
    fitted: dict[str, list[Any]] = result.recordings["predictions"].tables.to_pydict()
    return fitted


def test_a_sensor_names_materials_whose_labels_only_the_other_one_was_told(tmp_path: Path) -> None:
    metrics, result = evaluated(trained(tmp_path, hold_out="roboskin=3,6"), slides(5, 3))
    zero = metrics["zero_shot"]
    assert zero["n"] == {"roboskin": 6}
    assert zero["chance"] == {"roboskin": 1 / 8}
    assert zero["accuracy"]["roboskin"] >= 5 / 6
    assert zero["among_held_out"]["accuracy"]["roboskin"] >= zero["accuracy"]["roboskin"]
    assert zero["among_held_out"]["chance"] == {"roboskin": 1 / 2}
    assert metrics["model"]["n"] == {"biotac": 24, "roboskin": 18}
    assert metrics["model"]["accuracy"]["biotac"] > 0.95
    assert metrics["model"]["accuracy"]["roboskin"] > 0.9
    rows = predictions(result)
    held = [
        predicted == training
        for predicted, training in zip(rows["model"], rows["material"], strict=True)
        if training in (3, 6)
    ]
    assert np.mean(held) > 0.7


def test_the_labels_of_held_out_materials_reach_nothing_that_is_fitted(tmp_path: Path) -> None:
    first = trained(tmp_path, hold_out="roboskin=3,6")
    changed = [
        slide("roboskin", {3: 6, 6: 3}[kind], trial, material=kind) if kind in (3, 6) and felt == "roboskin" else
        slide(felt, kind, trial)
        for felt in LOOKS for kind in WAVES for trial in range(5)
    ]  # fmt: skip
    second = trained(tmp_path, dataset(*changed), hold_out="roboskin=3,6")
    assert first[WEIGHTS] == second[WEIGHTS]
    assert first[BASELINES] == second[BASELINES]
    assert trained(tmp_path, dataset(*changed))[WEIGHTS] != trained(tmp_path)[WEIGHTS]


def test_a_material_that_a_sensor_never_felt_is_as_one_held_out(tmp_path: Path) -> None:
    chosen = [
        item
        for item in slides(0, 5).recordings.values()
        if (item.attributes["sensor"], item.attributes["material"]) != ("roboskin", 4)
    ]
    files = trained(tmp_path, dataset(*chosen))
    assert json.loads(files[CONFIG])["held_out"] == {"biotac": [], "roboskin": [4]}
    assert evaluated(files, slides(5, 3))[0]["zero_shot"]["n"] == {"roboskin": 3}


def test_the_speed_is_that_which_recordings_tell_and_else_that_of_params(tmp_path: Path) -> None:
    predicted = json.loads(trained(tmp_path)[CONFIG])["spectra"]["speed_m_s"]
    assert predicted == {"biotac": 0.025, "roboskin": 0.05}
    chosen = [*slides(0, 4).recordings.values(), *(slide("biotac", kind, 9, speed_m_s=0.03) for kind in WAVES)]
    predicted = json.loads(trained(tmp_path, dataset(*chosen), speeds="roboskin=0.04")[CONFIG])["spectra"]["speed_m_s"]
    assert predicted == {"biotac": 0.03, "roboskin": 0.04}


def test_the_wrong_speed_takes_what_sensors_share(tmp_path: Path) -> None:
    right = evaluated(trained(tmp_path, hold_out="roboskin=1,3,6,8"), slides(5, 3))[0]["zero_shot"]["accuracy"][
        "roboskin"
    ]
    files = trained(tmp_path, hold_out="roboskin=1,3,6,8", speeds="biotac=0.025,roboskin=0.03")
    assert evaluated(files, slides(5, 3))[0]["zero_shot"]["accuracy"]["roboskin"] < right - 0.2


def test_one_sensor_alone_learns_its_own_materials(tmp_path: Path) -> None:
    metrics, _ = evaluated(
        trained(tmp_path, sensors="roboskin"),
        dataset(*(item for item in slides(5, 3).recordings.values() if item.attributes["sensor"] == "roboskin")),
    )
    assert metrics["model"]["accuracy"]["roboskin"] > 0.9
    assert metrics["permuted_labels"]["accuracy"]["roboskin"] < 0.5
    assert "zero_shot" not in metrics


def test_a_loaded_model_says_what_evaluate_says(tmp_path: Path) -> None:
    files = trained(tmp_path)
    rows = predictions(evaluated(files, slides(5, 1))[1])
    item = slide("roboskin", 2, 5)
    table = item.table("slide")
    frames = np.column_stack([table.column(name).to_numpy() for name in table.column_names])
    assert MaterialModel.load(files).predict(frames, "roboskin").tolist() == [
        rows["model"][rows["recording"].index(item.name)]
    ]
    assert np.isfinite([rows[f"z{number:02d}"] for number in range(1, 18)]).all()


def test_labels_dealt_out_anew_leave_nothing_to_learn(tmp_path: Path) -> None:
    metrics, _ = evaluated(trained(tmp_path, labels="permuted"), slides(5, 4))
    assert metrics["model"]["low"]["biotac"] < 1 / 8
    assert metrics["model"]["low"]["roboskin"] < 1 / 8


@pytest.mark.parametrize(
    "changed, sentence",
    [
        ({"speeds": "biotac"}, "speeds is 'biotac'; it must be a comma-separated list of NAME=VALUE"),
        ({"speeds": "biotac=-1"}, "each value a number above 0"),
        ({"speeds": "biotac=0.02"}, "roboskin .*biotac=0.02"),
        ({"hold_out": "roboskin=3;biotac=3"}, "hold_out .* 3;"),
        ({"hold_out": "roboskin=3", "sensors": "roboskin"}, "hold_out .* 3;"),
        ({"hold_out": "roboskin=1,2,3,4,5,6"}, " 2 classes"),
        ({"hold_out": "roboskin=9"}, "hold_out names roboskin=9"),
    ],
)
def test_params_that_make_no_sense_are_refused(tmp_path: Path, changed: dict[str, Any], sentence: str) -> None:
    with pytest.raises((TacpipeError, UsageError), match=sentence):
        trained(tmp_path, **changed)


def test_slides_without_a_rate_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="biotac-m01-t000 has no rate"):
        trained(tmp_path, slides(0, 3, rate_hz=None))
