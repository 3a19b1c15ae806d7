import pytest
import torch
from torch import Tensor, nn

from tacpipe.models import lstm as lstm_layers
from tacpipe.models.lstm import lstm

INPUT, HIDDEN, LEAD = 3, 5, 2


def numbers(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(seed + sum(shape))
    return torch.randn(*shape, generator=generator, dtype=dtype).requires_grad_()


def arguments(steps: int, windows: int, dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Inputs, h, c, W, R, b, the lead's inputs and their weights."""
    shapes = [(steps, windows, INPUT), (windows, HIDDEN), (windows, HIDDEN)]
    shapes += [(4 * HIDDEN, INPUT), (4 * HIDDEN, HIDDEN), (4 * HIDDEN,), (windows, LEAD), (4 * HIDDEN, LEAD)]
    return [numbers(*shape, seed=seed, dtype=dtype) for seed, shape in enumerate(shapes)]


def outputs(inputs: Tensor, h: Tensor, c: Tensor, w: Tensor, r: Tensor, b: Tensor, *lead: Tensor) -> list[Tensor]:
    states, last = lstm(inputs, (h, c), (w, r, b), (lead[0], lead[1]) if lead else None)
    return [states, *last]


def reference(
    inputs: Tensor, h: Tensor, c: Tensor, w: Tensor, r: Tensor, b: Tensor, *lead: Tensor
) -> tuple[nn.LSTM, list[Tensor]]:
    """Torch's own layer with these weights."""
    layer = nn.LSTM(inputs.shape[-1], HIDDEN).to(inputs.dtype)
    with torch.no_grad():
        for name, value in (("weight_ih", w), ("weight_hh", r), ("bias_ih", b), ("bias_hh", torch.zeros_like(b))):
            getattr(layer, f"{name}_l0").copy_(value)
    states, (hidden, cell) = layer(inputs, (h[None], c[None]))
    return layer, [states, hidden[0], cell[0]]


@pytest.mark.parametrize(("steps", "windows"), [(1, 1), (1, 4), (4, 1), (4, 3)])
def test_outputs_and_all_gradients_are_those_of_torch(steps: int, windows: int) -> None:
    values = arguments(steps, windows)[:6]
    ours, (layer, theirs) = outputs(*values), reference(*values)
    weights = list(layer.parameters())[:3]
    seeds = [numbers(*ours_part.shape, seed=9).detach() for ours_part in ours]
    for ours_part, theirs_part in zip(ours, theirs, strict=True):
        assert torch.allclose(ours_part, theirs_part, atol=1e-12)
    for ours_part, theirs_part in zip(
        torch.autograd.grad(ours, values, seeds),
        torch.autograd.grad(theirs, [*values[:3], *weights], seeds),
        strict=True,
    ):
        assert torch.allclose(ours_part, theirs_part, atol=1e-10)


@pytest.mark.parametrize("steps", [1, 3])
def test_gradients_are_those_of_finite_differences(steps: int) -> None:
    assert torch.autograd.gradcheck(outputs, arguments(steps, 2))


def test_a_layer_that_begins_at_zero_is_one_given_zeros() -> None:
    inputs, h, c, *weights = arguments(3, 2)[:6]
    zero = torch.zeros_like(h).requires_grad_(), torch.zeros_like(c).requires_grad_()
    last_states = [lstm(inputs, state, (weights[0], weights[1], weights[2]))[1] for state in (None, zero)]
    for implicit, explicit in zip(*last_states, strict=True):
        assert torch.equal(implicit, explicit)
    for implicit, explicit in zip(
        *(torch.autograd.grad(torch.stack(last).sum(), weights) for last in last_states), strict=True
    ):
        assert torch.equal(implicit, explicit)


def test_without_gradients_the_outputs_are_the_same() -> None:
    values = arguments(4, 3)
    with torch.no_grad():
        plain = outputs(*values)
    for without, with_gradients in zip(outputs(*values), plain, strict=True):
        assert torch.allclose(without, with_gradients, atol=1e-12)


def test_single_precision_differs_by_rounding_alone() -> None:
    values = arguments(10, 8)
    single = [narrow.detach().float().requires_grad_() for narrow in values]
    double = outputs(*values)
    rounded = outputs(*single)
    for narrow, wide in zip(rounded, double, strict=True):
        assert torch.allclose(narrow.double(), wide, atol=1e-6)
    gradients = (
        torch.autograd.grad(results[0].square().mean(), weights)
        for results, weights in ((rounded, single), (double, values))
    )
    for narrow, wide in zip(*gradients, strict=True):
        assert torch.allclose(narrow.double(), wide, atol=1e-6)


def test_the_same_batch_twice_gives_the_same_bits() -> None:
    values = arguments(6, 4, torch.float32)
    first, second = (torch.autograd.grad(outputs(*values)[0].square().mean(), values) for _ in range(2))
    for gradient, repeated in zip(first, second, strict=True):
        assert torch.equal(gradient, repeated)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_outputs_and_gradients_are_those_of_the_processor() -> None:
    values = arguments(4, 3)
    on_gpu = [local.detach().cuda().requires_grad_() for local in values]
    ours, theirs = outputs(*values), outputs(*on_gpu)
    for local, remote in zip(ours, theirs, strict=True):
        assert torch.allclose(local, remote.cpu(), atol=1e-10)
    gradients = (
        torch.autograd.grad(results[0].square().mean(), weights)
        for results, weights in ((ours, values), (theirs, on_gpu))
    )
    for local, remote in zip(*gradients, strict=True):
        assert torch.allclose(local, remote.cpu(), atol=1e-10)


def test_an_lstm_is_in_float32_under_autocast() -> None:
    layer, inputs = nn.LSTM(3, 5), torch.randn(7, 2, 3)
    state = torch.randn(1, 2, 5)
    expected, _ = lstm_layers.run_layer(layer, inputs, (state, state))
    with torch.autocast("cpu", torch.bfloat16):
        states, _ = lstm_layers.run_layer(layer, inputs.bfloat16(), (state, state))
        same, _ = lstm_layers.run_layer(layer, inputs, (state, state))
    assert torch.equal(same, expected) and states.dtype == torch.float32


def test_a_layer_is_in_float32_under_autocast_also_if_its_weights_were_computed_in_fewer_digits() -> None:
    weights = torch.randn(20, 3), torch.randn(20, 5).bfloat16(), torch.randn(20)
    state = torch.randn(2, 5).bfloat16(), torch.randn(2, 5)
    with torch.autocast("cpu", torch.bfloat16):
        states, _ = lstm(torch.randn(4, 2, 3), state, weights)
    assert states.dtype == torch.float32
