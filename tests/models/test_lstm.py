from __future__ import annotations

import gc

import pytest
import torch
from torch import Tensor, nn

from tacpipe.models import lstm as module
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
    """torch's own layer with these weights."""
    layer = nn.LSTM(inputs.shape[-1], HIDDEN).to(inputs.dtype)
    with torch.no_grad():
        for name, value in (("weight_ih", w), ("weight_hh", r), ("bias_ih", b), ("bias_hh", torch.zeros_like(b))):
            getattr(layer, f"{name}_l0").copy_(value)
    states, (hidden, cell) = layer(inputs, (h[None], c[None]))
    return layer, [states, hidden[0], cell[0]]


@pytest.mark.parametrize(("steps", "windows"), [(1, 1), (1, 4), (4, 1), (4, 3)])
def test_outputs_and_all_gradients_are_those_of_torch(steps: int, windows: int) -> None:
    given = arguments(steps, windows)[:6]
    ours, (layer, theirs) = outputs(*given), reference(*given)
    weights = list(layer.parameters())[:3]
    seeds = [numbers(*one.shape, seed=9).detach() for one in ours]
    for one, other in zip(ours, theirs, strict=True):
        assert torch.allclose(one, other, atol=1e-12)
    for one, other in zip(
        torch.autograd.grad(ours, given, seeds),
        torch.autograd.grad(theirs, [*given[:3], *weights], seeds),
        strict=True,
    ):
        assert torch.allclose(one, other, atol=1e-10)


@pytest.mark.parametrize("steps", [1, 3])
def test_gradients_are_those_of_finite_differences(steps: int) -> None:
    assert torch.autograd.gradcheck(outputs, arguments(steps, 2))


def test_a_layer_that_begins_at_zero_is_one_given_zeros() -> None:
    inputs, h, c, *weights = arguments(3, 2)[:6]
    zero = torch.zeros_like(h).requires_grad_(), torch.zeros_like(c).requires_grad_()
    found = [lstm(inputs, state, (weights[0], weights[1], weights[2]))[1] for state in (None, zero)]
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)
    for one, other in zip(*(torch.autograd.grad(torch.stack(last).sum(), weights) for last in found), strict=True):
        assert torch.equal(one, other)


def test_without_gradients_the_outputs_are_the_same() -> None:
    given = arguments(4, 3)
    with torch.no_grad():
        plain = outputs(*given)
    for one, other in zip(outputs(*given), plain, strict=True):
        assert torch.allclose(one, other, atol=1e-12)


def test_single_precision_differs_by_rounding_alone() -> None:
    given = arguments(10, 8)
    single = [one.detach().float().requires_grad_() for one in given]
    double = outputs(*given)
    found = outputs(*single)
    for one, other in zip(found, double, strict=True):
        assert torch.allclose(one.double(), other, atol=1e-6)
    gradients = (
        torch.autograd.grad(many[0].square().mean(), some) for many, some in ((found, single), (double, given))
    )
    for one, other in zip(*gradients, strict=True):
        assert torch.allclose(one.double(), other, atol=1e-6)


def test_the_same_batch_twice_gives_the_same_bits() -> None:
    given = arguments(6, 4, torch.float32)
    first, second = (torch.autograd.grad(outputs(*given)[0].square().mean(), given) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert torch.equal(one, other)


def test_memory_is_lent_again_only_once_nobody_looks_at_it() -> None:
    given = arguments(6, 4)
    states = outputs(*given)[0]
    kept, before = states[2:], states.clone()
    loss = states.square().mean()
    del states
    for seed in range(20):
        outputs(*(one + seed for one in given))[0].square().mean().backward()  # type: ignore[no-untyped-call]
    assert torch.equal(kept, before[2:])
    fresh = outputs(*given)[0].square().mean()
    for one, other in zip(torch.autograd.grad(loss, given), torch.autograd.grad(fresh, given), strict=True):
        assert torch.equal(one, other)


def test_little_memory_is_kept() -> None:
    for windows in range(1, 60):
        outputs(*arguments(2, windows))[0].mean().backward()  # type: ignore[no-untyped-call]
    gc.collect()
    assert len(module._free) <= 16


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_outputs_and_gradients_are_those_of_the_processor() -> None:
    given = arguments(4, 3)
    there = [one.detach().cuda().requires_grad_() for one in given]
    ours, theirs = outputs(*given), outputs(*there)
    for one, other in zip(ours, theirs, strict=True):
        assert torch.allclose(one, other.cpu(), atol=1e-10)
    gradients = (torch.autograd.grad(many[0].square().mean(), some) for many, some in ((ours, given), (theirs, there)))
    for one, other in zip(*gradients, strict=True):
        assert torch.allclose(one, other.cpu(), atol=1e-10)
