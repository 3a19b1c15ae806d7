"""Adam against torch's own class."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from torch import nn

from tacpipe.training.loop import Adam


def _network() -> nn.Sequential:
    torch.manual_seed(3)
    return nn.Sequential(nn.Linear(5, 7), nn.Tanh(), nn.Linear(7, 2), nn.Linear(2, 1))


def _gradients(network: nn.Sequential, step: int) -> None:
    """Compute gradients of a batch; in every third step the last layer is not reached."""
    rows = torch.randn(11, 5, generator=torch.Generator().manual_seed(step))
    outputs = network[:3](rows) if step % 3 == 2 else network(rows)
    outputs.square().mean().backward()


@pytest.mark.parametrize("weight_decay", [0.0, 0.01])
def test_each_step_gives_the_bits_of_torch_optim_adam_also_where_some_weights_have_no_gradient(
    weight_decay: float,
) -> None:
    ours, theirs = _network(), _network()
    optimiser = Adam(ours.parameters(), 0.01, weight_decay)
    torchs = torch.optim.Adam(theirs.parameters(), lr=0.01, weight_decay=weight_decay, fused=True)

    for step in range(12):
        optimiser.learning_rate = torchs.param_groups[0]["lr"] = 0.01 / (step + 1)
        optimiser.zero_grad()
        torchs.zero_grad(set_to_none=True)
        _gradients(ours, step)
        _gradients(theirs, step)
        optimiser.step()
        torchs.step()

    for our_weight, torch_weight in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.equal(our_weight, torch_weight)
    for number, torch_state in torchs.state_dict()["state"].items():
        assert {name: value.tolist() for name, value in torch_state.items()} == {
            name: value.tolist() for name, value in optimiser.state()[number].items()
        }


def test_an_optimiser_that_takes_over_the_state_of_another_continues_with_the_same_bits() -> None:
    uninterrupted, parts = _network(), _network()
    single, first = Adam(uninterrupted.parameters(), 0.01), Adam(parts.parameters(), 0.01)
    second = Adam(parts.parameters(), 0.01)

    for step in range(8):
        if step == 4:
            second.load({number: {**moments} for number, moments in first.state().items()})
        for network, optimiser in ((uninterrupted, single), (parts, first if step < 4 else second)):
            optimiser.zero_grad()
            _gradients(network, step)
            optimiser.step()

    assert all(torch.equal(a, b) for a, b in zip(uninterrupted.parameters(), parts.parameters(), strict=True))


def test_a_training_imports_no_compiler() -> None:
    program = (
        "import sys, torch\nfrom tacpipe.training.loop import Adam\nweight = torch.ones(3, "
        "requires_grad=True)\nweight.square().sum().backward()\nAdam([weight], 0.1).step()\nprint([name for name in "
        "('torch._dynamo', 'torch._inductor') if name in sys.modules])\n"
    )

    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert process.stdout == "[]\n"
