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
from tacpipe.tasks.touch import baselines
from tacpipe.tasks.touch.predictor import Predictor
from tests.tasks.touch.handmade import dataset, grasps, recording, recordings, trained

OBJECTS = ["cup"] * 10 + ["jar"] * 10 + ["tin"] * 10
TREES = {"architecture": "trees", "inputs": "xyz", "targets": "pdc_th,e_mf"}
THREE = dataset(*[recording(n, kind) for kind in ("ball", "melon", "egg") for n in range(6)])


def beyond(truth: Floats, fraction: float) -> Callable[[Bools], Mapping[str, Floats]]:
    """Return a model that predicts so much of what the truth is beyond the constant of what it was trained on."""
    return lambda known: {"pdc_th": (constant := truth[known].mean(axis=0)) + fraction * (truth[~known] - constant)}


@pytest.mark.parametrize(
    ("fraction", "kept"), [(1.0, 1.0), (2.0, 0.5), (4.0, 0.25), (0.5, 1.0), (-1.0, 0.0), (0.0, 0.0)]
)
def test_what_is_kept_is_what_makes_the_predictions_for_left_out_objects_right(fraction: float, kept: float) -> None:
    truth = np.random.default_rng(0).normal(size=(30, 1))
    found = baselines.fit_shrinkage({"pdc_th": truth}, OBJECTS, beyond(truth, fraction))
    assert found.factor["pdc_th"] == pytest.approx(kept)
    np.testing.assert_allclose(found.constant["pdc_th"], truth.mean(axis=0))


def test_no_model_of_an_object_sees_its_grasps() -> None:
    seen: list[set[str]] = []

    def predict(known: Bools) -> dict[str, Floats]:
        seen.append(set(np.asarray(OBJECTS)[known]))
        return {"pdc_th": np.zeros((int((~known).sum()), 1))}

    baselines.fit_shrinkage({"pdc_th": np.ones((30, 1))}, OBJECTS, predict)
    assert seen == [{"jar", "tin"}, {"cup", "tin"}, {"cup", "jar"}]


def test_too_few_objects_are_refused() -> None:
    with pytest.raises(UsageError):
        baselines.fit_shrinkage({"pdc_th": np.ones((20, 1))}, OBJECTS[:20], beyond(np.ones((20, 1)), 1))


def test_grasps_of_novel_objects_alone_are_shrunk(tmp_path: Path) -> None:
    plain, shrunk = (
        Predictor.load(trained(tmp_path / name, THREE, shrink_novel=on, **TREES))
        for name, on in (("plain", False), ("shrunk", True))
    )
    assert plain.shrinkage is None
    assert shrunk.shrinkage is not None
    assert dict(shrunk.shrinkage.factor) == shrunk.config["kept_of_novel"]
    known, novel = grasps(20, 3), grasps(20, 3, object="shoe")
    for target in ("pdc_th", "e_mf"):
        np.testing.assert_array_equal(shrunk.predict_grasps(known)[target], plain.predict_grasps(known)[target])
        constant = shrunk.shrinkage.constant[target]
        assert constant.shape == (biotac_sp.width(target),)
        wanted = constant + shrunk.shrinkage.factor[target] * (plain.predict_grasps(novel)[target] - constant)
        np.testing.assert_allclose(shrunk.predict_grasps(novel)[target], wanted)


def test_the_forests_are_the_same_with_and_without_shrinkage(tmp_path: Path) -> None:
    plain, shrunk = (trained(tmp_path / str(on), THREE, shrink_novel=on, **TREES) for on in (False, True))
    one, other = (json.loads(files["config.json"]) for files in (plain, shrunk))
    assert one["members"] == other["members"]
    assert "shrink_novel" not in one["params"]


def test_a_model_of_two_objects_is_refused_a_shrinkage(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        trained(tmp_path, recordings(), shrink_novel=True, **TREES)
