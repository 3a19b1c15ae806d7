"""Average several networks of one architecture, and shrink forecasts of change towards persistence.

The mean of networks errs less than one of them does on average (Krogh and Vedelsby, Neural network ensembles, cross
validation, and active learning, 1995).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tacpipe.models.windows import Windows

TRIED = torch.linspace(0, 1, 21)  # weights of which the best is taken at each step
DOUBT = 0.05  # fraction of persistence's error that one more recording is imagined to lose by the full forecast


class Ensemble(nn.Module):
    """The mean of networks, each with weights of its own."""

    def __init__(self, members: Sequence[nn.Module]) -> None:
        """Take networks that scale themselves."""
        super().__init__()
        self.members = nn.ModuleList(members)
        self.change_only = members[0].change_only

    def calibrate(self, windows: Windows, ahead: Tensor) -> None:
        """Fit the scales of all members on training windows; ``ahead`` is (horizon, window, feature)."""
        for member in self.members:
            member.calibrate(windows, ahead)  # type: ignore[operator]

    def loss(self, windows: Windows, ahead: Tensor) -> Tensor:
        """Return the mean of the members' losses; the gradient of a member depends on its own loss only."""
        losses = [member.loss(windows, ahead) for member in self.members]  # type: ignore[operator]
        return torch.stack(losses).mean()

    def forward(self, windows: Windows) -> Tensor:
        """Return the features to come (horizon, window, feature)."""
        return torch.stack([member(windows) for member in self.members]).mean(0)


class Shrunk(nn.Module):
    """A trained network whose predicted change is multiplied by a weight from 0 (persistence) to 1 at each step."""

    weight: Tensor  # (horizon,)

    def __init__(self, network: nn.Module, weight: Tensor) -> None:
        """Take a network of change and the weights. Raises `ValueError` for weights below 0 or above 1."""
        super().__init__()
        if not ((weight >= 0) & (weight <= 1)).all():
            raise ValueError("a weight of the forecast is not between 0 and 1")
        self.network, self.change_only = network, True
        self.register_buffer("weight", weight)

    def forward(self, windows: Windows) -> Tensor:
        """Return the features to come (horizon, window, feature)."""
        now = windows.touch[-1]
        ahead: Tensor = now + self.weight[:, None, None] * (self.network(windows) - now)
        return ahead


def persistence_weights(changes: Tensor, measured: Tensor, recording: Tensor) -> Tensor:
    """Return the weight (horizon,) of predicted ``changes`` (horizon, window, feature), from 0 to 1.

    ``recording`` (window,) is the number of each window's recording. The weight has the least mean over recordings of the
    mean absolute error of the ``measured`` changes divided by that of persistence, next to one more recording on which the
    forecast is `DOUBT` worse: the fewer recordings there are, the closer it is to persistence. As the error is convex in
    the weight, that mean is at most 1 at every step.

    >>> changes, measured = torch.full((1, 1, 2), 2.0), torch.ones(1, 1, 2)
    >>> persistence_weights(changes, measured, torch.zeros(1, dtype=torch.int64))
    tensor([0.5000])
    """
    total = DOUBT * TRIED[:, None].double().expand(-1, len(changes)).clone()  # (weight, horizon)
    for number in torch.unique(recording):
        windows = recording == number
        predicted, truth = changes[:, windows].double(), measured[:, windows].double()
        errors = torch.stack([(truth - weight * predicted).abs().mean((1, 2)) for weight in TRIED])
        total += errors / errors[0].clamp_min(torch.finfo(torch.float64).tiny)
    return TRIED[total.argmin(0)]
