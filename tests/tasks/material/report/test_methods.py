"""Results are grouped into methods, which get names."""

import json
from typing import Any

from tacpipe.comparison.runs import Method
from tacpipe.tasks.material.report import methods
from tests.report import parts
from tests.tasks.material.report.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}


def grouped(*results: Any) -> dict[str, Method]:
    return {method.name: method for method in parts.methods("material", *results)}


def test_seeds_folds_and_sensors_that_were_trained_alone_make_one_method() -> None:
    by_name = grouped(
        *(
            result(wrong={sensor: 1}, fold=fold, seed=seed, sensors=sensor)
            for sensor in BOTH
            for fold in (0, 1)
            for seed in (0, 1)
        )
    )
    assert {name: len(single_method.runs) for name, single_method in by_name.items()} == {"RAEC independent": 8}
    assert methods.sensors_of([by_name["RAEC independent"]]) == ("biotac", "roboskin")
    assert len(methods.runs_on(by_name["RAEC independent"], "biotac")) == 4


def test_names_say_what_keeps_a_method_from_being_plain() -> None:
    by_name = grouped(
        result("minirocket", wrong=BOTH),
        result("x-lstm", wrong=BOTH),
        result(wrong=BOTH),
        result(wrong=BOTH, joint=True),
        result(wrong=BOTH, joint=True, pairing="permuted"),
        result(wrong=BOTH, labels="permuted"),
        result(wrong=BOTH, joint=True, reduce="biotac", ratio=11),
        result(wrong=BOTH, joint=True, hold_out="roboskin=3,4"),
        result("minirocket", wrong=BOTH, train={"biotac": 64, "roboskin": 64}),
        result(wrong=BOTH, known="biotac"),
    )
    assert {name: single_method.control for name, single_method in by_name.items()} == {
        "MiniRocket": False,
        "X-LSTM": False,
        "RAEC independent": False,
        "RAEC joint": False,
        "mapping to known space": False,
        "RAEC joint · permuted pairs": True,
        "RAEC independent · permuted labels": True,
        "RAEC joint · BioTac 11 %": True,
        "RAEC joint · RoboSkin without 3, 4": True,
        "MiniRocket · 64 slides": True,
    }


def test_a_name_states_that_a_network_was_trained_for_fewer_epochs_than_in_the_paper() -> None:
    def trained(epochs: int, architecture: str = "raec", **options: Any) -> Any:
        dataset = result(architecture, wrong=BOTH, **options)
        config = json.loads(dataset.files["config.json"])
        config["params"]["epochs"] = epochs
        dataset.files["config.json"] = json.dumps(config).encode()
        return dataset

    found = grouped(trained(150, joint=True), trained(2000, joint=True), trained(30, "x-lstm"), result(wrong=BOTH))
    assert {name: one.family for name, one in found.items()} == {
        "RAEC joint (150 of 2,000 epochs)": "RAEC joint",
        "RAEC joint": "RAEC joint",
        "X-LSTM (30 of 2,000 epochs)": "X-LSTM",
        "RAEC independent": "RAEC independent",
    }
    assert list(grouped(trained(150, joint=True, published=False))) == ["RAEC joint (150 of 2,000 epochs)"]


def test_settings_are_told_only_where_they_tell_methods_apart() -> None:
    by_name = grouped(
        result(wrong=BOTH, joint=True, decoder="D1", pairing="fixed", epochs_most=5),
        result(wrong=BOTH, joint=True, decoder="D2", pairing="fixed", epochs_most=5),
        result(wrong=BOTH, decoder="D1", epochs_most=5),
    )
    assert list(by_name) == ["RAEC independent", "RAEC joint · decoder D1", "RAEC joint · decoder D2"]


def test_settings_without_effect_make_no_other_method() -> None:
    by_name = grouped(
        result("minirocket", wrong=BOTH, joint=True, decoder="D1", epochs_most=1, reduce="biotac", ratio=11),
        result("minirocket", wrong=BOTH, joint=False, decoder="D2", epochs_most=2),
        result("x-lstm", wrong=BOTH, joint=True, pairing="fixed", decoder="D1"),
        result("x-lstm", wrong=BOTH, joint=False, pairing="random", decoder="D2"),
        result(wrong=BOTH, pairing="fixed", alignment_weight=1.0),
        result(wrong=BOTH, pairing="random", alignment_weight=2.0),
    )
    assert {name: len(single_method.runs) for name, single_method in by_name.items()} == {
        "MiniRocket": 2,
        "X-LSTM": 2,
        "RAEC independent": 2,
    }


def test_results_of_another_split_stand_apart_from_what_most_have() -> None:
    def placed(split: str, fold: int) -> Any:
        fake_result = result("minirocket", wrong=BOTH, fold=fold)
        fake_result.files["config.json"] = json.dumps(
            {**json.loads(fake_result.files["config.json"]), "split": split}
        ).encode()
        return fake_result

    by_name = grouped(placed("", 0), placed("", 1), placed("last to first", 2))
    assert {name: split_method.control for name, split_method in by_name.items()} == {
        "MiniRocket": False,
        "MiniRocket · split last to first": False,
    }


def test_folds_of_nearly_one_size_pool_and_fewer_slides_do_not() -> None:
    sizes = (600, 599, 585, 430, 96, 100, 64)
    by_name = grouped(*(result(wrong=BOTH, train=dict.fromkeys(BOTH, size), fold=size) for size in sizes))
    assert {name: len(single_method.runs) for name, single_method in by_name.items()} == {
        "RAEC independent": 3,
        "RAEC independent · 430 slides": 1,
        "RAEC independent · 96 slides": 2,
        "RAEC independent · 64 slides": 1,
    }


def test_a_sensor_with_fewer_slides_than_another_has_all_of_its_own() -> None:
    by_name = grouped(
        result(wrong={"biotac": 1}, train={"biotac": 100}), result(wrong={"roboskin": 1}, train={"roboskin": 60})
    )
    assert list(by_name) == ["RAEC independent"]


def test_one_sensor_with_fewer_slides_than_the_other_is_a_method_of_its_own() -> None:
    by_name = grouped(
        result(wrong=BOTH, joint=True),
        result(wrong=BOTH, joint=True, train={"biotac": 576, "roboskin": 64}),
        result(wrong=BOTH, joint=True, train={"biotac": 64, "roboskin": 64}),
    )
    assert list(by_name) == ["RAEC joint", "RAEC joint · 64 slides", "RAEC joint · RoboSkin 64 slides"]


def test_simulated_slides_and_scrambled_ones_are_kept_apart() -> None:
    by_name = grouped(result(wrong=BOTH), result(wrong=BOTH, simulated=True))
    assert {single_method.simulated for single_method in by_name.values()} == {True, False}


def test_a_mapped_method_tells_of_the_sensor_that_was_mapped() -> None:
    by_name = grouped(result(wrong=BOTH, known="biotac"), result(wrong=BOTH, known="roboskin"))
    (method,) = by_name.values()
    assert [run.details.sensors for run in methods.runs_on(method, "roboskin")] == [("roboskin",)]
    assert [run.details.sensors for run in methods.runs_on(method, "biotac")] == [("biotac",)]
