"""Test that recurrent layers use float32 under reduced precision, with a simulated GPU."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from tacpipe.models import lstm as lstm_layers
from tacpipe.models.lstm import lstm


@pytest.mark.parametrize("kind", [nn.GRU, nn.LSTM])
def test_where_a_layer_would_be_would_use_float16_it_is_in_float32(
    kind: type[nn.GRU | nn.LSTM], monkeypatch: pytest.MonkeyPatch
) -> None:
    layer, inputs = kind(3, 5), torch.randn(7, 2, 3)
    state = torch.randn(1, 2, 5)
    initial = (state, state) if kind is nn.LSTM else state
    expected, _ = lstm_layers.run_layer(layer, inputs, initial)
    with torch.autocast("cpu", torch.bfloat16):
        reduced, _ = lstm_layers.run_layer(layer, inputs, initial)
        monkeypatch.setattr(lstm_layers, "would_use_float16", lambda _: True)
        widened, _ = lstm_layers.run_layer(layer, inputs, initial)
    assert torch.equal(widened, expected) and widened.dtype == torch.float32
    assert not torch.equal(reduced, expected)


def test_so_is_a_layer_of_weights_that_were_computed_in_fewer_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lstm_layers, "would_use_float16", lambda _: True)
    weights = torch.randn(20, 3), torch.randn(20, 5).bfloat16(), torch.randn(20)
    state = torch.randn(2, 5).bfloat16(), torch.randn(2, 5)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        states, _ = lstm(torch.randn(4, 2, 3), state, weights)
    assert states.dtype == torch.float32
