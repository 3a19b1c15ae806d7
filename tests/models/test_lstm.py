import pytest
import torch
from torch import Tensor, nn

from tacpipe.models.lstm import lstm_of_weights, run_layer

INPUT, HIDDEN = 3, 5


def arguments(steps: int, windows: int) -> list[Tensor]:
    """Inputs, h, c, W, R and b."""
    shapes: list[tuple[int, ...]] = [(steps, windows, INPUT), (1, windows, HIDDEN), (1, windows, HIDDEN)]
    shapes += [(4 * HIDDEN, INPUT), (4 * HIDDEN, HIDDEN), (4 * HIDDEN,)]
    generator = torch.Generator().manual_seed(steps + windows)
    return [torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_() for shape in shapes]


@pytest.mark.parametrize(("steps", "windows"), [(1, 1), (1, 4), (4, 1), (4, 3)])
def test_outputs_and_gradients_of_computed_weights_are_those_of_a_layer_that_has_them(steps: int, windows: int) -> None:
    inputs, hidden, cell, *weights = arguments(steps, windows)
    layer = nn.LSTM(INPUT, HIDDEN).double()
    with torch.no_grad():
        for stored, value in zip(layer.parameters(), [*weights, torch.zeros_like(weights[2])], strict=True):
            stored.copy_(value)
    expected, _ = layer(inputs, (hidden, cell))
    states = lstm_of_weights(inputs, (hidden, cell), (weights[0], weights[1], weights[2]))
    assert torch.allclose(states, expected, atol=1e-12)
    seed = torch.randn_like(expected)
    gradients = torch.autograd.grad(states, [inputs, hidden, cell, *weights], seed)
    references = torch.autograd.grad(expected, [inputs, hidden, cell, *list(layer.parameters())[:3]], seed)
    for gradient, reference in zip(gradients, references, strict=True):
        assert torch.allclose(gradient, reference, atol=1e-10)


def test_an_lstm_is_in_float32_under_autocast() -> None:
    layer, inputs = nn.LSTM(3, 5), torch.randn(7, 2, 3)
    state = torch.randn(1, 2, 5)
    expected, _ = run_layer(layer, inputs, (state, state))
    with torch.autocast("cpu", torch.bfloat16):
        states, _ = run_layer(layer, inputs.bfloat16(), (state, state))
        same, _ = run_layer(layer, inputs, (state, state))
    assert torch.equal(same, expected) and states.dtype == torch.float32


def test_a_layer_is_in_float32_under_autocast_also_if_its_weights_were_computed_in_fewer_digits() -> None:
    weights = torch.randn(20, 3), torch.randn(20, 5).bfloat16(), torch.randn(20)
    state = torch.randn(1, 2, 5).bfloat16(), torch.randn(1, 2, 5)
    with torch.autocast("cpu", torch.bfloat16):
        assert lstm_of_weights(torch.randn(4, 2, 3), state, weights).dtype == torch.float32
