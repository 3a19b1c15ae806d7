from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.models.forecasts import RecurrentForward

LATENTS, STATES, CONTEXT, HORIZON, WINDOWS = 3, 2, 5, 4, 6


def model() -> RecurrentForward:
    torch.manual_seed(0)
    return RecurrentForward(LATENTS, STATES, hidden=8)


def windows(seed: int = 1) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    past = torch.randn(CONTEXT, WINDOWS, LATENTS + STATES, generator=generator)
    return past, torch.randn(HORIZON, WINDOWS, STATES, generator=generator)


def step_by_step(network: RecurrentForward, past: Tensor, plan: Tensor) -> Tensor:
    """The paper's model as its text reads: cell by cell, each prediction fed back."""
    cells = []
    for layer in (network.encoder, network.decoder):
        cell = nn.LSTMCell(LATENTS + STATES, network.hidden)
        for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            setattr(cell, name, getattr(layer, f"{name}_l0"))
        cells.append(cell)
    hidden = past.new_zeros(past.shape[1], network.hidden), past.new_zeros(past.shape[1], network.hidden)
    for frame in past:
        hidden = cells[0](frame, hidden)
    predicted, steps = past[-1, :, :LATENTS], []
    for planned in plan:
        hidden = cells[1](torch.cat([predicted, planned], dim=1), hidden)
        predicted = network.head(hidden[0])
        steps.append(predicted)
    return torch.stack(steps)


def test_predictions_and_gradients_are_those_of_a_loop_over_cells() -> None:
    network, (past, plan) = model(), windows()
    fast, slow = network(past, plan), step_by_step(network, past, plan)
    assert torch.allclose(fast, slow, atol=1e-6)
    weights = list(network.parameters())
    for ours, theirs in zip(
        torch.autograd.grad(fast.square().mean(), weights),
        torch.autograd.grad(slow.square().mean(), weights),
        strict=True,
    ):
        assert torch.allclose(ours, theirs, atol=1e-6)


def test_all_weights_learn_those_of_the_encoder_too() -> None:
    network, (past, plan) = model(), windows()
    network(past, plan)[-1].square().mean().backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_a_prediction_does_not_know_the_plan_of_later_steps() -> None:
    network, (past, plan) = model(), windows()
    before = network(past, plan)
    for step in range(HORIZON):
        changed = plan.clone()
        changed[step] += 1
        after = network(past, changed)
        assert torch.equal(after[:step], before[:step])
        assert (after[step:] != before[step:]).all()


def test_windows_of_a_batch_do_not_see_each_other() -> None:
    network, (past, plan) = model(), windows()
    before, changed = network(past, plan), past.clone()
    changed[:, 0] += 1
    after = network(changed, plan)
    assert torch.allclose(after[:, 1:], before[:, 1:], atol=1e-6)
    assert not torch.allclose(after[:, 0], before[:, 0], atol=1e-3)


def test_a_horizon_of_one_step_works() -> None:
    past, plan = windows()
    assert np.shape(model()(past, plan[:1])) == (1, WINDOWS, LATENTS)


def test_without_gradients_predictions_are_the_same() -> None:
    network, (past, plan) = model(), windows()
    with torch.no_grad():
        plain = network(past, plan)
    assert torch.allclose(network(past, plan), plain, atol=1e-6)


def test_names_of_the_weights_are_those_of_stored_models() -> None:
    lstm = [f"{name}_l0" for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")]
    expected = [f"{layer}.{name}" for layer in ("encoder", "decoder") for name in lstm] + ["head.weight", "head.bias"]
    assert list(model().state_dict()) == expected
