"""Test that a traced network gives bit-identical results, and that others run untraced."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tacpipe.models.windows import ARM, ForecastWindows
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.networks import Network
from tests.live import rigs


@pytest.fixture(scope="module")
def forecaster(tmp_path_factory: pytest.TempPathFactory) -> Forecaster:
    model_files = rigs.model(tmp_path_factory.mktemp("model"))
    return Forecaster.load(model_files[0])


def windows(forecaster: Forecaster, seed: int) -> ForecastWindows:
    rng = np.random.default_rng(seed)
    context, rows = forecaster.context, forecaster.context + forecaster.horizon
    touch = rng.normal(0, 50, (context, 1, len(forecaster.codec.latents))).cumsum(axis=0)
    arm = rng.normal(0, 0.01, (rows, 1, ARM))
    arm[..., 6] = 1
    parts = (touch, arm, rng.normal(0.04, 0.01, (context, 1)))
    return ForecastWindows(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


def test_a_recorded_network_gives_what_the_network_gives_to_the_last_bit(forecaster: Forecaster) -> None:
    network = Network(forecaster)
    assert network.is_recorded
    for seed in range(20):
        inputs = windows(forecaster, seed)
        assert network.features(inputs).tobytes() == forecaster.features(inputs).tobytes()


class Moody(nn.Module):
    """Takes another way for windows that a recording of one window does not show."""

    change_only = True

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, inputs: ForecastWindows) -> Any:
        predicted = self.network(inputs)
        return predicted + 1 if float(inputs.touch.abs().max()) > 0 else predicted


class Unwilling(Moody):
    """Cannot be recorded."""

    def forward(self, inputs: ForecastWindows) -> Any:
        if torch.jit.is_tracing():  # type: ignore[attr-defined,no-untyped-call]
            raise RuntimeError("not while recorded")
        return self.network(inputs)


@pytest.mark.parametrize("kind", [Moody, Unwilling])
def test_a_network_whose_recording_gives_other_numbers_runs_as_it_is(kind: type[Moody], forecaster: Forecaster) -> None:
    changed = dataclasses.replace(forecaster, model=kind(forecaster.model))
    network = Network(changed)
    assert not network.is_recorded
    inputs = windows(forecaster, 0)
    assert network.features(inputs).tobytes() == changed.features(inputs).tobytes()


def test_a_model_is_recorded_once(forecaster: Forecaster, tmp_path: Path) -> None:
    assert forecaster.single is forecaster.single
