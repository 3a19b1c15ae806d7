"""Products in bfloat16: what training computes with fewer digits, and what stays as it was."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from tacpipe.plugins import given_params, registry
from tacpipe.plugins import params as params_of
from tests.training.networks import NETWORKS, losses, weights

SENSITIVE = ("touch pointnet",)  # normalised by the spread of few grasps, which magnifies what is rounded


@pytest.mark.parametrize("name", [pytest.param(network_name, marks=pytest.mark.long) for network_name in NETWORKS])
def test_bfloat16_learns_what_float32_does_but_for_rounding(name: str, tmp_path: Path) -> None:
    exact = NETWORKS[name](tmp_path / "exact")
    rounded = NETWORKS[name](tmp_path / "rounded", precision="bfloat16")
    assert losses(rounded) != losses(exact)
    compared = slice(1) if name in SENSITIVE else slice(None)
    assert losses(rounded)[compared] == pytest.approx(losses(exact)[compared], rel=0.05)


def test_weights_and_their_sums_stay_in_float32(tmp_path: Path) -> None:
    files = NETWORKS["forward gru"](tmp_path, precision="bfloat16")
    assert {weight.dtype for weight in weights(files).values()} == {torch.float32}
    assert any(not torch.equal(weight, weight.bfloat16().float()) for weight in weights(files).values())


@pytest.mark.parametrize("stage", ["train.forward", "train.material", "train.touch"])
def test_the_precision_is_in_a_key_where_it_is_not_the_default(stage: str) -> None:
    def stored(**options: Any) -> Mapping[str, Any]:
        choice = {"train.forward": "gru", "train.material": "raec", "train.touch": "patches"}[stage]
        return params_of.to_json(
            given_params.build(stage, registry.load(stage), options={"architecture": choice, **options})
        )

    assert stored(precision="float32") == stored()
    assert "precision" not in stored()
    assert stored(precision="bfloat16")["precision"] == "bfloat16"
