"""Predictions for novel objects are shrunk as far as training objects that are left out show to be right."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from tacpipe.arrays import Bools, Floats
from tacpipe.channels import biotac_sp
from tacpipe.errors import UsageError
from tacpipe.tasks.touch import predictor
from tacpipe.tasks.touch.predictor import Predictor
from tests.tasks.touch.handmade import dataset, grasps, recording, recordings, trained

OBJECTS = ["cup"] * 10 + ["jar"] * 10 + ["tin"] * 10
TREES = {"architecture": "trees", "inputs": "xyz", "targets": "pdc_th,e_mf"}
THREE = dataset(*[recording(n, kind) for kind in ("ball", "melon", "egg") for n in range(6)])


def beyond(truth: Floats, fraction: float) -> Callable[[Bools], Mapping[str, Floats]]:
    """Return a model that predicts so much of what the truth is beyond the constant of what it was trained on."""
    return lambda in_training: {
        "pdc_th": (constant := truth[in_training].mean(axis=0)) + fraction * (truth[~in_training] - constant)
    }


@pytest.mark.parametrize(
    ("fraction", "kept"), [(1.0, 1.0), (2.0, 0.5), (4.0, 0.25), (0.5, 1.0), (-1.0, 0.0), (0.0, 0.0)]
)
def test_what_is_kept_is_what_makes_the_predictions_for_left_out_objects_right(fraction: float, kept: float) -> None:
    truth = np.random.default_rng(0).normal(size=(30, 1))
    fitted = predictor.fit_shrinkage({"pdc_th": truth}, OBJECTS, beyond(truth, fraction))
    assert fitted.factor["pdc_th"] == pytest.approx(kept)
    np.testing.assert_allclose(fitted.constant["pdc_th"], truth.mean(axis=0))


def test_no_model_of_an_object_sees_its_grasps() -> None:
    trained_objects: list[set[str]] = []

    def predict(in_training: Bools) -> dict[str, Floats]:
        trained_objects.append(set(np.asarray(OBJECTS)[in_training]))
        return {"pdc_th": np.zeros((int((~in_training).sum()), 1))}

    predictor.fit_shrinkage({"pdc_th": np.ones((30, 1))}, OBJECTS, predict)
    assert trained_objects == [{"jar", "tin"}, {"cup", "tin"}, {"cup", "jar"}]


def test_too_few_objects_are_refused() -> None:
    with pytest.raises(UsageError):
        predictor.fit_shrinkage({"pdc_th": np.ones((20, 1))}, OBJECTS[:20], beyond(np.ones((20, 1)), 1))


def test_grasps_of_novel_objects_alone_are_shrunk(tmp_path: Path) -> None:
    plain, shrunk = (
        Predictor.load(trained(tmp_path / name, THREE, shrink_novel=on, **TREES))
        for name, on in (("plain", False), ("shrunk", True))
    )
    assert plain.shrinkage is None
    assert shrunk.shrinkage is not None
    assert dict(shrunk.shrinkage.factor) == shrunk.config["kept_of_novel"]
    known_grasps, novel = grasps(20, 3), grasps(20, 3, object="shoe")
    for target in ("pdc_th", "e_mf"):
        np.testing.assert_array_equal(
            shrunk.predict_grasps(known_grasps)[target], plain.predict_grasps(known_grasps)[target]
        )
        constant = shrunk.shrinkage.constant[target]
        assert constant.shape == (biotac_sp.width(target),)
        expected = constant + shrunk.shrinkage.factor[target] * (plain.predict_grasps(novel)[target] - constant)
        np.testing.assert_allclose(shrunk.predict_grasps(novel)[target], expected)


def test_the_forests_are_the_same_with_and_without_shrinkage(tmp_path: Path) -> None:
    plain, shrunk = (trained(tmp_path / str(on), THREE, shrink_novel=on, **TREES) for on in (False, True))
    plain_config, shrunk_config = (json.loads(files["config.json"]) for files in (plain, shrunk))
    assert plain_config["members"] == shrunk_config["members"]
    assert "shrink_novel" not in plain_config["params"]


def test_a_model_of_two_objects_is_refused_a_shrinkage(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        trained(tmp_path, recordings(), shrink_novel=True, **TREES)
